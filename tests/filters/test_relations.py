"""What must not depend on how a problem is stated: units, origin, axes, the order of tracks, and how gaps are cut.

A relation is between two runs of a filter, so that it needs no truth: the second is of the same tracks in other words.
What a filter does not keep by its definition is named here, with the reason."""

import math
from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch

from torchfra import Gaussian
from torchfra.association import Clutter, Euclidean
from torchfra.catalogue import FILTERS
from torchfra.motion import Bank, ConstantVelocity, Linear
from torchfra.presets.regimes import MANOEUVRES
from torchfra.sensors import Linear as LinearSensor
from torchfra.sensors import Position

RUNS, STEPS, TARGETS = 3, 10, 2
TIME = {
    "asrckf": {"trace": "position"}, "rmckf": {"trace": "position"}, "fra_srckf": {"trace": "position"},
    "fra": {"trace": "position"}, "imm_fra": {"trace": "position"},
}  # fmt: skip
"""By default fading factors compare sums of m^2 and m^2/s^2, as published, which the unit of time changes."""
ROTATED = (
    "ekf", "ukf", "srckf", "ghckf", "imm", "imm_srckf", "imm_ckf", "vsimm_srckf", "ukf_jpda", "jpda", "gpb", "asrckf",
)  # fmt: skip
"""Others weigh each element of a measurement, or estimate its noise, by itself."""
ANY_STATE = [
    name for name, entry in FILTERS.items() if not entry.scans and not entry.constant_gains and name != "hghckf1"
]
"""Those of scans and of constant gains need positions.  ``hghckf1`` weighs the prediction by elements, as the lower
root of its covariance whitens them: the first alone, the last given all others."""
ONE_MOTION = ("ekf", "ukf", "srckf", "ghckf", "rsrckf", "mr_ckf", "hghckf1", "hghckf2", "hghckf")
"""The others remember time by steps: chains of modes, fading memories and counts."""
LINEAR = ("ekf", "ukf", "srckf", "ghckf")
"""Of two equal measurements robust filters weigh each."""


@dataclass(frozen=True)
class Problem:
    """Tracks of a target that turns sharply once, with outliers and missing data, in units of one's own."""

    z: torch.Tensor
    mean: torch.Tensor
    length: float = 1.0
    time: float = 1.0
    dt: float | torch.Tensor = 1.0
    order: tuple[int, ...] | None = None
    """Of the state's components, which then have no names; by default positions and velocities."""

    def filter(self, name, **options):
        """The preset for what is stated in these units."""
        entry, area = FILTERS[name], self.length**2
        calm, agile = (ConstantVelocity(q * area / self.time**4) for q in (0.04, 4.0))
        sensor = Position(2.0 * self.length)
        if self.order is not None:
            order, step = list(self.order), torch.tensor(self.dt).double()
            transition, noises = calm.transition(step)[order][:, order], [m.process_noise(step) for m in (calm, agile)]
            calm, agile = (Linear(transition, root=root[order]) for root in noises)
            sensor = LinearSensor(torch.eye(2, 4)[:, order], 4.0)
        if entry.scans:
            options |= {"clutter": Clutter(volume=1e5 * area, rate=3.0), "detection": 0.9}
            if name != "jpda":
                options["gate"] = Euclidean(60.0 * self.length)
        if entry.constant_gains:
            options |= {"period": self.time, "max_acceleration": 60.0 * self.length / self.time**2}
        if name == "gpb" and "self_transition" not in options:
            *seconds, measurements = MANOEUVRES["some"]["durations"]
            options |= {"durations": [*(self.time * s for s in seconds), measurements]}
        bank = Bank([calm, agile], neighbours=[[1], [0]], first=[0, 1])
        return entry.preset(bank if entry.bank else calm, sensor, **options)

    @property
    def units(self):
        """``(4,)`` of the state."""
        speed = self.length / self.time
        return torch.tensor([self.length, self.length, speed, speed], dtype=torch.float64)

    def run(self, f):
        """The estimate; of a filter for scans, of its scans."""
        root = (torch.tensor([5.0, 5.0, 3.0, 3.0]).double() * self.units).diag()
        if self.order is not None:
            root = root[list(self.order)]
        with torch.no_grad():
            return f(self.z, Gaussian(self.mean, root.expand(*self.mean.shape, 4)), dt=self.time * self.dt)


def problem(seed, scans=False):
    """Three runs, of two targets where a filter takes scans: these have missed detections and clutter."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    start = torch.cat([30 * normal(RUNS, TARGETS, 2), 4 * normal(RUNS, TARGETS, 2)], -1)
    speed = start[:, :, None, 2:].repeat(1, 1, STEPS, 1)
    speed[:, :, STEPS // 2 :] = speed[:, :, STEPS // 2 :].flip(-1) + 6.0
    z = start[:, :, None, :2] + speed.cumsum(2) + 2.0 * normal(RUNS, TARGETS, STEPS, 2)
    z[1, :, 3] += 60.0 * normal(TARGETS, 2)
    mean = start + normal(RUNS, TARGETS, 4)
    if scans:
        false = 60.0 * normal(RUNS, STEPS, 2, 2)
        z = torch.cat([z.transpose(1, 2), false], 2)
        z[2, 4, 0] = math.nan
        return Problem(z, mean)
    z, mean = z[:, 0], mean[:, 0]
    z[2, 4] = math.nan
    return Problem(z, mean)


def same(one, other, units, shift=None, turn=None, share=1e-7):
    """Asserts that two estimates agree to a share of the standard deviation, the first in units of the second."""
    mean, root = one.mean * units, units.unsqueeze(-1) * one.scale_tril
    if turn is not None:
        mean, root = mean @ turn.T, turn @ root
    if shift is not None:
        mean = mean + shift
    std = root.norm(dim=-1)
    torch.testing.assert_close((mean - other.mean) / std, torch.zeros_like(std), rtol=0, atol=share)
    spread, expected = (r @ r.mT / (std.unsqueeze(-1) * std.unsqueeze(-2)) for r in (other.scale_tril, root))
    torch.testing.assert_close(spread, expected, rtol=0, atol=share)


every = pytest.mark.parametrize("name", FILTERS)


@cache
def told(name):
    """The problem, and what a filter says of it."""
    p = problem(1, FILTERS[name].scans)
    return p, p.run(p.filter(name))


@every
def test_the_unit_of_length_changes_nothing(name):
    (p, whole), unit = told(name), 2.0**-20
    other = replace(p, z=p.z * unit, mean=p.mean * unit, length=unit)
    same(whole, other.run(other.filter(name)), other.units)


@every
def test_the_unit_of_time_changes_nothing(name):
    p, options = told(name)[0], TIME.get(name, {})
    other = replace(p, time=2.0**6)
    other = replace(other, mean=p.mean * other.units)
    whole = p.run(p.filter(name, **options)) if options else told(name)[1]
    same(whole, other.run(other.filter(name, **options)), other.units)


@pytest.mark.parametrize("name", TIME)
def test_the_unit_of_time_counts_for_fading_factors_as_published(name):
    p, whole = told(name)
    other = replace(p, time=16.0)
    other = replace(other, mean=p.mean * other.units)
    assert ((whole.mean * other.units - other.run(other.filter(name)).mean) / other.units).abs().max() > 1e-3


@every
def test_the_origin_changes_nothing(name):
    (p, whole), shift = told(name), torch.tensor([640.0, -130.0, 0, 0], dtype=torch.float64)
    same(whole, replace(p, z=p.z + shift[:2], mean=p.mean + shift).run(p.filter(name)), p.units, shift)


@every
def test_axes_may_be_swapped_and_point_the_other_way(name):
    (p, whole), turn = told(name), torch.block_diag(*[torch.tensor([[0.0, -1], [-1, 0]], dtype=torch.float64)] * 2)
    same(whole, replace(p, z=p.z @ turn[:2, :2].T, mean=p.mean @ turn.T).run(p.filter(name)), p.units, turn=turn)


@pytest.mark.parametrize("name", ROTATED)
def test_axes_may_be_turned_where_measurements_are_weighed_as_a_whole(name):
    (p, whole), (c, s) = told(name), (math.cos(2.5), math.sin(2.5))
    turn = torch.block_diag(*[torch.tensor([[c, -s], [s, c]], dtype=torch.float64)] * 2)
    same(whole, replace(p, z=p.z @ turn[:2, :2].T, mean=p.mean @ turn.T).run(p.filter(name)), p.units, turn=turn)


@pytest.mark.parametrize("name", ANY_STATE)
def test_components_of_the_state_may_be_in_any_order(name):
    p, order = replace(problem(1), order=(0, 1, 2, 3)), [3, 1, 0, 2]
    other = replace(p, mean=p.mean[:, order], order=tuple(order))
    whole = p.run(p.filter(name))
    whole = whole._replace(mean=whole.mean[..., order], scale_tril=whole.scale_tril[..., order, :])
    same(whole, other.run(other.filter(name)), p.units[order])


def test_the_order_of_components_counts_where_a_prediction_is_weighed_by_elements():
    p, order = replace(problem(1), order=(0, 1, 2, 3)), [3, 1, 0, 2]
    other = replace(p, mean=p.mean[:, order], order=tuple(order))
    whole, swapped = (x.run(x.filter("hghckf1")).mean for x in (p, other))
    assert (whole[..., order] - swapped).abs().max() > 1.0


@every
def test_the_order_of_tracks_is_that_of_the_estimates(name):
    (p, whole), order = told(name), [2, 0, 1]
    other = replace(p, z=p.z[order], mean=p.mean[order]).run(p.filter(name))
    same(whole._replace(mean=whole.mean[order], scale_tril=whole.scale_tril[order]), other, p.units, share=1e-9)


@pytest.mark.parametrize("name", ONE_MOTION)
def test_a_time_without_measurements_may_be_cut_anywhere(name):
    """With process noise that is white in time."""
    p, share = problem(11), 0.3
    f = FILTERS[name].preset(ConstantVelocity(0.04, continuous=True), Position(2.0))
    dt = torch.ones(STEPS, dtype=torch.float64)
    dt[6] = 7.0
    cut = torch.cat([dt[:6], torch.tensor([share * 7.0, (1 - share) * 7.0], dtype=torch.float64), dt[7:]])
    z = torch.cat([p.z[:, :6], torch.full_like(p.z[:, :1], math.nan), p.z[:, 6:]], 1)
    whole, other = replace(p, dt=dt).run(f), replace(p, z=z, dt=cut).run(f)
    kept = [i for i in range(STEPS + 1) if i != 6]
    same(whole, other._replace(mean=other.mean[:, kept], scale_tril=other.scale_tril[:, kept]), p.units)


@pytest.mark.parametrize("name", LINEAR)
def test_a_measurement_is_as_several_equal_ones_with_so_much_more_noise(name):
    p, times = problem(11), 3
    once = FILTERS[name].preset(ConstantVelocity(0.04), Position(2.0))
    often = FILTERS[name].preset(ConstantVelocity(0.04), Position(2.0 * math.sqrt(times)))
    dt = torch.zeros(STEPS, times, dtype=torch.float64)
    dt[:, 0] = 1.0
    other = replace(p, z=p.z.repeat_interleave(times, 1), dt=dt.flatten()).run(often)
    last = slice(times - 1, None, times)
    same(p.run(once), other._replace(mean=other.mean[:, last], scale_tril=other.scale_tril[:, last]), p.units)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, entry in FILTERS.items() if entry.scans])
def test_compiled_filters_of_scans_keep_the_same(name):
    """Origin, quarter turns and the order of tracks, by one kernel; others say what eager ones say: random settings."""
    p = problem(11, scans=True)
    f, shift = p.filter(name).compile(), torch.tensor([640.0, -130.0, 0, 0], dtype=torch.float64)
    whole, turn = p.run(f), torch.block_diag(*[torch.tensor([[0.0, -1], [1, 0]], dtype=torch.float64)] * 2)
    same(whole, replace(p, z=p.z + shift[:2], mean=p.mean + shift).run(f), p.units, shift)
    same(whole, replace(p, z=p.z @ turn[:2, :2].T, mean=p.mean @ turn.T).run(f), p.units, turn=turn)
    flipped = whole._replace(mean=whole.mean.flip(0), scale_tril=whole.scale_tril.flip(0))
    same(flipped, replace(p, z=p.z.flip(0), mean=p.mean.flip(0)).run(f), p.units)

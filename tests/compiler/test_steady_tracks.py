"""A long track of a linear filter computes roots and gains until they have converged, and says what it would anyway."""

import math

import pytest
import torch
from test_long_tracks import MOTION, PRIOR, SENSOR, batched, check_same, in_a_batch, track

from torchfra import Gaussian, motion, presets, sensors
from torchfra.compiler import steady

STEPS = 9000


@pytest.fixture(autouse=True)
def stretches(monkeypatch):
    """How many steps were steady, of those of each long track that ran so; None if it did not."""
    ran = []

    class Counted(steady.Track):
        def __call__(self, state):
            count, run = [0], self.run

            def counted(kind, first, last, state):
                count[0] += (last - first) * (kind == "steady")
                return run(kind, first, last, state)

            self.run = counted
            done = super().__call__(state)
            ran.append(None if done is None else count[0])
            return done

    monkeypatch.setattr("torchfra.compiler.run.Track", Counted)
    return ran


@pytest.mark.parametrize("name", ["srckf", "ukf", "ekf"])
def test_a_steady_track_is_filtered_and_smoothed_as_one_of_a_batch_is(name, stretches):
    f, z = getattr(presets, name)(MOTION, SENSOR).compile(), track(STEPS)
    z[3000:3010], z[5000, 1] = torch.nan, torch.nan
    check_same(f(z, PRIOR), batched(f(in_a_batch(z), PRIOR)))
    check_same(f.smooth(z, PRIOR), batched(f.smooth(in_a_batch(z), PRIOR)))
    assert len(stretches) == 3  # the filter twice, and backwards
    assert all(count > 0.9 * STEPS for count in stretches)


def test_what_is_given_for_each_step_may_change_now_and_then(stretches):
    f, z = presets.srckf(MOTION, SENSOR).compile(), track(STEPS)
    dt = torch.ones(STEPS).double()
    dt[4000:] = 2.0
    std = torch.ones(STEPS, 2).double()
    std[6000] = 50.0
    u = torch.zeros(STEPS, 1).double()
    for more in ({"dt": dt}, {"std": std}, {"dt": dt, "std": std}, {"u": u}, {"noise": torch.diag_embed(std)}):
        check_same(f(z, PRIOR, **more), batched(f(in_a_batch(z), PRIOR, **more)))
    check_same(f.smooth(z, PRIOR, dt=dt, std=std), batched(f.smooth(in_a_batch(z), PRIOR, dt=dt, std=std)))
    assert len(stretches) == 7
    assert all(0.9 * STEPS < count < STEPS for count in stretches)


def test_a_track_runs_so_only_where_that_is_worth_it(stretches):
    f, z = presets.srckf(MOTION, SENSOR).compile(), track(STEPS)
    z[::50] = torch.nan
    check_same(f(z, PRIOR), batched(f(in_a_batch(z), PRIOR)))
    check_same(f(track(STEPS), PRIOR, dt=1 + torch.arange(STEPS) % 2), batched(
        f(in_a_batch(track(STEPS)), PRIOR, dt=1 + torch.arange(STEPS) % 2)))  # fmt: skip
    forgets_slowly = presets.srckf(motion.ConstantVelocity(1e-12), SENSOR).compile()
    check_same(forgets_slowly(track(STEPS), PRIOR), batched(forgets_slowly(in_a_batch(track(STEPS)), PRIOR)))
    assert stretches == [None] * 3
    turning = presets.srckf(motion.CoordinatedTurn(0.1, 1.0), SENSOR).compile()
    check_same(turning(track(STEPS), PRIOR), batched(turning(in_a_batch(track(STEPS)), PRIOR)))


def test_a_covariance_that_goes_round_has_not_converged(stretches):
    """Two states that nobody measures turn by a right angle at each step, without noise."""
    moves = [[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]]
    sensor = sensors.Linear([[1, 0, 0, 0]], [1.0])
    f = presets.srckf(motion.Linear(moves, [0.1, 0.1, 0, 0]), sensor).compile()
    z, prior = track(STEPS)[:, :1], Gaussian.from_std([0.0] * 4, [1.0, 1.0, 4.0, 1.0])
    std = f(z, prior).covariance.diagonal(dim1=-2, dim2=-1)[:, 2:].sqrt()
    at = (torch.arange(STEPS) + 1) % 2 == 0
    expected = torch.where(at[:, None], torch.tensor([4.0, 1.0]), torch.tensor([1.0, 4.0])).to(std)
    torch.testing.assert_close(std, expected)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_random_tracks_are_those_of_a_batch(seed, stretches):
    generator = torch.Generator().manual_seed(seed)

    def drawn(least, most):
        share = torch.rand((), generator=generator, dtype=torch.float64)
        return float(math.exp(math.log(least) + float(share) * math.log(most / least)))

    steps, dims, q, std = int(drawn(8192, 20_000)), 1 + seed % 3, drawn(1e-2, 1e2), drawn(0.1, 10.0)
    dtype = torch.float32 if seed == 3 else torch.float64
    moves = (motion.ConstantVelocity, motion.ConstantAcceleration)[seed % 2](q, dims)
    z = std * torch.randn(steps, dims, generator=generator, dtype=torch.float64)
    gaps = torch.randint(steps, (seed,), generator=generator)
    z[gaps] = torch.nan
    if seed:
        z[gaps[0] : gaps[0] + 200, 0] = torch.nan
    z, n = z.to(dtype), moves.size
    prior = Gaussian(torch.zeros(n, dtype=dtype), std * torch.eye(n, dtype=dtype))
    f = presets.srckf(moves, sensors.Position(std, dims=dims)).compile()
    dt = drawn(0.1, 10.0)
    for one, two in ((m(z, prior, dt=dt), batched(m(in_a_batch(z), prior, dt=dt))) for m in (f, f.smooth)):
        spread = two.scale_tril.norm(dim=-1)
        apart = 1e-8 if dtype == torch.float64 else 1e-2
        assert ((one.mean - two.mean).abs() / spread).max() < apart
        assert ((one.scale_tril - two.scale_tril).abs().amax(-1) / spread).max() < apart
    assert len(stretches) == 3  # whether roots come back within so many steps is a matter of rounding

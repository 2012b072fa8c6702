"""Joint association keeps the promises of a filter that the battery does not ask for, and says what it found."""

import pytest
import torch
from joint import STEPS, flat_prior, make, plane
from one_graph import needs_one_graph

from torchfra import presets
from torchfra.association import ChiSquare, Clutter, Euclidean
from torchfra.filters import JPDA, SRCKF
from torchfra.types import Gaussian


def test_hyperparameters_may_differ_between_targets_and_scenes(crossing, scans):
    values = torch.tensor([[0.8, 0.9], [0.7, 0.95], [0.6, 0.99]], dtype=torch.float64)
    together = make("iaukf_jpda", crossing, detection=values, forgetting=values)(scans.z, scans.prior)
    prior = Gaussian(scans.prior.mean[1], scans.prior.scale_tril[1])
    alone = make("iaukf_jpda", crossing, detection=values[1], forgetting=values[1])(scans.z[1], prior)
    torch.testing.assert_close(alone.mean, together.mean[1], rtol=1e-9, atol=1e-12)
    same = make(
        "iaukf_jpda", crossing, detection=values[:, :1], gate=Euclidean(torch.tensor([[90.0], [150.0], [200.0]]))
    )
    prior = Gaussian(scans.prior.mean[2], scans.prior.scale_tril[2])
    alone = make("iaukf_jpda", crossing, detection=0.6, gate=Euclidean(200.0))(scans.z[2], prior)
    torch.testing.assert_close(alone.mean, same(scans.z, scans.prior).mean[2], rtol=1e-9, atol=1e-12)


def test_what_was_handed_in_stays_as_it_was(crossing):
    inner = SRCKF(crossing.motion, crossing.sensor)
    f = JPDA(inner, gate=Euclidean(), clutter=Clutter(1.0))
    assert f.inner is not inner
    make("iaukf_jpda", crossing, learn="all")
    for part in (inner, crossing.clutter, crossing.motion, crossing.sensor):
        assert all(h.shared_dims == 0 and not h.raw.requires_grad for h in part.modules() if hasattr(h, "shared_dims"))


def test_values_of_scenes_work_with_scans_of_one():
    z = torch.randn(6, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    prior, values = flat_prior((0.0, 0.0), (3.0, 1.0)), torch.tensor([[0.9], [0.8], [0.7]], dtype=torch.float64)
    for options, alone in (
        ({"detection": values}, {"detection": 0.8}),
        ({"clutter": Clutter(1e4, rate=10 * values)}, {"clutter": Clutter(1e4, rate=8.0)}),
        ({"clutter": Clutter(1e4 * values)}, {"clutter": Clutter(8e3)}),
        ({"gate": ChiSquare(values)}, {"gate": ChiSquare(0.8)}),
    ):
        together, one = plane(**options)(z, prior), plane(**alone)(z, prior)
        torch.testing.assert_close(together.mean[1], one.mean)
        state, _ = plane(**options).step(plane(**options).init(prior), z[0])
        torch.testing.assert_close(state.belief.mean[1], one.mean[:, 0])


def test_a_gate_that_is_replaced_later_has_values_of_each_scene_too():
    z = torch.randn(6, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    prior, values = flat_prior((0.0, 0.0), (3.0, 1.0)), torch.tensor([[0.9], [0.5], [0.1]], dtype=torch.float64)
    later = plane()
    later.gate = ChiSquare(values)
    torch.testing.assert_close(later(z, prior).mean, plane(gate=ChiSquare(values))(z, prior).mean)


def test_info_counts_repairs_and_holds_the_weights_of_robust_filters(crossing, scans):
    robust = presets.jpda(crossing.motion, crossing.sensor, clutter=crossing.clutter, inner=presets.rsrckf)
    info = robust(scans.z, scans.prior).info
    assert info.weights.shape == (3, 2, STEPS, 8, 3)
    assert info.repaired is None
    high = presets.jpda(crossing.motion, crossing.sensor, clutter=crossing.clutter, inner=presets.ghckf)
    assert high(scans.z, scans.prior).info.repaired.shape == (3, 2, STEPS)


@needs_one_graph
@pytest.mark.slow
def test_torch_compile_sees_a_step_as_it_is(crossing, scans):
    f = make("iaukf_jpda", crossing)
    state = f.init(scans.prior)
    fast = torch.compile(f.step, backend="eager", fullgraph=True)
    torch.testing.assert_close(fast(state, scans.z[:, 0])[0].belief.mean, f.step(state, scans.z[:, 0])[0].belief.mean)


def test_residuals_may_tell_the_noise(crossing, scans):
    z = crossing.simulate(3, 3).z[:, :25]  # until the noise has grown
    estimate = make("iaukf_jpda", crossing, adapt="residual")(z, scans.prior)
    assert estimate.info.noise[:, :, -1].mean() > 2
    assert not estimate.failed.any()

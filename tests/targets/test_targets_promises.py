"""Whatever a manager of targets does: scenes are independent, a saved stream goes on, and all values have gradients."""

import pytest
import torch
from joint import plane
from test_targets import FOUR, moving, run, with_clutter

from torchfra import presets, tree
from torchfra.association import ChiSquare
from torchfra.targets import (
    ClutterMap,
    Deletion,
    Existence,
    Extent,
    Merging,
    MOfN,
    OnePoint,
    Stitching,
    Targets,
    TwoPoint,
    Visibility,
    collect,
)

RULES = {
    "births at two points": {"birth": TwoPoint(20.0), "merging": Merging()},
    "regimes": {"birth": TwoPoint(20.0), "f": {"inner": presets.gpb}},
    "existence": {"birth": OnePoint(5.0), "confirmation": Existence(), "merging": Merging()},
    "existence at two points": {"birth": TwoPoint(20.0), "confirmation": Existence()},
    "a map of clutter": {"birth": OnePoint(5.0), "clutter_map": ClutterMap(2.0)},
    "extents": {"birth": OnePoint(5.0), "extent": Extent(), "stitching": Stitching(20.0, 50.0)},
    "late scans": {"birth": OnePoint(5.0), "lag": 3.0},
    "linked detections": {"birth": OnePoint(5.0), "linkage": {None: 5.0}},
    "visibility": {
        "birth": TwoPoint(20.0), "confirmation": Existence(60.0), "visibility": {None: Visibility(20.0, 8.0)},
    },
    "tracks that were lost": {
        "birth": OnePoint(8.0), "confirmation": MOfN(3, 4), "deletion": Deletion(2), "stitching": Stitching(12.0, 60.0),
    },
}  # fmt: skip
every = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name == "regimes" else []) for name in RULES]
)


def made(name, **options):
    """The filter that is handed in, and the manager."""
    rules = dict(RULES[name])
    f = plane(gate=ChiSquare(0.999), **rules.pop("f", {}), **options)
    return f, Targets(f, **rules)


def scenes(count=1, steps=14):
    """Four targets that nobody sees for some scans, among false measurements."""
    z = torch.stack([with_clutter(moving(FOUR, steps, seed=s)[1], 3, 150.0, s) for s in range(count)])
    z[:, 7:10, :4] = torch.nan
    return z


@every
def test_scenes_are_those_that_each_is_alone_and_as_a_stream_of_scans(name):
    (_, targets), z = made(name), scenes(2)
    together = targets(z)
    for i, scene in enumerate(z):
        alone, states = targets(scene), run(targets, scene)
        K = alone.identity.shape[-1]
        assert K
        assert together.identity[i, :K].tolist() == alone.identity.tolist()
        assert (together.identity[i, K:] == -1).all()
        torch.testing.assert_close(together.mean[i, :K], alone.mean, equal_nan=True, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(together.log_likelihood[i, :K], alone.log_likelihood)
        torch.testing.assert_close(collect(states), alone, equal_nan=True)
        for t, state in enumerate(states):
            there, order = alone.confirmed[:, t], state.identity.argsort()
            assert state.identity[order].tolist() == alone.identity[there].tolist()
            torch.testing.assert_close(state.confirmed.mean[order], alone.mean[there, t])
            torch.testing.assert_close(state.confirmed.scale_tril[order], alone.scale_tril[there, t])


@every
def test_a_stream_that_was_saved_goes_on_to_the_same_bits(name, tmp_path):
    (_, targets), (z,) = made(name), scenes()
    state = run(targets, z[:9])[-1]
    torch.save(targets.saved(state), tmp_path / "targets.pt")
    again = targets.restored(torch.load(tmp_path / "targets.pt", weights_only=True))
    for scan in z[9:]:
        state, again = targets.step(state, scan), targets.step(again, scan)
    for one, other in zip(tree.flatten(state), tree.flatten(again), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


@every
def test_gradients_flow_through_the_lives_of_targets(name):
    f, targets = made(name, learn=("detection", "std"))
    estimate = targets(scenes()[0])
    (estimate.log_likelihood.sum() + estimate.mean[estimate.confirmed].sum()).backward()
    assert all(p.grad.isfinite().all() and p.grad.abs().sum() > 0 for p in targets.filter.parameters())
    assert all(p.grad is None for p in f.parameters())  # a copy runs

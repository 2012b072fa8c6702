"""Several detections of one target in a scan are one measurement, and one target."""

import math

import numpy as np
import pytest
import torch
from joint import plane
from oracles.detections import linked as by_loops

from torchfra import presets
from torchfra.association import Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Bearings, Position, RangeBearing
from torchfra.targets import MOfN, OnePoint, Targets
from torchfra.targets.detections import linked
from torchfra.targets.scan import SceneScan

NOISE = torch.tensor([[2.0, 0.0], [0.6, 1.5]]).double()


def hull(steps=12, seed=0, at=((0.0, 0.0, 4.0, 1.0), (0.0, 60.0, 4.0, -1.0))):
    """Four detections on each of two hulls, 8 m long, as they move: ``(T, 8, 2)``."""
    rng, along = torch.Generator().manual_seed(seed), torch.tensor([-4.0, -1.5, 1.5, 4.0]).double()
    start, t = torch.tensor(at).double(), torch.arange(float(steps)).double().reshape(-1, 1, 1)
    centre = start[:, :2] + t * start[:, 2:]
    z = centre.unsqueeze(2) + torch.stack([along, 0.0 * along], -1)
    z = z + 0.5 * torch.randn(z.shape, generator=rng).double()
    return z.flatten(1, 2), centre


def manager(linkage=None, **options):
    f = plane(clutter=Clutter(1e4, rate=1.0))
    return Targets(f, birth=OnePoint(5.0), confirmation=MOfN(3, 4), linkage=linkage, **options)


@pytest.mark.parametrize("known", ["the sensor's", "std", "noise", "a sensor with correlated noise"])
def test_linked_detections_are_those_of_plain_loops(known):
    rng = np.random.default_rng(3)
    z = [30.0 * rng.random((J, 2)) for J in (14, 9)]
    scan = torch.full((2, 14, 2), math.nan).double()
    for scene, x in zip(scan, z, strict=True):
        scene[: len(x)] = torch.from_numpy(x)
    std = torch.from_numpy(rng.uniform(0.5, 3.0, (2, 14, 2)))
    sensor, options = Position(2.0), {}
    if known == "std":
        options = {"std": std}
    elif known == "noise":
        options = {"noise": std.unsqueeze(-1) * NOISE}
    elif known != "the sensor's":
        sensor = Position(noise=NOISE)
    given = SceneScan(scan, torch.ones(2).double(), None, **options)
    found = linked(sensor, given, 5.0)
    for r, x in enumerate(z):
        R = [4.0 * np.eye(2)] * 14
        if "noise" in known:
            R = [(a @ a.T).numpy() for a in (options["noise"][r] if options else [NOISE] * 14)]
        elif options:
            R = [np.diag(a.numpy() ** 2) for a in std[r]]
        expected = by_loops(x, R, 5.0)
        assert 2 < len(expected) < len(x)
        assert (~found.z[r].isnan().any(-1)).nonzero()[:, 0].tolist() == sorted(first for first, _, _ in expected)
        for first, mean, covariance in expected:
            np.testing.assert_allclose(found.z[r, first], mean, rtol=1e-10)
            if "noise" in known:
                np.testing.assert_allclose(found.noise[r, first] @ found.noise[r, first].mT, covariance, rtol=1e-9)
            else:
                np.testing.assert_allclose(found.std[r, first] ** 2, np.diag(covariance), rtol=1e-9)


def test_a_hull_with_many_detections_is_one_target():
    z, centre = hull()
    plain, one = manager()(z), manager({None: 5.0})(z)
    assert len(plain.identity) > 2
    assert one.identity.tolist() == [0, 1]
    gap = (one.mean[:, -1, :2] - centre[-1]).norm(dim=-1)
    assert (gap < 3.0).all()


def test_detections_farther_than_that_stay_as_they_are():
    z = hull()[0]
    apart = torch.cat([z[:, :1], z[:, 4:5]], 1)
    alone, linkage = manager()(apart), manager({None: 5.0})(apart)
    torch.testing.assert_close(alone.mean, linkage.mean, equal_nan=True)
    nothing = SceneScan(torch.full((1, 3, 2), math.nan).double(), torch.ones(1).double(), None)
    assert linked(Position(2.0), nothing, 5.0) is nothing


def test_a_detection_with_a_missing_element_is_linked_to_nothing():
    z = torch.tensor([[[0.0, 0.0], [1.0, math.nan], [1.0, 1.0]]]).double()
    found = linked(Position(2.0), SceneScan(z, torch.ones(1).double(), None), 5.0).z[0]
    torch.testing.assert_close(found[0], torch.tensor([0.5, 0.5]).double())
    assert found[1, 0] == 1.0
    assert found[2].isnan().all()


def test_bearings_on_both_sides_of_half_a_turn_have_their_mean_there():
    z = torch.tensor([[[100.0, math.pi - 0.01], [100.0, -math.pi + 0.02]]], dtype=torch.float64)
    sensor = RangeBearing(torch.tensor([1.0, 0.01], dtype=torch.float64))
    found = linked(sensor, SceneScan(z, torch.ones(1).double(), None), 5.0)
    assert math.cos(found.z[0, 0, 1] - (math.pi + 0.005)) == pytest.approx(1.0, abs=1e-12)
    assert found.std[0, 0, 1].item() == pytest.approx(math.hypot(0.01, 0.015), rel=1e-9)


def test_only_the_scans_of_the_sensor_that_is_named_are_linked():
    lidar = presets.jpda(ConstantVelocity(0.5), Position(1.0), clutter=Clutter(1e4, rate=1.0), detection=0.9)
    targets = manager({"lidar": 5.0}, sensors={"lidar": lidar})
    z = hull()[0][0]
    assert len(targets.step(targets.init(), z, sensor="lidar").track.identity) == 2
    assert len(targets.step(targets.init(), z).track.identity) == 8


CAMERA = presets.jpda(
    ConstantVelocity(0.5), Bearings(0.01, count=1), clutter=Clutter(extent=[6.3], rate=0.5), detection=0.9
)  # fmt: skip


@pytest.mark.parametrize(
    ("linkage", "said"),
    [
        ({"radar": 5.0}, "linkage: expected some of None, camera, received 'radar'"),
        (5.0, "linkage: expected a dict by the name of a sensor, received 5.0"),
        ({None: 0.0}, "linkage: expected finite metres above 0 of None, received 0.0"),
        ({None: True}, "linkage: expected finite metres above 0 of None, received True"),
        ({"camera": 5.0}, "linkage: expected a sensor that measures where a target is, received bearings"),
    ],
)
def test_what_cannot_be_linked_is_said(linkage, said):
    with pytest.raises(ValueError, match=said):
        manager(linkage, sensors={"camera": CAMERA})

"""A motion at a level is the motion in the plane, and beside it a height that walks."""

import pytest
import torch

from torchfra import check_model, presets
from torchfra.motion import Bank, ConstantVelocity, CurrentStatistical, Level, Odometry, RandomWalk
from torchfra.sensors import Position, Pseudoranges
from torchfra.types import Gaussian

STEPS = 9
PLANES = {
    "linear": (ConstantVelocity(0.3), None),
    "odometry": (Odometry(0.1, 0.01, 1e-4, 1e-5), torch.tensor([3.0, 0.2], dtype=torch.float64).expand(STEPS, 2)),
}


@pytest.mark.parametrize("plane", PLANES)
def test_positions_in_space_are_filtered_as_those_in_the_plane_and_heights(plane):
    rng = torch.Generator().manual_seed(1)
    (motion, u), z = PLANES[plane], torch.randn(STEPS, 3, dtype=torch.float64, generator=rng).cumsum(0)
    dt, n = 0.5 + torch.rand(STEPS, dtype=torch.float64, generator=rng), motion.size
    level = Level(motion, 0.2)
    prior = Gaussian(torch.zeros(n + 1, dtype=torch.float64), torch.eye(n + 1, dtype=torch.float64))
    e = presets.ekf(level, Position(1.0, dims=3))(z, prior, dt=dt, u=u)
    flat = Gaussian(prior.mean[:n], prior.scale_tril[:n, :n])
    expected = presets.ekf(motion, Position(1.0))(z[:, :2], flat, dt=dt, u=u)
    height = presets.ekf(RandomWalk(0.2, 1), Position(1.0, dims=1))(
        z[:, 2:], Gaussian(prior.mean[:1], prior.scale_tril[:1, :1]), dt=dt
    )
    of_plane = [i for i in range(n + 1) if i != 2]
    near = {"rtol": 1e-9, "atol": 1e-9}
    torch.testing.assert_close(e.mean[:, of_plane], expected.mean, **near)
    torch.testing.assert_close(e.covariance[:, of_plane][:, :, of_plane], expected.covariance, **near)
    torch.testing.assert_close(e.mean[:, 2], height.mean[:, 0], **near)
    assert level.measures_itself == motion.measures_itself


def test_nothing_is_wrong_with_it():
    u = torch.tensor([3.0, 0.2], dtype=torch.float64)
    report = check_model(Level(Odometry(0.1, 0.01, 1e-4, 1e-5), 0.1), Position(1.0, dims=3), u=u)
    assert report.ok, report


def test_clocks_stand_behind_it():
    motion = Level(ConstantVelocity(0.3), 0.1)
    assert motion.components == ("x", "y", "height", "vx", "vy")
    with pytest.raises(ValueError, match="clock"):
        presets.srckf(motion, Pseudoranges(4, 1.0, clock=3))


@pytest.mark.parametrize("motion", [
    ConstantVelocity(1.0, 3), CurrentStatistical(0.1, 1.0), Bank([ConstantVelocity(1.0), ConstantVelocity(2.0)]),
])  # fmt: skip
def test_what_is_not_in_the_plane_is_refused(motion):
    with pytest.raises(ValueError, match="motion: expected"):
        Level(motion, 0.1)

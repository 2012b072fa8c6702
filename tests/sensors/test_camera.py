"""A pinhole camera sees a target at the pixel that its pose says."""

import copy
import math

import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Camera, facing


def tensor(*rows):
    return torch.tensor(rows, dtype=torch.float64)


NORTH = facing([0, 0, 0], [0, 1, 0])
POSE = {"position": [10.0, -20.0, 5.0], "rotation": facing([10, -20, 5], [0, 100, 0])}


def test_a_camera_that_looks_north_has_east_on_its_right_and_the_ground_below():
    assert NORTH.tolist() == [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    camera = Camera(800.0, 1.0, centre=[320.0, 240.0], position=[0, 0, 0], rotation=NORTH)
    x = tensor([0, 50, 0, 9], [5, 50, 0, 9], [0, 50, -5, 9], [-10, 100, 20, 9])
    torch.testing.assert_close(camera(x), tensor([320, 240], [400, 240], [320, 320], [240, 80]))
    wide = Camera(tensor(800, 400), 1.0, position=[0, 0, 0], rotation=NORTH)
    torch.testing.assert_close(wide(tensor(5, 50, -5)), tensor(80, 40))


def test_the_point_that_a_camera_faces_is_in_the_middle_and_rows_of_the_image_run_downwards():
    camera = Camera(800.0, 1.0, centre=[320.0, 240.0], **POSE)
    torch.testing.assert_close(camera(tensor(0, 100, 0)), tensor(320, 240))
    assert camera(tensor(0, 100, 1))[1] < 240 < camera(tensor(0, 100, -1))[1]
    turn = POSE["rotation"]
    torch.testing.assert_close(turn @ turn.mT, torch.eye(3).double())
    assert torch.linalg.det(turn).item() == pytest.approx(1.0)


def test_pixels_are_those_of_the_projection_matrix():
    rng = torch.Generator().manual_seed(0)
    x = torch.randn(50, 3, generator=rng, dtype=torch.float64) + tensor(0, 100, 0)
    inner = tensor([800, 0, 320], [0, 800, 240], [0, 0, 1])
    turn, place = POSE["rotation"], tensor(*POSE["position"])
    projection = inner @ torch.cat([turn, -(turn @ place).unsqueeze(-1)], -1)
    homogeneous = torch.cat([x, torch.ones(50, 1).double()], -1) @ projection.mT
    expected = homogeneous[:, :2] / homogeneous[:, 2:]
    torch.testing.assert_close(Camera(800.0, 1.0, centre=[320, 240], **POSE)(x), expected)


def test_a_pose_may_come_with_each_step_and_a_height_may_be_known():
    x = tensor([0, 100, 3], [5, 90, 3])
    fixed = Camera(800.0, 1.0, **POSE)
    u = torch.cat([tensor(*POSE["position"]), POSE["rotation"].flatten()])
    torch.testing.assert_close(Camera(800.0, 1.0)(x, u.expand(2, -1)), fixed(x))
    torch.testing.assert_close(Camera(800.0, 1.0, height=3.0, **POSE)(x[:, :2]), fixed(x))
    assert (Camera(800.0, 1.0).dims, Camera(800.0, 1.0, height=3.0).dims) == (3, 2)


def test_gradients_are_those_of_finite_differences_and_the_focal_length_learns():
    x = tensor([0, 100, 0], [5, 90, 2]).requires_grad_()
    assert torch.autograd.gradcheck(Camera(80.0, 1.0, **POSE), x)
    f = presets.srckf(ConstantVelocity(1.0, 3), Camera(80.0, 1.0, **POSE), learn=("focal",))
    prior = Gaussian(tensor(0, 100, 0, 0, 0, 0), 5 * torch.eye(6).double())
    f(tensor([1, 2], [2, 2]), prior).mean.sum().backward()
    assert f.sensor.focal.raw.grad.abs() > 0


def test_two_cameras_find_a_target_in_space_eager_and_compiled():
    rng = torch.Generator().manual_seed(0)
    poses = torch.stack([torch.cat([p, facing(p, [0, 100, 20]).flatten()]) for p in tensor([-50, 0, 5], [60, 0, 5])])
    u = poses.repeat(20, 1)  # one camera after the other
    time = torch.arange(1, 41, dtype=torch.float64).unsqueeze(-1)
    truth = tensor(0, 100, 20) + 0.5 * time * tensor(1, 0.5, 0.1)
    camera = Camera(800.0, 2.0, centre=[320, 240])
    z = camera(truth, u) + 2 * torch.randn(8, 40, 2, generator=rng, dtype=torch.float64)
    z[0, 5:9] = math.nan
    prior = Gaussian(tensor(5, 90, 15, 0, 0, 0), tensor(10, 10, 10, 1, 1, 1).diag())
    f = presets.srckf(ConstantVelocity(1e-4, 3), camera)
    with torch.no_grad():
        slow, fast = (g(z, prior, u=u, dt=1.0).mean for g in (f, copy.deepcopy(f).compile()))
    torch.testing.assert_close(fast, slow, rtol=0, atol=1e-9)
    assert (slow[:, -1, :3] - truth[-1]).norm(dim=-1).max() < 1.0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"position": [0, 0, 0]}, "position, rotation: expected both or neither"),
        ({"focal": torch.ones(3)}, r"focal: expected a number or \(\.\.\., 2\), received \(3,\)"),
        ({"focal": -1.0}, "focal: expected a value above 0"),
        ({"centre": [0, 0, 0]}, r"centre: expected finite numbers \(2,\), received \(3,\)"),
        ({"focal": [1.0, 1.0, 1.0]}, r"focal: expected a number or \(\.\.\., 2\), received \(3,\)"),
        ({"height": "a"}, "height: expected numbers, received 'a'"),
        ({"height": math.inf}, r"height: expected finite numbers \(\), received inf"),
        ({"position": [0, 0, math.nan], "rotation": NORTH}, "position: expected finite numbers .* nan"),
        ({"position": [0, 0, 0], "rotation": 2 * NORTH}, "rotation: expected three directions at right angles"),
        ({"position": [0, 0, 0], "rotation": -NORTH}, "rotation: expected three directions at right angles"),
    ],
)
def test_what_does_not_fit_a_camera_is_named(options, said):
    with pytest.raises(ValueError, match=said):
        Camera(**{"focal": 800.0, "std": 1.0} | options)


def test_a_missing_pose_and_a_camera_without_a_level_are_named():
    with pytest.raises(ValueError, match=r"u: expected a camera's position and rotation, .*12\), received None"):
        Camera(800.0, 1.0)(torch.ones(3))
    with pytest.raises(ValueError, match=r"position: expected \(\.\.\., 3\), received \(2,\)"):
        facing([0, 0], [1, 1])
    for target in ([0, 0, 5], [0, 0, 0]):
        with pytest.raises(ValueError, match="target: expected a point that is neither at the camera nor straight"):
            facing([0, 0, 0], target)

"""A pinhole camera: the pixel at which the target is on its image."""

from __future__ import annotations

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.hyper import Value
from torchfra.numbers import as_numbers
from torchfra.sensors.base import Expected, Sensor, elementwise
from torchfra.sensors.places import finite, from_u, in_space


class Camera(Sensor):
    """The pixel ``[column, row]`` at which a pinhole camera without distortion sees the target.

    It is ``centre + focal [right / depth, down / depth]``, where the target is ``right``, ``down`` and ``depth`` metres
    to the right of the camera, below it and in front of it.  A target that is not in the image is missing, NaN.  For
    points of a belief behind the camera the formula mirrors the target; at depth 0 it is not finite.

    Args:
        focal: focal length in pixels; a number, or ``(2,)`` for columns and rows.
        std: of the measurement noise, pixels; a number or ``(..., 2)``.
        centre: ``(2,)`` the pixel on the camera's axis.
        position: ``(3,)`` where the camera is in the coordinates of the state, m.
        rotation: ``(3, 3)`` whose rows are the directions to the right, downwards and forward, in the coordinates of
            the state; ``facing`` makes one.  Without both, the pose comes with each step: ``u (..., 12)`` is the
            position and then the rotation row by row.
        height: of the target, m, where states are in the plane; otherwise they are in space.
        noise: instead of ``std``, a root of the covariance of correlated measurement noise.

    Raises:
        ValueError: one of ``position`` and ``rotation`` without the other, a ``rotation`` that is no rotation, shapes
            that do not fit, and numbers that are not finite.

    Source: Hartley & Zisserman (2004), "Multiple View Geometry in Computer Vision", section 6.1.
    """

    centre: Tensor
    pose: Tensor | None

    def __init__(
        self,
        focal: Value,
        std: Value | None = None,
        *,
        centre: ArrayLike = (0.0, 0.0),
        position: ArrayLike | None = None,
        rotation: ArrayLike | None = None,
        height: float | None = None,
        noise: Tensor | None = None,
    ) -> None:
        if (position is None) != (rotation is None):
            raise ValueError(f"position, rotation: expected both or neither, received {position!r} and {rotation!r}")
        super().__init__(3 if height is None else 2, [False, False], std, noise)
        self.dims = self.reads
        self.focal = elementwise(focal, 2, "focal")
        self.height = None if height is None else float(finite(height, name="height"))
        pose = None
        if position is not None and rotation is not None:
            place, turn = finite(position, 3, name="position"), _checked(finite(rotation, 3, 3, name="rotation"))
            pose = torch.cat([place, turn.flatten().to(place)])
        self.register_buffer("centre", finite(centre, 2, name="centre"), persistent=False)
        self.register_buffer("pose", pose, persistent=False)

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The positions that it reads."""
        return in_space(self.reads)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The pixel ``(..., 2)`` of states ``(..., 3)`` or longer, with the pose ``u (..., 12)`` if it moves."""
        pose = from_u(u, 12, "a camera's position and rotation") if self.pose is None else self.pose.to(x)
        at = x[..., : self.dims]
        if self.height is not None:
            at = torch.cat([at, torch.full_like(at[..., :1], self.height)], -1)
        offset = (pose[..., 3:].unflatten(-1, (3, 3)) * (at - pose[..., :3]).unsqueeze(-2)).sum(-1)
        pixel: Tensor = self.centre.to(x) + self.focal.elements(x) * offset[..., :2] / offset[..., 2:]
        return pixel

    def describe(self) -> str:
        """A camera, that moves or stands."""
        return "moving camera" if self.pose is None else "camera"


def facing(position: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Tensor:
    """Rotation ``(..., 3, 3)`` of a level camera at ``position (..., 3)`` that looks at ``target (..., 3)``.

    Its rows are the directions to the right, downwards and forward; ``up`` is the direction to the top of the image.

    Raises:
        ValueError: points that are not in space, or a camera that looks along ``up``, or at itself.
    """
    arguments = {"position": position, "target": target, "up": up}
    position, target, up = (as_numbers(x, name).double() for name, x in arguments.items())
    for name, x in zip(arguments, (position, target, up), strict=True):
        if x.shape[-1:] != (3,):
            raise ValueError(f"{name}: expected (..., 3), received {tuple(x.shape)}")
    forward = torch.nn.functional.normalize(target - position, dim=-1)
    right = torch.linalg.cross(*torch.broadcast_tensors(forward, up))
    if not bool((right.norm(dim=-1) > 1e-9 * up.norm(dim=-1)).all()):
        raise ValueError("target: expected a point that is neither at the camera nor straight above or below it")
    right = torch.nn.functional.normalize(right, dim=-1)
    return torch.stack([right, torch.linalg.cross(forward, right), forward], -2)


def _checked(rotation: Tensor) -> Tensor:
    """The rotation, if its rows are three directions at right angles, right-handed."""
    off = (rotation @ rotation.mT - torch.eye(3).to(rotation)).abs().max()
    # Rows that were written with four digits, or computed in float32, are still directions.
    if off > 1e-4 or torch.linalg.det(rotation) < 0:
        raise ValueError(f"rotation: expected three directions at right angles, received {rotation.tolist()}")
    return rotation

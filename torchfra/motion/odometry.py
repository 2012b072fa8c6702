"""Dead reckoning: a vehicle that measures its own motion by wheels, and by a compass or a gyroscope."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.motion.base import Motion
from torchfra.motion.blocks import arc


class Odometry(Motion):
    """Dead reckoning of a vehicle in the plane, from the speed that its wheels measure and its heading or turn rate.

    States ``[x, y, heading error, log scale]`` with a measured heading, and ``[x, y, heading, log scale, rate bias]``
    with a gyroscope: the wheels' speed times ``exp(log scale)`` is the true one; the measured heading plus
    ``heading error`` is the true one, and so is the measured turn rate plus ``rate bias``.  Headings count
    counter-clockwise from +x.  With a gyroscope a step is an arc, with a measured heading it is straight.

    The inputs of a step are ``u (..., 2)``: the speed in m/s over the step that leads to the measurement, and the
    heading in rad or the turn rate in rad/s.  A track fails at a step with NaN there.

    Args:
        position: density of the white noise on each axis of the position, by slip of the wheels, m^2/s.
        heading: density of the white noise on the heading or its error, rad^2/s.
        scale: density of the white noise on the logarithm of the scale, 1/s.
        bias: density of the white noise on the bias of the turn rate, rad^2/s^3; for a gyroscope only.

    Raises:
        ValueError: a density below 0; in a step, ``u`` that is missing or has not two entries.

    Source: Thrun, Burgard & Fox (2005), "Probabilistic Robotics", section 5.4, with errors of the sensors as states.
    """

    measures_itself = True

    def __init__(self, position: Value, heading: Value, scale: Value, bias: Value | None = None) -> None:
        own = ("heading error", "log scale") if bias is None else ("heading", "log scale", "rate bias")
        super().__init__(
            2, 1, None, size=2 + len(own), velocity=slice(0, 0), angles=(2,), components=("x", "y", *own),
            kinds=("position", "position", "angle", "parameter", "bias")[: 2 + len(own)],
        )  # fmt: skip
        self.walk_position = Hyper(position, constraints.nonnegative, finite=True, name="position")
        self.walk_heading = Hyper(heading, constraints.nonnegative, finite=True, name="heading")
        self.walk_scale = Hyper(scale, constraints.nonnegative, finite=True, name="scale")
        self.walk_bias = None if bias is None else Hyper(bias, constraints.nonnegative, finite=True, name="bias")

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` after ``dt (...)`` seconds at the speed and heading or turn rate ``u (..., 2)``."""
        if u is None or u.shape[-1] != 2:
            expected = "(..., 2), speed and " + ("heading" if self.walk_bias is None else "turn rate")
            raise ValueError(f"u: expected {expected}, received {None if u is None else tuple(u.shape)}")
        speed, turned = u.unbind(-1)
        way = speed * x[..., 3].exp() * dt
        if self.walk_bias is None:
            dx, dy = (turned + x[..., 2]).cos() * way, (turned + x[..., 2]).sin() * way
            rest = x[..., 2:]
        else:
            turn = (turned + x[..., 4]) * dt
            along, left = arc(turn)
            cos, sin = x[..., 2].cos(), x[..., 2].sin()
            dx, dy = way * (along * cos - left * sin), way * (along * sin + left * cos)
            rest = torch.cat([(x[..., 2] + turn).unsqueeze(-1), x[..., 3:]], -1)
        return torch.cat([x[..., :2] + torch.stack([dx, dy], -1), rest], -1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)``: that of an independent random walk of each component."""
        walks = [self.walk_position, self.walk_position, self.walk_heading, self.walk_scale]
        walks += [] if self.walk_bias is None else [self.walk_bias]
        each = torch.broadcast_tensors(*(walk(dt).sqrt() * dt.sqrt() for walk in walks))
        root: Tensor = torch.stack(each, -1).diag_embed()
        return root

    def describe(self) -> str:
        """Odometry, and whether it has a measured heading or a gyroscope."""
        return "odometry with a " + ("measured heading" if self.walk_bias is None else "gyroscope")

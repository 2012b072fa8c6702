"""A vehicle that measures its own way: by wheels, and by a compass or a gyroscope."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.motion.base import Motion
from torchfra.motion.blocks import arc
from torchfra.motion.correlated import GaussMarkov


class Odometry(Motion):
    """A vehicle in the plane, driven by the speed that its wheels measure and by its heading or how fast it turns.

    States ``[x, y, heading error, log scale]`` with a measured heading, and ``[x, y, heading, log scale, rate bias]``
    with a gyroscope: the wheels' speed times ``exp(log scale)`` is the true one; the measured heading plus
    ``heading error`` is the true one, and so is the measured turn rate plus ``rate bias``.  Headings count
    counter-clockwise from +x.  With a gyroscope a step is an arc, with a measured heading it is straight.

    A compass that iron nearby turns aside for some seconds has a second error, ``wander``, the last of then five
    states: a first-order Gauss-Markov process that is added to the first.  What it does to the position grows with the
    speed, and is nothing at rest.

    What a step needs to know comes as its ``u (..., 2)``: the speed in m/s over the step that leads to the
    measurement, and the heading in rad or the turn rate in rad/s.  Steps without a number there have no estimate.

    Args:
        position: density of the white noise on each axis of the position, m^2/s: what wheels slip.
        heading: of that on the heading or its error, rad^2/s.
        scale: of that on the logarithm of the scale, 1/s.
        bias: of that on the bias of the turn rate, rad^2/s^3; only of a gyroscope, and then it must be given.
        wander: standard deviation of the second error of a measured heading, rad; None for no such error.
        wander_time: its correlation time, s; it goes with ``wander``.

    Raises:
        ValueError: a density or ``wander`` below 0, ``wander_time`` not above 0, one of these two without the other or
            beside ``bias``; in a step, ``u`` that is missing or has not two entries.

    Source: Thrun, Burgard & Fox (2005), "Probabilistic Robotics", section 5.4, with errors of the sensors as states.
    """

    def __init__(
        self, position: Value, heading: Value, scale: Value, bias: Value | None = None, *,
        wander: Value | None = None, wander_time: Value | None = None,
    ) -> None:  # fmt: skip
        if (wander is None) != (wander_time is None):
            raise ValueError(f"wander, wander_time: expected both or none, received {wander}, {wander_time}")
        if wander is not None and bias is not None:
            raise ValueError(f"wander: expected a measured heading, received the rate bias of a gyroscope, {bias}")
        last = (
            [] if wander is None and bias is None else [("wander", "angle") if bias is None else ("rate bias", "bias")]
        )
        own = ["heading error" if bias is None else "heading", "log scale", *(name for name, _ in last)]
        super().__init__(
            2, 1, None, size=2 + len(own), velocity=slice(0, 0), angles=(2,) if wander is None else (2, 4),
            components=("x", "y", *own),
            kinds=("position", "position", "angle", "parameter", *(kind for _, kind in last)),
        )  # fmt: skip
        self.walk_position = Hyper(position, constraints.nonnegative, name="position")
        self.walk_heading = Hyper(heading, constraints.nonnegative, name="heading")
        self.walk_scale = Hyper(scale, constraints.nonnegative, name="scale")
        self.walk_bias = None if bias is None else Hyper(bias, constraints.nonnegative, name="bias")
        self.wander = None
        if wander is not None and wander_time is not None:
            self.wander = GaussMarkov(wander, wander_time, kind="angle")

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., n)`` after ``dt (...)`` seconds of the speed and the heading or rate ``u (..., 2)``."""
        if u is None or u.shape[-1] != 2:
            expected = "(..., 2), speed and " + ("heading" if self.walk_bias is None else "turn rate")
            raise ValueError(f"u: expected {expected}, received {None if u is None else tuple(u.shape)}")
        speed, turned = u.unbind(-1)
        way = speed * x[..., 3].exp() * dt
        if self.walk_bias is None:
            heading = turned + x[..., 2]
            rest = x[..., 2:]
            if self.wander is not None:
                heading = heading + x[..., 4]
                rest = torch.cat([x[..., 2:4].expand(*heading.shape, 2), self._wandered(x, heading, dt)], -1)
            dx, dy = heading.cos() * way, heading.sin() * way
        else:
            turn = (turned + x[..., 4]) * dt
            along, left = arc(turn)
            cos, sin = x[..., 2].cos(), x[..., 2].sin()
            dx, dy = way * (along * cos - left * sin), way * (along * sin + left * cos)
            rest = torch.cat([(x[..., 2] + turn).unsqueeze(-1), x[..., 3:]], -1)
        return torch.cat([x[..., :2] + torch.stack([dx, dy], -1), rest], -1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)``: a walk of each component, independent of the others; of ``wander``, what keeps it up."""
        walks = [self.walk_position, self.walk_position, self.walk_heading, self.walk_scale]
        walks += [] if self.walk_bias is None else [self.walk_bias]
        stds = [walk(dt).sqrt() * dt.sqrt() for walk in walks]
        if self.wander is not None:
            stds.append(self.wander.process_noise(dt)[..., 0, 0])
        root: Tensor = torch.stack(torch.broadcast_tensors(*stds), -1).diag_embed()
        return root

    def describe(self) -> str:
        """What tells where it heads."""
        return "odometry with a " + ("measured heading" if self.walk_bias is None else "gyroscope")

    def _wandered(self, x: Tensor, like: Tensor, dt: Tensor) -> Tensor:
        """What is left ``(..., 1)`` of the second error of the heading after ``dt`` seconds."""
        assert self.wander is not None
        left = self.wander.transition(dt)[..., 0]  # one component: a matrix of one entry
        return left * x[..., 4:].expand(*like.shape, 1)

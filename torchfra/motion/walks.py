"""Random walks of positions or biases, and clocks."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.linalg.batches import broadcast_shapes
from torchfra.motion.base import Motion
from torchfra.motion.blocks import per_axis, white_root


class RandomWalk(Motion):
    """Random walk of a position, or of a bias beside other motions in ``Augmented``.

    Args:
        q: density of the white noise, the increase of the variance per second: m^2/s for positions.
        dims: number of components.
        kind: their kind, one of ``torchfra.motion.KINDS``.
        components: their names; by default the axes for positions, numbers for other kinds.

    Raises:
        ValueError: ``q`` below 0, ``dims`` below 1, an unknown kind.

    Source: Bar-Shalom, Li & Kirubarajan (2001), section 6.2, with white noise on the first derivative.
    """

    linear = True

    def __init__(
        self, q: Value, dims: int = 2, *, kind: str = "position", components: Sequence[str] | None = None
    ) -> None:
        where = None if kind == "position" else slice(0, 0)
        if components is None and where is not None:
            components = [f"{kind} {i}" for i in range(dims)] if dims > 1 else [kind]
        super().__init__(
            dims, 1, q, position=where, velocity=slice(0, 0), angles=range(dims) if kind == "angle" else (),
            components=components, kinds=[kind] * dims,
        )  # fmt: skip

    def transition(self, dt: Tensor) -> Tensor:
        """``I (..., n, n)``."""
        return torch.eye(self.size, dtype=dt.dtype, device=dt.device).expand(*dt.shape, self.size, self.size)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, n)``: ``sqrt(q dt) I``."""
        return per_axis((self.q(dt).sqrt() * dt.sqrt())[..., None, None], self.size)


class Clock(Motion):
    """The clock of a receiver: states ``[clock, drift]``, offset and drift times the speed of light, m and m/s.

    Args:
        offset: density of the white noise on the offset itself, m^2/s.
        drift: density of the white noise on the drift, m^2/s^3.

    Raises:
        ValueError: a value below 0.

    Source: Brown & Hwang (2012), "Introduction to Random Signals and Applied Kalman Filtering", section 9.3, times the
    square of the speed of light.
    """

    linear = True

    def __init__(self, offset: Value, drift: Value) -> None:
        super().__init__(
            1, 2, None, position=slice(0, 0), velocity=slice(0, 0), components=("clock", "drift"), kinds=("clock",) * 2
        )
        self.offset = Hyper(offset, constraints.nonnegative, finite=True, name="offset")
        self.drift = Hyper(drift, constraints.nonnegative, finite=True, name="drift")

    def transition(self, dt: Tensor) -> Tensor:
        """``[[1, dt], [0, 1]] (..., 2, 2)``."""
        one, zero = torch.ones_like(dt), torch.zeros_like(dt)
        matrix: Tensor = torch.stack([one, dt, zero, one], -1).unflatten(-1, (2, 2))
        return matrix

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., 2, 3)``: two columns for the drift, one for the offset."""
        drift = white_root(dt, self.drift(dt), 2, 1)
        offset = self.offset(dt).sqrt() * dt.sqrt()
        offset = torch.stack([offset, torch.zeros_like(offset)], -1).unsqueeze(-1)
        batch = broadcast_shapes(drift.shape[:-2], offset.shape[:-2])
        return torch.cat([drift.expand(*batch, 2, 2), offset.expand(*batch, 2, 1)], -1)

"""The base of constant-gain filters: the single filter and the bank."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchfra.filters.alphabeta.axes import axis_roots, full_root
from torchfra.filters.base import Filter, S
from torchfra.filters.records import Record
from torchfra.gaussian.inputs import Frame
from torchfra.hyper import Hyper, Value, one_of
from torchfra.linalg.triangular import hstack, tria
from torchfra.motion.base import Motion
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.sensors.base import Sensor
from torchfra.sensors.position import Position
from torchfra.types import Gaussian


class ConstantGainFilter(Filter[S]):
    """Abstract: a filter of positions, axis by axis."""

    instants = False
    one_sensor = "constant gains are chosen for one sensor's noise"
    gamma: Hyper | None

    def __init__(self, motion: Motion, sensor: Sensor, initiation: str, period: Value | None) -> None:
        if not isinstance(sensor, Position) or sensor.std is None:
            raise ValueError(f"sensor: expected a Position with a std, received {type(sensor).__name__}")
        if not isinstance(motion, ConstantVelocity | ConstantAcceleration) or motion.dims != sensor.size:
            raise ValueError(
                f"motion: expected constant velocity or acceleration in {sensor.size} dimensions, received {motion}"
            )
        one_of(initiation=(initiation, ("two-point", "prior")))
        super().__init__(motion, sensor)
        self.initiation = initiation
        self.period = None if period is None else Hyper(period, name="period")

    def _first(self, belief: Gaussian) -> tuple[Tensor, Tensor, Tensor]:
        """The initial mean, zeros ``(..., d)``, and the number of measurements that the mean counts as."""
        d = self.motion.dims
        zero = torch.zeros_like(belief.mean[..., :d])
        if self.initiation == "prior":
            return belief.mean, zero, zero + 2
        return torch.cat([belief.mean[..., :d], *[zero] * (self.motion.orders - 1)], -1), zero, zero

    def _first_root(self, belief: Gaussian) -> Tensor:
        """Entries ``(..., p, d)`` of the covariance root of each axis."""
        return axis_roots(belief.scale_tril, self.motion.orders, 2 if self.gamma is None else 3)

    def _components(self, mean: Tensor) -> tuple[Tensor, ...]:
        """Position, velocity(, acceleration) ``(..., d)`` of a mean."""
        components: tuple[Tensor, ...] = mean.unflatten(-1, (self.motion.orders, self.motion.dims)).unbind(-2)
        return components

    def predict_innovation(self, state: Any, beliefs: Gaussian, frame: Frame) -> Gaussian:
        """The innovation ``(K, ..., m)`` of hypotheses ``(K, ..., n)``, in units of the measurement noise."""
        mean, root = (x[..., : self.sensor.size, :] for x in (beliefs.mean.unsqueeze(-1), beliefs.scale_tril))
        noise = frame.measurement_noise
        one = torch.ones_like(frame.z).diag_embed().expand(*mean.shape[:-1], -1)
        whitened = noise.whiten(frame.z.unsqueeze(-1) - mean).squeeze(-1)
        return Gaussian(whitened, tria(hstack(one, noise.whiten(root))))

    def check_smooths(self) -> None:
        """Refuses to smooth.

        Raises:
            NotImplementedError: always; the message names filters that can be smoothed.
        """
        name = type(self).__name__
        raise NotImplementedError(
            f"{name}: constant gains state no process noise, and so not how far a state follows from the one after it; "
            "smooth with presets.srckf, or a bank of motions"
        )

    def finish(self, state: Any, belief: Gaussian, info: Any) -> tuple[Gaussian, Any]:
        """Beliefs of all steps with full roots, of which steps keep the nonzero entries."""
        return Gaussian(belief.mean, full_root(belief.scale_tril, belief.mean.shape[-1])), info


def record(state: Any, residual: Tensor, frame: Frame, std: Tensor, info: Any) -> Record:
    """The record of a step.

    Args:
        state: after the step.
        residual: ``(..., d)``, 0 where nothing was measured.
        frame: of the step.
        std: ``(..., d)`` standard deviation of the residual, in units of the measurement noise.
        info: of the step.
    """
    std = std.expand_as(residual)
    whitened = residual * frame.measurement_noise.scale
    std = torch.where(frame.measured > 0, std, 1.0)
    return Record(Gaussian(state.mean, state.root), whitened, std.diag_embed(), whitened / std, info)

"""Linear models whose measurement noise is correlated with their process noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from numpy.typing import ArrayLike
from torch.nn.functional import pad

from torchfra.linalg.covariance import covariance_root
from torchfra.linalg.triangular import block_diagonal
from torchfra.motion.linear import Linear as Motion
from torchfra.numbers import as_numbers
from torchfra.sensors.linear import Linear as Sensor
from torchfra.types import Estimate, Gaussian


class CrossCorrelated(NamedTuple):
    """A motion and a sensor with correlated noise; that of a step is behind the state, as ``noise 0`` and so on."""

    motion: Motion
    sensor: Sensor

    def prior(self, belief: Gaussian) -> Gaussian:
        """The belief ``(..., n)`` with the noise behind it, ``(..., 2 n)``."""
        n = belief.mean.shape[-1]
        unit = torch.eye(n, dtype=belief.mean.dtype, device=belief.mean.device)
        return Gaussian(pad(belief.mean, (0, n)), block_diagonal([belief.scale_tril, unit]))

    def state(self, estimate: Estimate | Gaussian) -> Gaussian:
        """The state ``(..., n)`` of an estimate ``(..., 2 n)``: the leading block of a lower root is a root."""
        n = self.motion.size // 2
        return Gaussian(estimate.mean[..., :n], estimate.scale_tril[..., :n, :n])


def cross_correlated(
    F: ArrayLike, Q: ArrayLike, H: ArrayLike, R: ArrayLike, S: ArrayLike, *, following: bool = False,
    components: Sequence[str] | None = None,
) -> CrossCorrelated:  # fmt: skip
    """A linear motion and a sensor whose noise is correlated, ``x' = F x + w``, ``z = H x + v``, ``E[w v^T] = S``.

    ``w`` is the noise of the step that leads to the measurement, as gusts that move an aircraft and its sensor, or
    with ``following`` that of the step after it, as in textbooks on control.  Any filter then takes them::

        models = cross_correlated(F, Q, H, R, S)
        estimate = presets.srckf(models.motion, models.sensor)(z, models.prior(prior))
        models.state(estimate).mean

    The part of ``v`` that ``w`` tells is ``J`` times the normalised noise of the step, which is in the state; the rest
    is white.  That is exact.

    Args:
        F: ``(n, n)`` transition of a step.
        Q: ``(n, n)`` covariance of the process noise.
        H: ``(m, n)`` of the measurement.
        R: ``(m, m)`` covariance of the measurement noise.
        S: ``(n, m)`` covariance of process noise and measurement noise.
        following: whether ``S`` is of the step after the measurement.
        components: names of the state's components.

    Raises:
        ValueError: matrices that do not fit, or that are no covariance together: ``[[Q, S], [S^T, R]]``; or process
            noise that determines an element of the measurement noise.

    Source: Simon (2006), "Optimal State Estimation", section 7.1, for the step before; Anderson & Moore (1979),
    "Optimal Filtering", section 5.4, for the step after.
    """
    values = [as_numbers(x, name).double() for name, x in zip("FQHRS", (F, Q, H, R, S), strict=True)]
    if values[2].dim() != 2:
        raise ValueError(f"H: expected a matrix (m, n), received {tuple(values[2].shape)}")
    m, n = values[2].shape
    for name, x, shape in zip("FQHRS", values, ((n, n), (n, n), (m, n), (m, m), (n, m)), strict=True):
        if x.shape != shape:
            raise ValueError(f"{name}: expected {shape}, received {tuple(x.shape)}")
    transition, Q, H, R, S = values
    joint = covariance_root(torch.cat([torch.cat([Q, S], 1), torch.cat([S.mT, R], 1)]), "Q, S, R")
    root, told, rest = joint[:n, :n], joint[n:, :n], joint[n:, n:]
    zero, unit = torch.zeros(n, n, dtype=torch.float64), torch.eye(n, dtype=torch.float64)
    before, new = (root, zero) if following else (zero, root)
    names = [f"x{i}" for i in range(n)] if components is None else list(components)
    motion = Motion(
        torch.cat([torch.cat([transition, before], 1), torch.cat([zero, zero], 1)]), root=torch.cat([new, unit]),
        components=[*names, *(f"noise {i}" for i in range(n))],
    )  # fmt: skip
    return CrossCorrelated(motion, Sensor(torch.cat([H, told], 1), rest @ rest.mT))

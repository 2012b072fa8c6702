"""The univariate non-stationary growth model under measurement noise with outliers: Qin et al. (2018), experiment 1."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper
from torchfra.motion.base import Motion
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law, mixed_information
from torchfra.scenarios.outliers import outlier_factors
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian

STEPS, START = 500, 0.1


class Growth(Motion):
    """``x' = x / 2 + 25 x / (1 + x^2) + 8 cos(1.2 (k - 1))``; the number ``k`` of the step is ``u (..., 1)``.

    Source: Kitagawa (1987), in the form of Gordon, Salmond & Smith (1993).
    """

    def __init__(self) -> None:
        super().__init__(1, 1, None)
        self.q = Hyper(1.0, constraints.nonnegative, finite=True, name="q")

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., 1)`` after a step; ``dt`` does not matter."""
        if u is None:
            raise ValueError("u: expected the number of the step, (..., 1), received None")
        moved: Tensor = x / 2 + 25 * x / (1 + x.square()) + 8 * (1.2 * (u - 1)).cos()
        return moved

    def process_noise(self, dt: Tensor) -> Tensor:
        """Root of the process noise ``(..., 1, 1)``; ``dt`` does not matter."""
        root: Tensor = (self.q(dt).sqrt() * torch.ones_like(dt))[..., None, None]
        return root


class Square(Sensor):
    """Measures ``x^2 / 20``, without the sign of ``x``."""

    def __init__(self) -> None:
        super().__init__(1, [False], 1.0, None)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., 1)`` without noise."""
        return x[..., :1].square() / 20


def growth(outliers: str = "covariance", *, size: float = 15.0, share: float = 0.3) -> Scenario:
    """A strongly nonlinear scalar state over 500 steps, its square measured with outliers.

    Args:
        outliers: what is ``size`` times larger in an outlier: ``"covariance"``, ``"std"``, or ``"none"``.
        size: the factor.
        share: of the measurements that are outliers.

    Raises:
        ValueError: an argument out of its range.

    Source: Qin et al. (2018), section 4.1.  The filters' initial belief is chosen here; over 500 steps
    it does not matter.
    """
    motion, sensor = Growth(), Square()
    numbers = torch.arange(1, STEPS + 1, dtype=torch.float64).unsqueeze(-1)
    prior = Gaussian(torch.zeros(1, dtype=torch.float64), torch.eye(1, dtype=torch.float64))
    factors = outlier_factors(outliers, size, share)

    def block(rng: np.random.Generator, runs: Tensor) -> Tracks:
        # The draws do not depend on the settings, so that these can be compared on the same noise.
        process, noise = torch.from_numpy(rng.standard_normal((2, BLOCK, STEPS, 1)))
        state, states = torch.full((BLOCK, 1), START, dtype=torch.float64), []
        for k, step in enumerate(process.unbind(1)):
            state = motion(state, torch.ones(1), numbers[k]) + step
            states.append(state)
        truth = torch.stack(states, 1)
        z = sensor(truth) + noise * factors(rng, (BLOCK, STEPS, 1))
        return Tracks(truth, z, numbers, Gaussian(prior.mean.expand(BLOCK, 1), prior.scale_tril))

    settings = {"outliers": outliers, "size": size, "share": share}
    noise, information = torch.eye(1, dtype=torch.float64), mixed_information(outliers, size, share, 1)
    law = Law(torch.zeros_like(noise), motion, sensor, 1.0, noise, information, ("start",))
    return Scenario("growth", motion, sensor, prior, 1.0, STEPS, block, settings, law=law)

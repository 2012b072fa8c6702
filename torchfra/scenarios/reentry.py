"""A vehicle that falls into the atmosphere, seen by a radar: Qin et al. (2018), experiment 2."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.hyper import Hyper, Value, one_of
from torchfra.motion.base import Motion
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law, mixed_information
from torchfra.scenarios.outliers import outlier_factors
from torchfra.sensors.direction import RangeBearing
from torchfra.types import Gaussian

STEPS, DT, SUBSTEPS = 200, 1.0, 10
_EARTH, _SCALE, _PULL, _DRAG = 6374e3, 13.406e3, 3.986e14, -0.59783e-3  # m, m, m^3/s^2, 1/m
_START = torch.tensor([6500.4e3, 349.14e3, -1809.3, -6796.7, 0.6932], dtype=torch.float64)
_RADARS = {"paper": (1e-3**0.5 * 1e3, 0.17e-3**0.5), "precise": (1.0, 0.17e-3)}
"""Standard deviations of range, m, and bearing, rad."""


class Reentry(Motion):
    """Gravity and drag: ``[x, y, vx, vy, parameter]`` from the centre of the earth, m, m/s.

    Args:
        q: spectral density of the random acceleration, m^2/s^3.
        q_parameter: variance per second of the logarithm of the ballistic parameter.

    Each tenth of a step is integrated by Euler's method.

    Source: Austin & Leondes (1981); Julier & Uhlmann (2004); Sarkka (2007) for the process noise.
    """

    def __init__(self, q: Value = 240.64, q_parameter: Value = 0.0) -> None:
        kinds = ("position", "position", "velocity", "velocity", "parameter")
        super().__init__(2, 2, q, size=5, components=("x", "y", "vx", "vy", "drag"), kinds=kinds)
        self.q_parameter = Hyper(q_parameter, constraints.nonnegative, finite=True, name="q_parameter")

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., 5)`` after ``dt`` seconds, without process noise."""
        h = dt.unsqueeze(-1) / SUBSTEPS
        for _ in range(SUBSTEPS):
            x = x + h * self.slope(x)
        return x

    @staticmethod
    def slope(x: Tensor) -> Tensor:
        """Time derivative ``(..., 5)`` of a state, without process noise."""
        position, velocity, parameter = x[..., :2], x[..., 2:4], x[..., 4:]
        radius = position.square().sum(-1, keepdim=True).sqrt()
        speed = velocity.square().sum(-1, keepdim=True).sqrt()
        drag = _DRAG * (parameter + (_EARTH - radius) / _SCALE).exp() * speed
        return torch.cat([velocity, drag * velocity - _PULL / radius**3 * position, 0 * parameter], -1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """Root of the process noise ``(..., 5, 5)``: white acceleration over a step, and drift of the parameter."""
        q, drift, zero = self.q(dt), self.q_parameter(dt), torch.zeros_like(dt)
        slow = (drift * dt).sqrt()
        far, near, fast = (q * dt**3 / 3).sqrt(), (3 * q * dt / 4).sqrt(), (q * dt / 4).sqrt()
        zero, slow, far, near, fast = torch.broadcast_tensors(zero, slow, far, near, fast)
        rows = [
            [far, zero, zero, zero, zero],
            [zero, far, zero, zero, zero],
            [near, zero, fast, zero, zero],
            [zero, near, zero, fast, zero],
            [zero, zero, zero, zero, slow],
        ]
        return torch.stack([torch.stack(row, -1) for row in rows], -2)


def reentry(
    outliers: str = "covariance", *, radar: str = "paper", size: float | None = None, share: float = 0.3
) -> Scenario:
    """200 s of a re-entry, range and bearing every second, with outliers.

    Args:
        outliers: what is ``size`` times larger in an outlier: ``"covariance"``, ``"std"``, or ``"none"``.
        radar: ``"paper"`` (32 m and 13 mrad, its numbers read as variances) or ``"precise"`` (1 m and 0.17 mrad,
            those of the literature).
        size: the factor; None for an integer from 1 to 20, drawn each time.
        share: of the measurements that are outliers.

    Raises:
        ValueError: an argument out of its range.

    Source: Qin et al. (2018), section 4.2.  The duration and the integration are chosen here.
    """
    one_of(radar=(radar, tuple(_RADARS)))
    motion, std = Reentry(), torch.tensor(_RADARS[radar], dtype=torch.float64)
    sensor = RangeBearing(std)
    station = torch.tensor([_EARTH, 0.0], dtype=torch.float64).expand(STEPS, 2)
    prior, factors = Gaussian(_START, torch.eye(5, dtype=torch.float64)), outlier_factors(outliers, size, share)
    jolt = (motion.q() * DT / SUBSTEPS).sqrt()

    def block(rng: np.random.Generator, runs: Tensor) -> Tracks:
        start = torch.from_numpy(rng.standard_normal((BLOCK, 4)))
        noise = torch.from_numpy(rng.standard_normal((BLOCK, STEPS, 2)))
        process = torch.from_numpy(rng.standard_normal((STEPS, SUBSTEPS, BLOCK, 2)))
        truth = _fallen(_START + pad(start, (0, 1)), jolt * process)
        z = sensor(truth, station) + std * noise * factors(rng, (BLOCK, STEPS, 1))
        return Tracks(truth, z, station, Gaussian(prior.mean.expand(BLOCK, 5), prior.scale_tril))

    settings = {"outliers": outliers, "radar": radar, "size": "1 to 20" if size is None else size, "share": share}
    information = mixed_information(outliers, size, share, 2)
    start = prior.scale_tril[:, :4]  # filters start with the true parameter
    law = Law(start, Reentry(), sensor, std, _shaken(jolt), information)
    return Scenario(
        "reentry", motion, sensor, prior, DT, STEPS, block, settings, extra_quantities={"parameter": slice(4, 5)},
        law=law,
    )  # fmt: skip


def _shaken(jolt: Tensor) -> Tensor:
    """Root ``(5, 2 SUBSTEPS)`` of the process noise of a second, without gravity and drag."""
    left = torch.arange(SUBSTEPS - 1, -1, -1, dtype=torch.float64) * DT / SUBSTEPS
    moved = torch.kron(torch.stack([left, torch.ones_like(left)]), torch.eye(2, dtype=torch.float64))
    return pad(jolt * moved, (0, 0, 0, 1))


def _fallen(state: Tensor, shocks: Tensor) -> Tensor:
    """True states ``(BLOCK, T, 5)`` by Euler-Maruyama; ``shocks (T, SUBSTEPS, BLOCK, 2)`` are added to velocities."""
    states = []
    for second in shocks:
        for shock in second:
            state = state + DT / SUBSTEPS * Reentry.slope(state) + pad(shock, (2, 1))
        states.append(state)
    return torch.stack(states, 1)

"""The attractor of Lorenz as a motion, what is measured of it, and the settings that filters are compared in.

Source: Revach et al. (2022), "KalmanNet: Neural Network Aided Kalman Filtering for Partially Known Dynamics", section
IV-D, for the system, its step, its Taylor series and the rotations; the values of a step of 0.02 s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import apply
from torchfra.motion import Motion
from torchfra.sensors import Sensor
from torchfra.types import Gaussian

DT, ORDER, DEGREE, RHO = 0.02, 5, math.pi / 180, 28.0
"""Seconds of a step, order of the Taylor series, the angle of a rotation, rad, and the number that makes it chaotic."""
SHARE, SIZE = 0.05, 10.0
"""Share of the measurements that are outliers, and how many times as large their standard deviation is."""


class Lorenz(Motion):
    """``dx/dt = R A(x) x`` over a step by the Taylor series of ``exp(R A(x) dt)``; states ``[x, y, z]``.

    Args:
        q: variance of the process noise of a step, a number or one for each component.
        order: of the Taylor series.
        angle: by which ``R`` turns around all three axes, rad.
        rho: the Rayleigh number over its critical value; paths end at a point up to 24.7 or less, at 28 they never do.
    """

    still: Tensor
    moving: Tensor

    def __init__(self, q: Value = 1.0, *, order: int = ORDER, angle: float = 0.0, rho: float = RHO) -> None:
        super().__init__(3, 1, None)
        values = torch.as_tensor(q, dtype=torch.float64)
        self.q = Hyper(values, constraints.nonnegative, event_dim=int(values.dim() > 0), name="q")
        self.order = order
        still, moving = [[-10, 10, 0], [rho, -1, 0], [0, 0, -8 / 3]], [[0, 0, 0], [0, 0, -1], [0, 1, 0]]
        for name, part in (("still", still), ("moving", moving)):  # A(x) is one, plus x times the other
            turned = rotation(angle) @ torch.tensor(part, dtype=torch.float64)
            self.register_buffer(name, turned, persistent=False)

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., 3)`` after ``dt (...)`` seconds."""
        flow = self.still.to(x) + x[..., :1, None] * self.moving.to(x)  # R A(x)
        step, term, after = flow * dt[..., None, None], x, x
        for j in range(1, self.order + 1):
            term = apply(step, term) / j
            after = after + term
        return after

    def process_noise(self, dt: Tensor) -> Tensor:
        """Root of the process noise ``(..., 3, 3)`` of a step, however long."""
        root = self.q.elements(dt).sqrt().expand(*self.q.raw.shape[: self.q.batch_rank], 3)
        return torch.diag_embed(root) * torch.ones_like(dt)[..., None, None]


class Linear(Sensor):
    """A matrix ``(m, 3)`` times the state; its noise is white."""

    linear = True
    matrix: Tensor

    def __init__(self, matrix: Tensor, std: Value) -> None:
        super().__init__(3, [False] * len(matrix), std)
        self.register_buffer("matrix", matrix, persistent=False)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)`` without noise."""
        return apply(self.matrix.to(x), x[..., :3])


class Setting(NamedTuple):
    """What truth and filters have that differs from ``dx/dt = A(x) x`` measured as it is."""

    steps: int = 100
    turned_motion: bool = False
    """The true motion is turned by a degree, which no filter knows."""
    turned_sensor: bool = False
    """So is what is measured."""
    order: int = ORDER
    """Of the Taylor series that filters have."""
    measured: int = 3
    """Leading components that are measured."""
    outliers: bool = False
    rho: float = RHO
    published: bool = False
    """As others have published errors of networks: the process noise is 1e-4, whatever the measurement noise, a track
    starts at 0, which is known, and what is asked for is the state one step after the last measurement."""


SETTINGS = {
    "as stated": Setting(),
    "2000 steps": Setting(steps=2000),
    "sensor turned by 1 degree": Setting(turned_sensor=True),
    "motion turned by 1 degree": Setting(turned_motion=True),
    "series of order 2": Setting(order=2),
    "x alone measured": Setting(measured=1),
    "5 % outliers": Setting(outliers=True),
    "one step ahead": Setting(published=True),
}


class Tracks(NamedTuple):
    """Simulated tracks, and what filters assume."""

    truth: Tensor
    """``(B, T, 3)`` states."""
    z: Tensor
    """``(B, T, m)`` measurements of them; one step ahead there is none of the last."""
    prior: Gaussian
    """Of the state before the first."""

    def asked(self, means: Tensor, motion: Motion) -> Tensor:
        """Of estimates at the measurements those ``(B, T, 3)`` that are asked for: predictions where one is missing."""
        if means.shape[1] == self.truth.shape[1]:
            return means
        means = torch.cat([self.prior.mean.to(means).unsqueeze(1), means], 1)
        predicted: Tensor = motion(means, means.new_full(means.shape[:-1], DT))
        return predicted


def rotation(angle: float) -> Tensor:
    """``R_z R_y R_x (3, 3)``, each by ``angle``, rad."""
    cos, sin = math.cos(angle), math.sin(angle)
    x = torch.tensor([[1.0, 0, 0], [0, cos, -sin], [0, sin, cos]], dtype=torch.float64)
    y = torch.tensor([[cos, 0, sin], [0, 1.0, 0], [-sin, 0, cos]], dtype=torch.float64)
    z = torch.tensor([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1.0]], dtype=torch.float64)
    return z @ y @ x


def models(setting: Setting, variance: float) -> tuple[Lorenz, Linear]:
    """Motion and sensor as they are stated to filters, for a variance of the measurement noise."""
    q = 1e-4 if setting.published else variance / 100
    matrix = torch.eye(3, dtype=torch.float64)[: setting.measured]
    return Lorenz(torch.full((3,), q), order=setting.order, rho=setting.rho), Linear(
        matrix, torch.full((len(matrix),), variance**0.5)
    )


def simulate(setting: Setting, variance: float, runs: int, seed: int) -> Tracks:
    """Tracks of a setting; with one seed they have the same noise in all."""
    rng = torch.Generator().manual_seed(seed)
    stated, sensor = models(setting, variance)
    motion = Lorenz(stated.q(), angle=DEGREE if setting.turned_motion else 0.0, rho=setting.rho)
    dt = torch.tensor(DT, dtype=torch.float64)
    state = torch.full((runs, 3), 0.0 if setting.published else 1.0, dtype=torch.float64)
    prior = Gaussian(state, torch.zeros(3, 3, dtype=torch.float64))
    states = [state]
    for _ in range(setting.steps):
        noise = torch.randn(runs, 3, generator=rng, dtype=torch.float64)
        states.append(motion(states[-1], dt.expand(runs)) + apply(motion.process_noise(dt), noise))
    path = torch.stack(states[1:], 1)
    noise = torch.randn(runs, setting.steps, 3, generator=rng, dtype=torch.float64)[..., : setting.measured]
    large = torch.rand(runs, setting.steps, 1, generator=rng, dtype=torch.float64) < SHARE
    std = variance**0.5 * torch.where(large, SIZE, 1.0) if setting.outliers else variance**0.5
    turned = path @ rotation(DEGREE).mT if setting.turned_sensor else path
    z = sensor(turned) + std * noise
    return Tracks(path, z[:, :-1] if setting.published else z, prior)

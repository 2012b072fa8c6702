"""Linear models: a Kalman filter is all that there is to compute, and there are most peers.

The models of one long track are of the sizes that kalman-py publishes times of: a line, a plane, inertial navigation.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from benchmarks.roof import FILTERS
from benchmarks.timing import Row
from benchmarks.tracks import beside_peers
from torchfra import scenarios
from torchfra.linalg.triangular import apply
from torchfra.motion import ConstantVelocity
from torchfra.motion.base import Motion
from torchfra.scenarios import Scenario, Tracks
from torchfra.sensors import Position
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian

STEPS = 10_000
"""Steps of a long track."""


def linear(options: argparse.Namespace) -> list[Row]:
    """Constant velocity in a plane and measured positions, for each batch size."""
    scenario, rows = scenarios.as_stated(), list[Row]()
    for batch in map(int, (options.batch or "1,1000,10000").split(",")):
        rows += beside_peers(scenario, scenario.simulate(batch, 0), kalman(options), batch=batch)
    return rows


def long(options: argparse.Namespace) -> list[Row]:
    """One track of 10,000 steps: on a line, in a plane, and of the errors of an inertial navigation."""
    rows: list[Row] = []
    for name, scenario in long_tracks().items():
        rows += beside_peers(scenario, scenario.simulate(1, 0), kalman(options), model=name)
    return rows


def kalman(options: argparse.Namespace) -> argparse.Namespace:
    """The options, with ``srckf`` where no filters are named."""
    return argparse.Namespace(**vars(options) | {"filters": "srckf"}) if options.filters == FILTERS else options


def long_tracks(steps: int = STEPS) -> dict[str, Scenario]:
    """A track drawn from each model, by the model's name and the sizes of state and measurement."""
    line = ConstantVelocity(0.5, dims=1, continuous=True), Position(0.5, dims=1), torch.tensor([1.0, 1.0]), 0.1
    plane = ConstantVelocity(0.5, continuous=True), Position([0.7, 0.9]), torch.tensor([1.0, 1.0, 0.7, 0.7]), 0.1
    inertial = Inertial(), Fixes(), torch.tensor([10.0, 1.0, 0.01, 0.1, 0.01]).repeat_interleave(3), 0.01
    models = {"line, 2 and 1": line, "plane, 4 and 2": plane, "inertial, 15 and 6": inertial}
    return {name: drawn(*model, steps) for name, model in models.items()}


def drawn(motion: Motion, sensor: Sensor, spread: Tensor, dt: float, steps: int) -> Scenario:
    """A track that moves and is measured as the models say, from a prior around 0 with ``spread (n,)``."""
    generator = torch.Generator().manual_seed(0)
    seconds, spread = torch.tensor(dt, dtype=torch.float64), spread.double()
    matrix, noise = motion.transition(seconds), motion.process_noise(seconds)
    pushes = torch.randn(steps, noise.shape[-1], generator=generator, dtype=torch.float64)
    state, path = spread * torch.randn(motion.size, generator=generator, dtype=torch.float64), []
    for push in pushes:
        state = apply(matrix, state) + apply(noise, push)
        path.append(state)
    truth = torch.stack(path)
    z = sensor(truth)
    z = z + sensor.measurement_noise(z).std * torch.randn(z.shape, generator=generator, dtype=torch.float64)
    prior = Gaussian(torch.zeros_like(spread), spread.diag())
    return scenarios.of_tracks(Tracks(truth[None], z[None], None, prior), motion, sensor, dt=dt)


class Inertial(Motion):
    """Errors of an inertial navigation at rest: of position, velocity, attitude, and of accelerometers and gyros.

    Source: the error equations of any textbook, as Farrell (2008), "Aided Navigation", in first order of the step.
    """

    linear = True

    def __init__(self) -> None:
        super().__init__(3, 5, None)

    def transition(self, dt: Tensor) -> Tensor:
        """``F (..., 15, 15)``: gravity turns an error of attitude into acceleration."""
        eye, zero = torch.eye(3).to(dt), torch.zeros(3, 3).to(dt)
        gravity = 9.81 * dt.new_tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]])
        rows = [
            [zero, eye, zero, zero, zero],
            [zero, zero, gravity, -eye, zero],
            [zero, zero, zero, zero, -eye],
            [zero] * 5,
            [zero] * 5,
        ]
        return torch.eye(15).to(dt) + dt[..., None, None] * torch.cat([torch.cat(row, 1) for row in rows])

    def process_noise(self, dt: Tensor) -> Tensor:
        """Root ``(..., 15, 15)``: white noise on all but positions."""
        density = dt.new_tensor([0.0, 0.05, 1e-3, 1e-4, 1e-5]).repeat_interleave(3)
        return dt.sqrt()[..., None, None] * density.diag()


class Fixes(Sensor):
    """Position to 1 m and velocity to 0.1 m/s, the first six components."""

    linear = True

    def __init__(self) -> None:
        super().__init__(6, [False] * 6, torch.tensor([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]))

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """``(..., 6)``."""
        return x[..., :6]

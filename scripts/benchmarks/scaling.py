"""The compiled SRCKF over the number of tracks, of states and of steps."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.timing import Row, calls, timed
from torchfra import presets
from torchfra.app import plotting
from torchfra.catalogue import make_scenario
from torchfra.motion import ConstantAcceleration, ConstantVelocity, Motion
from torchfra.sensors import Position
from torchfra.types import Gaussian

BATCHES = (1, 10, 100, 1000, 10_000, 100_000)
STEPS = (100, 1000, 10_000, 100_000)
MOTIONS = ((ConstantVelocity, 1), (ConstantVelocity, 2), (ConstantAcceleration, 2), (ConstantVelocity, 4),
           (ConstantVelocity, 5), (ConstantAcceleration, 4))  # fmt: skip
"""And dimensions of space: 2 to 12 states."""


def scaling(options: argparse.Namespace) -> list[Row]:
    """Three series of rows, with ``batch``, ``states`` and ``steps``."""
    scenario = make_scenario(options.scenario, initial=options.initial)
    rows: list[Row] = []

    def measure(call: Callable[[], Any], z: torch.Tensor, **label: int) -> None:
        rows.extend(timed(calls({"srckf, compiled": call}), options.passes, z.shape[0] * z.shape[1], **label))

    f = presets.srckf(scenario.motion, scenario.sensor).compile()
    for batch in BATCHES:
        data = scenario.simulate(batch, 0)
        measure(lambda data=data: f(data.z, data.prior, u=data.u), data.z, batch=batch)
    generator = torch.Generator().manual_seed(0)
    for kind, dims in MOTIONS:
        motion = kind(1.0, dims)
        z = torch.randn(1000, 100, dims, dtype=torch.float64, generator=generator)
        measure(on_positions(motion, z), z, states=motion.size)
    for steps in STEPS:
        z = torch.randn(8, steps, 2, dtype=torch.float64, generator=generator)
        measure(on_positions(ConstantAcceleration(1.0), z), z, steps=steps)
    return rows


def draw(rows: Sequence[Row], path: Path) -> None:
    """Writes the figure of the series."""
    panels = {key: [(row[key], row["median"]) for row in rows if key in row] for key in ("batch", "states", "steps")}
    plotting.save(plotting.scaling(panels, "compiled SRCKF, float64"), path)
    print(f"figure: {path}")


def on_positions(motion: Motion, z: torch.Tensor) -> Callable[[], Any]:
    """The compiled filter of a motion on positions ``z (B, T, dims)``."""
    f = presets.srckf(motion, Position(1.0, dims=motion.dims)).compile()
    prior = Gaussian(torch.zeros(motion.size, dtype=torch.float64), torch.eye(motion.size, dtype=torch.float64))
    return lambda: f(z, prior)

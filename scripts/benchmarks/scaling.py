"""Compiled filters over the number of tracks, of steps, states, measurements, models and targets."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from benchmarks.timing import Row, calls, timed
from torchfra import plotting, presets
from torchfra.association import Clutter
from torchfra.catalogue import make_scenario
from torchfra.motion import Bank, ConstantAcceleration, ConstantVelocity
from torchfra.pictures import BLUE
from torchfra.plotting.style import TITLE, finish, words
from torchfra.sensors import Position
from torchfra.types import Gaussian

TRACKS = (1, 10, 100, 1000, 10_000, 100_000)
STEPS = (100, 1000, 10_000, 100_000)
DIMENSIONS = (1, 2, 3, 4, 6, 8)
"""Dimensions of space, each with two states and one measured position."""
MEASURED = (1, 2, 3, 4)
"""Numbers of measured positions of eight states."""
MODELS = (1, 2, 3, 5, 7)
TARGETS = (1, 2, 3, 4)
"""Numbers of targets, in scans of eight measurements."""

SIZES = ("tracks", "steps", "states", "measurements", "models", "targets")
"""The size that grows."""
Series = tuple[str, str, Iterator[tuple[int, int, Callable[[], Any]]]]
"""The size that grows, the filter, and for each size its number, the track steps of a call, and the call."""


def scaling(options: argparse.Namespace) -> list[Row]:
    """A series of rows for each size that grows, and lines that say how time grows with it."""
    rows: list[Row] = []
    for size, name, cases in every_series(options):
        series: list[Row] = []
        for count, track_steps, call in cases:
            series += timed(calls({f"{name}, compiled": call}), options.passes, track_steps, **{size: count})
        rows += series
        print(growth(size, name, series), flush=True)
    return rows


def every_series(options: argparse.Namespace) -> list[Series]:
    """All series."""
    return [
        ("tracks", "srckf", over_tracks(options)),
        ("steps", "srckf", over_steps()),
        ("states", "srckf", over_states()),
        ("measurements", "srckf", over_measurements()),
        ("models", "imm_srckf", over_models()),
        ("targets", "jpda", over_targets()),
    ]


def growth(size: str, name: str, series: Sequence[Row]) -> str:
    """A line of text: the power of the size that the time of a call grows with, by the upper half of the sizes.

    Args:
        size: what grows.
        name: of the filter.
        series: its rows.
    """
    sizes = [row[size] for row in series]
    upper = [row for row in series if row[size] >= math.sqrt(sizes[0] * sizes[-1])]
    # What is timed is per track and step: a call of many tracks or steps takes so many times that.
    whole = 1 if size in ("tracks", "steps") else 0
    slope = np.polyfit(*([math.log(row[key]) for row in upper] for key in (size, "median")), 1)[0] + whole
    return f"{name}: the time of a call grows with {size}^{slope:.2f}, from {upper[0][size]} to {sizes[-1]}"


def over_tracks(options: argparse.Namespace) -> Iterator[tuple[int, int, Callable[[], Any]]]:
    """Two bearings, six states, 100 steps."""
    scenario = make_scenario(options.scenario, initial=options.initial)
    f = presets.srckf(scenario.motion, scenario.sensor).compile()
    for count in TRACKS:
        data = scenario.simulate(count, 0)
        yield count, count * scenario.steps, lambda data=data: f(data.z, data.prior, u=data.u)


def over_steps() -> Iterator[tuple[int, int, Callable[[], Any]]]:
    """Eight tracks of six states in the plane."""
    for count in STEPS:
        f, prior = presets.srckf(ConstantAcceleration(1.0), Position(1.0)), standard(6)
        yield on_noise(f, prior, count, 8, count, 2)


def over_states() -> Iterator[tuple[int, int, Callable[[], Any]]]:
    """Of 1000 tracks: half of the states are measured."""
    for dims in DIMENSIONS:
        f = presets.srckf(ConstantVelocity(1.0, dims), Position(1.0, dims=dims))
        yield on_noise(f, standard(2 * dims), 2 * dims, 1000, 100, dims)


def over_measurements() -> Iterator[tuple[int, int, Callable[[], Any]]]:
    """Of 1000 tracks with eight states."""
    for count in MEASURED:
        f = presets.srckf(ConstantVelocity(1.0, 4), Position(1.0, dims=count))
        yield on_noise(f, standard(8), count, 1000, 100, count)


def over_models() -> Iterator[tuple[int, int, Callable[[], Any]]]:
    """Of 1000 tracks with four states."""
    for count in MODELS:
        bank = Bank([ConstantVelocity(4.0**k) for k in range(count)])
        yield on_noise(presets.imm_srckf(bank, Position(1.0)), standard(4), count, 1000, 100, 2)


def over_targets() -> Iterator[tuple[int, int, Callable[[], Any]]]:
    """Of 100 runs with four states for each target, in scans of eight measurements."""
    for count in TARGETS:
        mean, root = standard(4)
        apart = mean.repeat(count, 1)
        apart[:, 0] = 5.0 * torch.arange(count)
        f = presets.jpda(ConstantVelocity(1.0), Position(1.0), clutter=Clutter(1e4))
        yield on_noise(f, Gaussian(apart, root.expand(count, 4, 4)), count, 100, 100, 8, 2)


def on_noise(f: Any, prior: Gaussian, size: int, runs: int, steps: int, *event: int) -> tuple[int, int, Any]:
    """A case: the compiled filter on ``runs`` tracks of so many ``steps`` of noise."""
    z = torch.randn(runs, steps, *event, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    f.compile()
    return size, runs * steps, lambda: f(z, prior)


def standard(states: int) -> Gaussian:
    """A belief of variances 1."""
    return Gaussian(torch.zeros(states, dtype=torch.float64), torch.eye(states, dtype=torch.float64))


def draw(rows: Sequence[Row], path: Path) -> None:
    """Writes the figure of the series."""
    panels = {key: [(row[key], row["median"]) for row in rows if key in row] for key in SIZES}
    plotting.save(figure_of(panels, "compiled filters, float64"), path)
    print(f"figure: {path}")


def figure_of(panels: dict[str, list[tuple[float, float]]], title: str) -> Figure:
    """Time per track and step over the size of the job.

    Args:
        panels: one for each size, such as ``"batch"``: pairs of the size and microseconds.
        title: of the figure.
    """
    columns, rows = min(len(panels), 3), -(-len(panels) // 3)
    figure = Figure(figsize=(4 * columns, 3.1 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    grid[0, 0].set(yscale="log")
    figure.supylabel("microseconds per track and step", fontsize="medium")
    for axes, (size, pairs) in zip(grid.flat, panels.items(), strict=False):
        axes.plot(*zip(*pairs, strict=True), marker="o", color=BLUE)
        axes.set(xlabel=size)
        if max(pairs)[0] > 100:
            axes.set_xscale("log")
        else:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        finish(axes)
    figure.suptitle(words(title, TITLE))
    return figure

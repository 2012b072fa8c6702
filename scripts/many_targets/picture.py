"""The recorded flights and what was made of them, as a picture."""

from __future__ import annotations

import matplotlib
from matplotlib.figure import Figure
from torch import Tensor

from many_targets.worlds import World


def picture(world: World, mean: Tensor) -> Figure:
    """The scans, the truth, and the targets ``(K, T, n)`` that were found, each identity in a colour; km."""
    figure = Figure(figsize=(12, 6), layout="constrained")
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    left.set_title(f"what is measured: a tenth of the {len(world.scans)} scans")
    for scan in world.scans[::10]:
        left.plot(*(scan / 1e3).T, ".", color="black", markersize=0.6, alpha=0.5, rasterized=True)
    right.set_title(f"{len(mean)} targets found (colours), {len(world.truth)} true ones (grey, below)")
    colours = matplotlib.colormaps["tab20"].colors
    for track in world.truth:
        right.plot(*(track[:, :2] / 1e3).T, color="lightgrey", linewidth=3)
    for i, track in enumerate(mean):
        right.plot(*(track[:, :2] / 1e3).T, color=colours[i % len(colours)], linewidth=0.8)
    for axes in (left, right):
        axes.set_aspect("equal")
        axes.set_xlabel("east, km")
    left.set_ylabel("north, km")
    return figure

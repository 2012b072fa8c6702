"""Where targets were and where filters saw them."""

from __future__ import annotations

from itertools import cycle
from typing import Any

from matplotlib.figure import Figure
from torch import Tensor

from torchfra.app.plotting.style import CYCLE, GREY, TITLE, finish, line_styles, words


def tracks(truth: Tensor, estimates: dict[str, Tensor], title: str, stations: Tensor | None = None) -> Figure:
    """One target's true path and what filters made of it, in the plane.

    Args:
        truth: ``(T, n)``, m.
        estimates: by name, ``(T, n)`` each, m.
        title: of the figure.
        stations: ``(T, 2 k)`` positions of the stations, m.
    """
    figure = Figure(figsize=(7, 6), layout="constrained")
    axes, styles = figure.subplots(), line_styles(estimates)
    if stations is not None:
        for i, path in enumerate(stations.unflatten(-1, (-1, 2)).unbind(-2)):
            label = "stations" if i == 0 else None
            axes.plot(*(path.mT / 1000), color="black", linestyle=":", linewidth=1, label=label)
    axes.plot(*(truth[:, :2].mT / 1000), color="black", linewidth=2.5, label="truth")
    for name, mean in estimates.items():
        axes.plot(*(mean[:, :2].mT / 1000), label=words(name), **styles[name])
    axes.set(xlabel="x, km", ylabel="y, km", title=words(title, TITLE), aspect="equal")
    axes.set_adjustable("datalim")
    finish(axes)
    return figure


def in_space(truth: Tensor, estimates: Tensor, measured: Tensor, title: str) -> Figure:
    """Targets, what was measured and what a filter made of it, in space.

    Args:
        truth: ``(N, T, 3 or more)``, m.
        estimates: ``(N, T, 3 or more)``, m.
        measured: ``(M, 3)`` of all scans, m; NaN for none.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 7), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    axes.scatter(*(measured.mT / 1000).numpy(), s=2, color=GREY, alpha=0.5, label="measured")
    for i, (path, mean, colour) in enumerate(zip(truth, estimates, cycle(CYCLE), strict=False)):
        axes.plot(*(path[:, :3].mT / 1000).numpy(), color="black", linewidth=2.5, label="truth" if i == 0 else None)
        axes.plot(*(mean[:, :3].mT / 1000).numpy(), color=colour, linewidth=1.4, label=f"target {i + 1}, filtered")
    axes.set(xlabel="east, km", ylabel="north, km", zlabel="up, km", title=words(title, TITLE))
    axes.legend(frameon=False, fontsize=8)
    return figure

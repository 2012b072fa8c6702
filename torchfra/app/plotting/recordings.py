"""A recorded track after filtering."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchfra.app.plotting.models import shade
from torchfra.app.plotting.style import BLUE, ORANGE, RED, TITLE, without_box, words


def filtered(
    time: Any, raw: Any, mean: Any, std: Any, nis: Any, flags: dict[str, Any], gate: float, title: str,
    models: Sequence[str] = (), leading: Any = None,
) -> Figure:  # fmt: skip
    """A recorded track after filtering: path, distance of the fixes from it, innovations, and flagged steps.

    On the path a manoeuvre is marked where the target was, and all else (an outlier, say) where it was measured.

    Args:
        time: ``(T,)`` seconds.
        raw: ``(T, d)`` positions as recorded, NaN where missing.
        mean: ``(T, d)`` filtered positions, m.
        std: ``(T, d)`` standard deviations of these, m.
        nis: ``(T,)`` normalised innovation squared.
        flags: by name, ``(T,)`` bool each.
        gate: above which an innovation is abnormal.
        title: of the figure.
        models: names of interacting models.
        leading: ``(T,)`` number of the most probable of them: shades the time.
    """
    figure = Figure(figsize=(11, 6), layout="constrained")
    panels = figure.subplot_mosaic([["path", "residual"], ["path", "innovation"]])
    path, residual, innovation = panels["path"], panels["residual"], panels["innovation"]
    distance = np.linalg.norm(raw - mean, axis=-1)
    path.plot(mean[:, 0] / 1000, mean[:, 1] / 1000, color=BLUE, linewidth=1.2, label="filtered")
    path.plot(raw[:, 0] / 1000, raw[:, 1] / 1000, ".", color="black", markersize=2, label="recorded")
    residual.plot(time, distance, color=BLUE, linewidth=0.8)
    certain = 2 * np.linalg.norm(std, axis=-1)
    residual.plot(time, certain, color="black", linestyle=":", linewidth=1.2, label="2 std of the estimate")
    innovation.plot(time, np.maximum(nis, 1e-3), color=BLUE, linewidth=0.8)
    innovation.axhline(gate, color="black", linestyle="--", linewidth=1)
    for (name, flag), mark, colour in zip(flags.items(), "x+", (RED, ORANGE), strict=False):
        place = (mean if name == "manoeuvre" else raw)[flag] / 1000
        path.plot(place[:, 0], place[:, 1], mark, color=colour, label=words(f"{name} ({int(flag.sum())})"))
        residual.plot(time[flag], distance[flag], mark, color=colour)
        innovation.plot(time[flag], nis[flag], mark, color=colour)
    _label(panels, title)
    if leading is not None:
        for axes in (residual, innovation):
            shade(axes, time, leading, models)
    residual.legend(frameon=False, fontsize=7, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def _label(panels: dict[str, Any], title: str) -> None:
    panels["path"].set(
        xlabel="east, km", ylabel="north, km", title=words(title, TITLE), aspect="equal", adjustable="datalim"
    )
    panels["path"].legend(frameon=False, fontsize=8)
    panels["residual"].set(ylabel="recorded to filtered, m", yscale="symlog")
    panels["innovation"].set(xlabel="time, s", ylabel="normalised innovation squared", yscale="log")
    for axes in panels.values():
        without_box(axes)

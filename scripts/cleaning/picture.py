"""Every case against the bounds, as a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from cleaning.bounds import Figures, bounds

COLOURS = {
    "calibration": "#0072B2", "gliders": "#E69F00", "circling": "#009E73", "others": "#56B4E9", "ships": "#D55E00",
    "drones": "#CC79A7", "ranges": "#000000", "late": "#999999", "lasting": "#332288", "heights": "#882255",
    "animals": "#F0E442",
}  # fmt: skip
"""Colours of the kinds, which the colour-blind can distinguish (Okabe and Ito)."""
PANELS = {
    "of_raw": ("error over that of the raw fixes", (0.0, 1.6)),
    "of_best": ("error over the best constant velocity's", (0.4, 1.6)),
    "sigma_found": ("sigma found over true", (0.7, 1.3)),
    "band_68": ("share within the 68 % band", (0.5, 0.86)),
    "outlier_precision": ("precision of outliers", (0.8, 1.0)),
    "outlier_recall": ("recall of outliers beyond 6 sigma", (0.8, 1.0)),
    "turn_precision": ("precision of the time of turns", (0.5, 1.0)),
    "turn_recall": ("recall of the time of turns", (0.5, 1.0)),
}
"""Figures, their titles, and what of their axis matters; beyond it triangles stand at the edge."""


def picture(cases: Sequence[Figures], title: str) -> Figure:
    """A panel for each figure: a dot for each case in a column for each period and noise, green where it should be."""
    columns = sorted({(case["period"], case["noise"]) for case in cases})
    kinds = [kind for kind in COLOURS if any(case["kind"] == kind for case in cases)]
    figure = Figure(figsize=(13, 6.5), layout="constrained")
    places = figure.subplots(2, len(PANELS) // 2, sharex=True)
    for axes, (name, (label, span)) in zip(places.flat, PANELS.items(), strict=True):
        axes.set_title(label, fontsize=9)
        axes.set_ylim(span[0] - 0.03 * (span[1] - span[0]), span[1] + 0.03 * (span[1] - span[0]))
        for x, column in enumerate(columns):
            for bound in (bound for bound in bounds(column[0]) if bound.figure == name and bound.of != "median"):
                low, high = (min(max(value, span[0]), span[1]) for value in (bound.low, bound.high))
                axes.add_patch(Rectangle((x - 0.48, low), 0.96, high - low, color="#009E73", alpha=0.18, linewidth=0))
            here = [case for case in cases if (case["period"], case["noise"]) == column and case[name] is not None]
            _dots(axes, x, here, name, span, kinds)
        axes.set_xticks(range(len(columns)), [f"{period:g} s\n{noise:g} m" for period, noise in columns], fontsize=7)
        axes.tick_params(axis="y", labelsize=8)
    marks = [axes.scatter([], [], s=14, color=COLOURS[kind], label=kind) for kind in kinds]
    figure.legend(handles=marks, loc="outside lower center", ncols=len(kinds), fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10)
    return figure


def _dots(
    axes: Axes, x: int, here: Sequence[Figures], name: str, span: tuple[float, float], kinds: Sequence[str]
) -> None:
    """The cases of a column side by side, those beyond the axis as triangles at its edge."""
    for case in here:
        value = case[name]
        beside = x + 0.8 * ((kinds.index(case["kind"]) + 0.5) / len(kinds) - 0.5)
        marker = "^" if value > span[1] else "v" if value < span[0] or math.isnan(value) else "o"
        axes.scatter(beside, np.clip(value, *span), s=12, marker=marker, color=COLOURS[case["kind"]], linewidth=0)

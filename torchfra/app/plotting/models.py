"""Which of several interacting models is the most probable."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchfra.app.plotting.style import CYCLE, TITLE, words

_COLOURS = ("#bbbbbb", *CYCLE, "#000000")
"""The first model is the usual one, straight flight: grey."""


def probabilities(of: dict[str, Any], models: Sequence[str], start: float, dt: float, title: str) -> Figure:
    """Probabilities of models over time, stacked, one panel for each filter.

    Args:
        of: by name of the filter ``(T, K)``.
        models: their names, K or more; a filter of fewer has the first of them.
        start: seconds at the first step.
        dt: seconds per step.
        title: of the figure.
    """
    figure = Figure(figsize=(9, 2.2 * len(of) + 0.6), layout="constrained")
    rows = figure.subplots(len(of), 1, squeeze=False, sharex=True)[:, 0]
    for (name, values), axes in zip(of.items(), rows, strict=True):
        values = np.asarray(values, dtype=float)
        time = start + dt * np.arange(len(values))
        axes.stackplot(time, values.T, colors=_COLOURS, labels=[*map(words, models[: values.shape[1]])], linewidth=0)
        axes.set(ylabel=words(name), ylim=(0, 1), xlim=(time[0], time[-1]))
    most = max(rows, key=lambda axes: len(axes.get_legend_handles_labels()[1]))
    place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
    rows[0].legend(*most.get_legend_handles_labels(), frameon=False, fontsize=8, ncols=4, **place)
    rows[-1].set(xlabel="time, s")
    figure.suptitle(words(title, TITLE))
    return figure


def shade(axes: Axes, time: Any, leading: Any, models: Sequence[str]) -> None:
    """Colours the time by the most probable model; models that never lead are left out.

    Args:
        axes: with the time along x.
        time: ``(T,)`` seconds.
        leading: ``(T,)`` number of the most probable model.
        models: their names.
    """
    time, leading = np.asarray(time), np.asarray(leading)
    begins = np.flatnonzero(np.diff(leading, prepend=-1))
    widths = np.diff(time[begins], append=time[-1])
    for k, (name, colour) in enumerate(zip(models, cycle(_COLOURS), strict=False)):
        if (own := leading[begins] == k).any():
            spans = list(zip(time[begins][own], widths[own], strict=True))
            axes.broken_barh(spans, (0, 1), color=colour, alpha=0.35, linewidth=0, label=words(name),
                             transform=axes.get_xaxis_transform())  # fmt: skip

"""How probable each of several interacting models is."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from torchfra.cleaning.outputs.colours import REGIMES
from torchfra.plotting.labels import beside
from torchfra.plotting.style import TITLE, without_box, words


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
        axes.stackplot(time, values.T, colors=REGIMES, linewidth=0)
        axes.set(ylabel=words(name), ylim=(0, 1), xlim=(time[0], time[-1]))
        beside(axes, dict(zip(models[: values.shape[1]], cycle(REGIMES), strict=False)))
        without_box(axes)
    rows[-1].set(xlabel="time, s")
    figure.suptitle(words(title, TITLE))
    return figure

"""How a training went."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from torchfra.app.plotting.style import BLUE, RED, TITLE, finish, words

_BESIDE = 12
"""Lines of a legend that fit into a figure; more stand beside it."""


def learning_curve(rows: list[dict[str, float]], start: dict[str, float], title: str) -> Figure:
    """The losses over the iterations, and the learned values as multiples of where they started.

    Args:
        rows: one for each iteration, with ``"iteration"``, ``"loss"``, the values, and ``"validation"`` in some.
        start: the values before the first.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 6), layout="constrained")
    loss, values = figure.subplots(2, 1, sharex=True)
    time = [row["iteration"] for row in rows]
    checked = [row for row in rows if "validation" in row]
    at, validation = [row["iteration"] for row in checked], [row["validation"] for row in checked]
    loss.plot(time, [row["loss"] for row in rows], color=BLUE, linewidth=0.8, label="training batch")
    loss.plot(at, validation, "o-", color=RED, markersize=4, label="validation, hard decision")
    for name, first in start.items():
        value = np.array([row[name] for row in rows])
        # A value that began at 0 is a logarithm of odds: the odds are compared.
        label, change = (name, value / first) if first else (f"exp({name})", np.exp(value))
        values.plot([0, *time], [1.0, *change], label=words(label))
    loss.set(ylabel="loss", title=words(title, TITLE))
    values.set(xlabel="iteration", ylabel="times the start", yscale="log")
    for axes in (loss, values):
        finish(axes)
    if len(start) > _BESIDE:
        figure.set_size_inches(12, 6)
        values.legend(frameon=False, fontsize=7, ncols=2, loc="upper left", bbox_to_anchor=(1.0, 2.1))
    return figure

"""How a training went."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from torchfra.cleaning.outputs.colours import BLUE, RED
from torchfra.plotting.labels import name_lines
from torchfra.plotting.style import TITLE, finish, line_styles, words

_ROW = 0.18
"""Height of a name beside the values, inches."""


def learning_curve(rows: list[dict[str, float]], start: dict[str, float], title: str) -> Figure:
    """The losses over the iterations, and the learned values as multiples of where they started.

    Args:
        rows: one for each iteration, with ``"iteration"``, ``"loss"``, the values, and ``"validation"`` in some.
        start: the values before the first.
        title: of the figure.
    """
    figure = Figure(figsize=(9, 3 + max(3.0, _ROW * len(start))), layout="constrained")
    loss, values = figure.subplots(2, 1, sharex=True, height_ratios=[3, max(3.0, _ROW * len(start))])
    time = [row["iteration"] for row in rows]
    checked = [row for row in rows if "validation" in row]
    at, validation = [row["iteration"] for row in checked], [row["validation"] for row in checked]
    (batch,) = loss.plot(time, [row["loss"] for row in rows], color=BLUE, linewidth=0.8)
    (valid,) = loss.plot(at, validation, "o-", color=RED, markersize=4)
    learned, styles = {}, line_styles(start)
    for name, first in start.items():
        value = np.array([row[name] for row in rows])
        # A value that began at 0 is a logarithm of odds: the odds are compared.
        label, change = (name, value / first) if first else (f"exp({name})", np.exp(value))
        (learned[label],) = values.plot([0, *time], [1.0, *change], **styles[name])
    loss.set(ylabel="loss", title=words(title, TITLE))
    values.set(xlabel="iteration", ylabel="times the start", yscale="log")
    for axes in (loss, values):
        finish(axes)
    name_lines(figure, {loss: {"training batch": batch, "validation, hard decision": valid}, values: learned})
    return figure

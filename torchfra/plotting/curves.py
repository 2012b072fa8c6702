"""A path in the plane, and what was learned over the iterations."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchfra.pictures import BLACK, BLUE, DARK, RED
from torchfra.plotting.labels import in_free_places, named
from torchfra.plotting.style import TITLE, finish, lay_out, line_styles, words

WIDE = {"color": BLACK, "linewidth": 4, "alpha": 0.25, "solid_capstyle": "round"}
"""Style of a true path, under the estimates."""
_ROW = 0.18
"""Height of a name beside learned values, inches."""


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
    shown = {"truth": truth[:, :2].numpy() / 1000} | {name: of[:, :2].numpy() / 1000 for name, of in estimates.items()}
    for name, path in shown.items():
        axes.plot(*path.T, **(WIDE if name == "truth" else styles[name]))
    if stations is not None:
        paths = stations.unflatten(-1, (-1, 2)).movedim(-2, 0).numpy() / 1000
        for path in paths:
            axes.plot(*path.T, color=DARK, linestyle=":", linewidth=1)
        shown["stations"] = paths.reshape(-1, 2)
    axes.set(xlabel="x, km", ylabel="y, km", title=words(title, TITLE), aspect="equal", adjustable="datalim")
    finish(axes)
    lay_out(figure)  # labels are put where there is room, which the layout decides
    colours = {"truth": DARK, "stations": DARK} | {name: style["color"] for name, style in styles.items()}
    in_free_places(axes, {name: path[np.isfinite(path).all(1)] for name, path in shown.items()}, colours)
    return figure


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
    return named(figure, {loss: {"training batch": batch, "validation, hard decision": valid}, values: learned})

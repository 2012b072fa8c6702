"""True paths of targets and their estimates."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from torchfra.cleaning.outputs.colours import APART, BLACK, DARK, GREY
from torchfra.plotting.labels import SIZE, in_free_places
from torchfra.plotting.style import TITLE, finish, lay_out, line_styles, words

_WIDE = {"color": BLACK, "linewidth": 4, "alpha": 0.25, "solid_capstyle": "round"}
"""Style of a true path, under the estimates."""


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
        axes.plot(*path.T, **(_WIDE if name == "truth" else styles[name]))
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
    axes.scatter(*(measured.mT / 1000).numpy(), s=2, color=GREY, alpha=0.4, depthshade=False)
    for i, (path, mean) in enumerate(zip(truth, estimates, strict=False)):
        colour = APART[i % len(APART)]
        axes.plot(*(path[:, :3].mT / 1000).numpy(), **_WIDE)
        axes.plot(*(mean[:, :3].mT / 1000).numpy(), color=colour, linewidth=1.4)
        others = torch.cat([truth[:i], truth[i + 1 :]])[..., :3].reshape(-1, 3)
        apart = torch.cdist(path[:, :3].contiguous(), others).amin(-1) if len(others) else path[:, 0]
        axes.text(*(path[apart.nan_to_num(0.0).argmax(), :3] / 1000).tolist(), f" target {i + 1}", color=colour,
                  fontsize=SIZE)  # fmt: skip
    axes.set(xlabel="east, km", ylabel="north, km", zlabel="up, km")
    axes.set_title(f"{words(title, TITLE)}\nwide: truth; lines: filtered; dots: measured", fontsize=10)
    return figure

"""Errors of one run, beside what its estimates say of them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from torch import Tensor

from torchfra.cleaning.outputs.colours import BLUE, PALE_BLUE
from torchfra.plotting.style import TITLE, words


def bands(errors: Mapping[str, tuple[Tensor, Tensor]], dt: float, ylabel: str, title: str) -> Figure:
    """Errors over time and bands of two standard deviations, a panel for each kind of estimate.

    Args:
        errors: by kind, the errors ``(T,)`` of one coordinate and their standard deviations ``(T,)``.
        dt: seconds per step.
        ylabel: what the errors are of, with the unit.
        title: of the figure.
    """
    figure = Figure(figsize=(8, 2 * len(errors)), layout="constrained")
    panels = figure.subplots(len(errors), sharex=True, sharey=True, squeeze=False)[:, 0]
    for axes, (kind, (error, std)) in zip(panels, errors.items(), strict=True):
        time, wide = dt * np.arange(1, len(error) + 1), 2 * std.numpy()
        axes.fill_between(time, -wide, wide, color=PALE_BLUE, linewidth=0)
        axes.plot(time, error.numpy(), color=BLUE, linewidth=1)
        axes.set(ylabel=f"{kind}\n{ylabel}")
    panels[0].set_title(words(title, TITLE))
    panels[-1].set_xlabel("time, s")
    return figure

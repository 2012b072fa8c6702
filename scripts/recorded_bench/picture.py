"""Paths and errors over time of what presets made of recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from recorded_bench.tracks import Found, Track
from torchfra import metrics
from torchfra.cleaning.outputs.colours import BLACK, GREY
from torchfra.plotting.style import TITLE, finish, line_styles, words


def picture(tracks: Sequence[Track], found: Mapping[str, Mapping[str, Found]]) -> Figure:
    """A row for each recording: the path in the plane, and how far estimates on line are from it over time."""
    figure = Figure(figsize=(12, 4.5 * len(tracks)), layout="constrained")
    rows = figure.subplots(len(tracks), 2, squeeze=False)
    for (path, error), track in zip(rows, tracks, strict=True):
        truth, time = track.truth.numpy(), np.cumsum(track.dt.numpy())
        path.plot(*truth[:, :2].T, color=BLACK, linewidth=4, alpha=0.25, label="truth")
        if track.fixes is not None:
            path.plot(*track.fixes[:, :2].numpy().T, ".", color=GREY, markersize=2, label="measured")
        styles = line_styles(found[track.name])
        for name, one in found[track.name].items():
            path.plot(*one.mean[:, :2].numpy().T, label=name, **styles[name])
            error.plot(time, metrics.error(one.mean, track.truth, slice(0, truth.shape[1])).numpy(), **styles[name])
        path.set(xlabel="x, m", ylabel="y, m", title=words(track.name, TITLE), aspect="equal", adjustable="datalim")
        path.legend(fontsize=8)
        error.set(xlabel="time, s", ylabel="error, m", yscale="symlog")
        finish(path)
        finish(error)
    return figure

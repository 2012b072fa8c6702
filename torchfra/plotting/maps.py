"""One flight on a map."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from torchfra.cleaning.outputs.colours import GREY
from torchfra.cleaning.outputs.view import corners
from torchfra.evaluation import Flight
from torchfra.plotting.labels import Array, in_free_places
from torchfra.plotting.style import finish, words

_OUTLIER = "#000000"
_ROOM = 1.5
"""Factor by which fixes may widen the map of the true path; those further away are left out."""

_LONGEST = 30
"""Characters of a recording's name in the title; of longer ones it has the end."""


def draw_map(axes: Axes, flight: Flight, colours: Mapping[str, str]) -> None:
    """The true path, what was measured, and what filters made of it, in km, or in m if it is small.

    Args:
        axes: where to draw.
        flight: what to draw.
        colours: of the filters, by name.
    """
    unit, factor = _unit(flight)
    for path in flight.truth.numpy() / factor:
        axes.plot(*path.T, color="black", linewidth=4, alpha=0.25, solid_capstyle="round")
    for name, of in _fixes(flight).items():
        mark, colour = (".", GREY) if name == "measured" else ("x", _OUTLIER)
        axes.plot(*(of / factor).T, linestyle="none", marker=mark, color=colour, zorder=3)
    for name, paths in reversed(flight.estimates.items()):
        for path in paths.numpy() / factor:
            axes.plot(*path.T, color=colours[name], linewidth=1.4)
    (left, bottom), (right, top) = _corners(flight)
    axes.set_xlim(left / factor, right / factor, auto=True)  # may be widened, so that both axes have the same scale
    axes.set_ylim(bottom / factor, top / factor, auto=True)
    axes.set(xlabel=f"x, {unit}", ylabel=f"y, {unit}", aspect="equal", adjustable="datalim")
    name = flight.name if len(flight.name) <= _LONGEST else f"...{flight.name[3 - _LONGEST :]}"
    axes.set_title(f"{words(name)}, {flight.time[0]:g} to {flight.time[-1]:g} s{_outside(flight)}", fontsize=10)
    finish(axes)


def label_map(axes: Axes, flight: Flight, colours: Mapping[str, str]) -> None:
    """Names what is on the map, once the figure has its layout."""
    _, factor = _unit(flight)
    lines = {"truth": flight.truth} | flight.estimates
    points = {name: _dense(paths.numpy()) for name, paths in lines.items()} | _fixes(flight)
    shades = {"truth": "#555555", "measured": "#777777", "outlier": _OUTLIER} | dict(colours)
    in_free_places(axes, {name: of / factor for name, of in points.items()}, shades)


def _fixes(flight: Flight) -> dict[str, Array]:
    """Positions that were measured, and those that are outliers: ``(k, 2)`` each."""
    fixes, outlying = flight.fixes.flatten(0, 1).numpy(), flight.outlying.flatten().numpy()
    return {"measured": fixes[~outlying], "outlier": fixes[outlying]}


def _outside(flight: Flight) -> str:
    """A note of how many measurements are not on the map, outliers without a position among them."""
    low, high = _corners(flight)
    fixes, outlying = flight.fixes.flatten(0, 1).numpy(), flight.outlying.flatten().numpy()
    count = int((((fixes < low) | (fixes > high)).any(1) | (outlying & np.isnan(fixes).any(1))).sum())
    return f", {count} measured elsewhere" if count else ""


def _dense(paths: Array) -> Array:
    """Points ``(k, 2)`` along paths ``(N, T, 2)``, ten for each step."""
    share = np.linspace(0, 1, 10, endpoint=False)[:, None]
    between = paths[:, :-1, None] + share * (paths[:, 1:, None] - paths[:, :-1, None])
    dense: Array = np.concatenate([between.reshape(-1, 2), paths[:, -1]])
    return dense


def _unit(flight: Flight) -> tuple[str, float]:
    low, high = _corners(flight)
    return ("km", 1000.0) if (high - low).max() >= 500 else ("m", 1.0)


def _corners(flight: Flight) -> tuple[Array, Array]:
    """Lower left and upper right of the map: the true path, and the fixes that are not too far from it."""
    path = flight.truth.flatten(0, 1).numpy()
    low, high = np.nanmin(path, 0), np.nanmax(path, 0)
    room = (_ROOM - 1) * max((high - low).max(), 1.0)
    return corners(low, high, flight.fixes.flatten(0, 1).numpy(), room)

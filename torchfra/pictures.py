"""What all pictures share: their colours, and how much of a plane they show."""

from __future__ import annotations

import numpy as np

from torchfra.numbers import Array

RED, BLUE, GREEN, PURPLE, ORANGE, SKY, BLACK = APART = (
    "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
)  # fmt: skip
"""Colours that colour-blind people distinguish too.

Source: Okabe & Ito (2008), "Color universal design": without yellow, which is pale on white.
"""
GREY, DARK, PALE_BLUE, BROWN = "#999999", "#555555", "#cfe4f3", "#8a5e00"
REGIMES = ("#d9d9d9", SKY, GREEN, PURPLE, RED, ORANGE, BLUE, BLACK)
"""Colours of areas; the first is that of the usual regime."""


def corners(low: Array, high: Array, fixes: Array, room: float) -> tuple[Array, Array]:
    """Lower left and upper right, with a margin, of a path and of the fixes that are at most ``room`` away from it."""
    near = fixes[((fixes > low - room) & (fixes < high + room)).all(1)]
    points = np.concatenate([[low], [high], near])
    low, high = points.min(0), points.max(0)
    margin = 0.04 * max((high - low).max(), 1.0)
    return low - margin, high + margin

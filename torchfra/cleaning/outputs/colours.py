"""Colours of all pictures."""

RED, BLUE, GREEN, PURPLE, ORANGE, SKY, BLACK = APART = (
    "#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000",
)  # fmt: skip
"""Colours that colour-blind people distinguish too.

Source: Okabe & Ito (2008), "Color universal design": without yellow, which is pale on white.
"""
GREY, DARK, PALE_BLUE, BROWN = "#999999", "#555555", "#cfe4f3", "#8a5e00"
REGIMES = ("#d9d9d9", SKY, GREEN, PURPLE, RED, ORANGE, BLUE, BLACK)
"""Colours of areas; the first is that of the usual regime."""

"""Residuals of fixes from lines, and from circles whose centre drifts, as of a target that circles in a thermal."""

from __future__ import annotations

import math

import torch
from torch import Tensor

IN_A_ROW = 8
"""Consecutive fixes to which a circle is fitted."""
_IN_A_LINE = 4
"""Consecutive fixes to which a line is fitted."""
_RATES = 96
"""Rates of turn that are tried, from none to a full circle between two fixes."""
_EVEN = 1.1
"""Ratio that the longest gap between such fixes may have to the shortest."""


def off_circles(z: Tensor, gap: Tensor) -> Tensor:
    """Standard deviations ``(T - 7, B)`` of eight fixes from a circle; NaN where some are missing or unevenly spaced.

    In complex numbers the fixes are ``a + b k + c exp(i w k)`` and noise, with the likeliest rate ``w``.  As the best
    of many rates fits noise too, the median of noise alone is 0.78 of its standard deviation.

    Args:
        z: ``(T, 2, B)`` m, NaN where there is none.
        gap: ``(T, B)`` seconds since the step before.
    """
    fixes, gaps = z.unfold(0, IN_A_ROW, 1), gap[1:].unfold(0, IN_A_ROW - 1, 1)
    number = torch.arange(IN_A_ROW, dtype=z.dtype)
    line = torch.stack([torch.ones_like(number), number], 1)
    beside_line = torch.linalg.qr(line, mode="complete")[0][:, 2:]
    x, y = ((fixes[:, axis] - fixes[:, axis, :, :1]) @ beside_line for axis in (0, 1))
    both = torch.complex(x, y)

    def circles(rate: Tensor) -> Tensor:
        """Unit vectors ``(..., 6)`` of circles with rates ``(...)``, orthogonal to all lines."""
        turn = rate.unsqueeze(-1) * number
        circle: Tensor = torch.polar(torch.ones_like(turn), turn) @ beside_line.to(both)
        return circle / circle.abs().square().sum(-1, keepdim=True).sqrt()

    rates = torch.arange(1, _RATES, dtype=z.dtype) * (2 * math.pi / _RATES)
    explained = (both @ circles(rates).mH).abs().square()
    best = explained.argmax(-1, keepdim=True).clamp(1, len(rates) - 2)
    before, there, after = (explained.gather(-1, best + k)[..., 0] for k in (-1, 0, 1))
    beyond = 0.5 * (after - before) / (2 * there - before - after).clamp_min(1e-300)  # the top of a parabola
    likeliest = circles(rates[best[..., 0]] + beyond.clamp(-1.0, 1.0) * rates[0])
    more = (both * likeliest.conj()).sum(-1).abs().square()
    left = (both.abs().square().sum(-1) - there.maximum(more)).clamp_min(0.0)
    free = 2 * IN_A_ROW - 7  # of a, b and c, two numbers each, and the rate
    return (left / free).sqrt().where(gaps.amax(-1) <= _EVEN * gaps.amin(-1), math.nan)


def off_lines(z: Tensor) -> Tensor:
    """Standard deviations ``(T - 3, B)`` of four fixes across the likeliest line; NaN where some are missing.

    Of noise alone a fifth is below 0.33 of its standard deviation, and of noise along a line below 0.47.

    Args:
        z: ``(T, 2, B)`` m, NaN where there is none.
    """
    fixes = z.unfold(0, _IN_A_LINE, 1)
    x, y = (fixes - fixes.mean(-1, keepdim=True)).unbind(1)
    half = (x.square() - y.square()).sum(-1) / 2
    along = torch.hypot(half, (x * y).sum(-1)) + (x.square() + y.square()).sum(-1) / 2
    area = x.square().sum(-1) * y.square().sum(-1) - (x * y).sum(-1).square()
    return (area.clamp_min(0.0) / along.clamp_min(1e-300) / (_IN_A_LINE - 2)).sqrt()

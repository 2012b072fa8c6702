"""A heading that does not follow iron: a compass beside the turns of the wheels.

Near iron a compass turns by up to a radian for some ten seconds while the wheels do not.  Each of its readings is one
of two hypotheses, good or disturbed, which last as a Markov chain has them; the belief after a step is the Gaussian of
their moments (GPB1: Bar-Shalom, Li & Kirubarajan (2001), 11.6).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfra.angles import wrap

GOOD, DISTURBED = 0.1, 0.8
"""Standard deviations of a reading, rad."""
BEGINS, STAYS = 0.01, 0.9
"""Probability that a disturbance begins in a step, and its self-transition probability."""
TURN, STILL = 0.09, 0.01
"""Standard deviations of the turn in a step by the wheels, while they turn and while they do not, rad."""
LARGEST = 14.0
"""Largest log odds of either hypothesis."""
FIRST = 0.3
"""Standard deviation of the heading before the first reading, rad."""


def steadied(heading: Tensor, turns: Tensor, moving: Tensor) -> Tensor:
    """Headings ``(T,)``, rad, each by what was measured until then.

    Args:
        heading: ``(T,)`` of the compass, rad.
        turns: ``(T,)`` by the wheels, in the step that leads to each reading, rad.
        moving: ``(T,)`` whether the wheels turn.
    """
    mean, variance, disturbed, found = float(heading[0]), FIRST**2, BEGINS / (1 + BEGINS - STAYS), []
    for step, (reading, turn, moves) in enumerate(zip(heading.tolist(), turns.tolist(), moving.tolist(), strict=True)):
        if step:
            mean, variance = mean + turn, variance + (TURN if moves else STILL) ** 2
        disturbed = disturbed * STAYS + (1 - disturbed) * BEGINS
        gap = math.remainder(reading - mean, 2 * math.pi)
        innovation = [variance + noise**2 for noise in (GOOD, DISTURBED)]
        log_odds = math.log(disturbed / (1 - disturbed)) + sum(
            sign * (gap**2 / s + math.log(s)) / 2 for sign, s in zip((1, -1), innovation, strict=True)
        )
        disturbed = 1 / (1 + math.exp(-max(min(log_odds, LARGEST), -LARGEST)))
        weights, gains = (1 - disturbed, disturbed), [variance / s for s in innovation]
        moved = sum(w * gain * gap for w, gain in zip(weights, gains, strict=True))
        variance = sum(
            w * ((1 - gain) * variance + (gain * gap - moved) ** 2) for w, gain in zip(weights, gains, strict=True)
        )
        mean += moved
        found.append(mean)
    return wrap(torch.tensor(found, dtype=heading.dtype))

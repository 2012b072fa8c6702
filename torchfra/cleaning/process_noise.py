"""Levels of process noise of a kind of target, by its hardest acceleration and its largest speed."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchfra.cleaning.closed_form import Levels

_LEAST_DENSITY = 1e-5
"""Least density of the process noise, m^2/s^3."""
_LEAST_MOVE = 0.1
"""Largest displacement between two fixes by the least process noise, m."""
_LEAST_SECONDS = 1.0
"""Least duration of the hardest acceleration, s, however often a target is measured."""
LONGEST, _SHORTEST = 300.0, 15.0
"""Mean time that the least and the largest process noise last, s."""
_LEAST_CHANGE = 0.03
"""Change of the velocity between two fixes, m/s, from which on levels can be distinguished, if fixes are rarer than
changes of the level."""
_PERIODS = 3.0
"""Least duration of levels, in periods, where these are long: the mean over many levels changes slowly."""
_WALKS, _APART = 5, 2.5
"""Levels of a random walk between two fixes, and the ratio of the ways by which they move a target."""
_WALK_FIXES = 3.0
"""Duration of these levels, in fixes, as a target that rests moves now and then."""
_DRIFT_FIXES = 10.0
"""Duration of the least process noise beside them, in fixes: a drifter goes straight on where a swimmer may stop."""
_RARER = 3.0
"""Log of the prior ratio of the shares of the least and the largest process noise."""
_RAREST, _NEVER = -25.0, -60.0
"""Log of the least share, below which ``Levels.chain`` loses all digits; and that of levels which only other tracks of
a batch have, so that they are negligible."""


def levels_up_to(
    acceleration: Tensor, fastest: Tensor, period: Tensor, count: int, q: float | None = None,
    steady: Tensor | float = math.inf, way: Tensor | float = math.nan,
) -> Levels:  # fmt: skip
    """Levels from going straight to changes of the velocity by ``acceleration (B,)`` m/s^2 for a ``period (B,)`` s.

    Where a target can change its velocity by its speed within a period, and its hardest manoeuvres end within one, it
    may come, go and rest between two fixes, so that a fix determines only the distance of the next: there levels of a
    random walk are added.  Without them all motion without a velocity would be noise.  If fixes were more frequent,
    they would fit time-correlated errors; if rarer than ``steady``, the slow drifts of animals.  Of targets that
    go at random by a known ``way``, these levels have sizes about it.

    Args:
        acceleration: the hardest.
        fastest: ``(B,)`` the largest speed, m/s.
        period: between fixes.
        count: number of levels, without those of a random walk.
        q: density around which levels are likely, m^2/s^3; None if it is to be found.
        steady: ``(B,)`` s between fixes from which on a target may keep a slow course.
        way: ``(B,)`` usual one between fixes, m; NaN where none is known.
    """
    place = torch.linspace(0.0, 1.0, count, dtype=period.dtype).unsqueeze(1)
    density = _densities(acceleration, fastest, period, place)
    duration = (LONGEST * (_SHORTEST / LONGEST) ** place).expand_as(density)
    rarer = -_RARER * place if q is None else -0.5 * (density / max(q, _LEAST_DENSITY)).log10().square()
    share = _log_shares(rarer, period / duration)
    levels = Levels(density, share, duration.maximum(_PERIODS * (period - LONGEST)), torch.zeros_like(density))
    stops = fastest / acceleration  # seconds in which a target stops
    # Every 15 s, as many devices write, corners of a street take a vehicle as long; a walker is smooth yet.
    long = (period > _SHORTEST) | ((period == _SHORTEST) & (stops > _SHORTEST / 2))
    walking, farthest = may_stop(acceleration, fastest, period, steady) & long, fastest * period
    random = ~(torch.zeros_like(period) + way).isnan()
    walking, farthest = walking | random, torch.where(random, _APART ** (_WALKS // 2) * way, farthest)
    stops = torch.where(random, period / 4, stops)  # as likely as any other motion
    return _with_walks(levels, farthest, period, stops, walking) if q is None and walking.any() else levels


def with_levels_of_walks(levels: Levels, farthest: Tensor, period: Tensor) -> Levels:
    """Levels with those of a random walk, up to the ``farthest (B,)`` distance in a ``period (B,)`` s, m."""
    return _with_walks(levels, farthest, period, torch.ones_like(period), torch.ones_like(period, dtype=torch.bool))


def may_stop(acceleration: Tensor, fastest: Tensor, period: Tensor, steady: Tensor | float = math.inf) -> Tensor:
    """Whether targets ``(B,)`` may come, go and rest between two fixes: as ``levels_up_to`` says of its arguments."""
    return (period > (fastest / acceleration / 2).clamp_min(_SHORTEST / 2)) & (period <= steady)


def _densities(acceleration: Tensor, fastest: Tensor, period: Tensor, place: Tensor) -> Tensor:
    """Densities ``(J, B)``, m^2/s^3, from the least to the largest by equal ratios, at ``place (J, 1)`` from 0 to 1.

    The largest changes the velocity within a period by the hardest acceleration, which lasts for a second at least: for
    a car that is measured 20 times a second, over many periods.  Over a long period changes are no larger than the
    speed.  Without that limit a target with a fix every two hours could be anywhere at each, and no fix an outlier.
    """
    hardest = acceleration.square() * period.clamp_min(_LEAST_SECONDS)
    top = hardest.minimum(fastest.square() / period).clamp_min(10 * _LEAST_DENSITY)
    least = (3 * _LEAST_MOVE**2 / period**3).clamp_max(_LEAST_DENSITY)
    slow = torch.where(period > LONGEST, _LEAST_CHANGE**2 / period, least)
    return torch.cat([least.unsqueeze(0), (slow * (top / slow) ** place)[1:]])


def _log_shares(rarer: Tensor, ended: Tensor) -> Tensor:
    """Logs ``(J, B)`` of the shares of levels whose logs at any moment are ``rarer``.

    In a period in which levels begin and end many times, ``ended (J, B)`` on average, those that begin often are
    likelier, as the hardest of them determines the motion.
    """
    often = ended.log() - (-torch.expm1(-ended)).log()  # nearly 0 where levels last
    return (rarer + often).log_softmax(0).clamp_min(_RAREST).log_softmax(0)


def _with_walks(levels: Levels, farthest: Tensor, period: Tensor, stops: Tensor, walking: Tensor) -> Levels:
    """Adds levels of a random walk by shares of the ``farthest (B,)`` distance, m; targets stop in ``stops (B,)`` s.

    Targets that are not ``walking`` in a batch with those that are have more levels than they need.  These equal their
    smallest one: any other, however seldom it begins, would change the estimates.
    """
    number = torch.arange(_WALKS).flip(0).unsqueeze(1)
    size = walking * farthest / _APART**number
    walks = torch.where(walking, period / (period + 4 * stops), math.exp(_NEVER))
    usual = levels.duration[:1]
    drift, walk = (usual.maximum(walking * count * period) for count in (_DRIFT_FIXES, _WALK_FIXES))
    return Levels(
        torch.cat([levels.q, levels.q[:1].expand_as(size)]),
        torch.cat([levels.log_share + torch.log1p(-walks), (walks / _WALKS).log().expand_as(size)]),
        torch.cat([drift, levels.duration[1:], walk.expand_as(size)]),
        torch.cat([levels.walk, size.square() / period]),
    )

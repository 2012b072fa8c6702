"""The filter over regimes of the motion and qualities of the measurement."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import torch
from torch import Tensor

from torchfra.filters.checks import check_models
from torchfra.filters.gpb import GPB, EvenChain, Qualities, Regimes
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value, Values
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.sensors.base import Sensor


def gpb(
    motion: Motion | Sequence[Motion], sensor: Sensor, *, levels: Values | None = None, jumps: Values = (370.0,),
    regimes: Values | None = None, first: Values | None = None, stay: Value = 0.99, jump: Value = 1e-6,
    qualities: Values = ((0.98, 0.02), (0.7, 0.3)), sizes: Values = (10.0, 100.0, 1600.0, 1e8),
    shares: Values = (0.5, 0.35, 0.149, 0.001), poor: Value = 0.25, start: Value = 340.0, lag: int = 0,
    rule: Callable[[int], Rule] = third_degree, learn: Collection[str] = (),
) -> GPB:  # fmt: skip
    """The filter to reach for first: outliers, manoeuvres, jumps and a poor start as hypotheses of every step.

    Args:
        motion: how targets move; its regimes are calm, agile and a jump.  Of several motions of one state, or a
            ``Bank``, each is a regime, and the first one's prediction may jump.
        sensor: what is measured; outliers come per block of its elements (``Sensor.blocks``).
        levels: factors on the variance of the process noise, ascending: of calm and agile, (0.1, 10) if None; of a
            bank one for each motion, 1 if None.
        jumps: factors on the covariance of the position after a jump.
        regimes: ``(R, R)`` probabilities ``[i, j] = P(now j | was i)`` of levels and jumps, in this order; from
            ``stay`` and ``jump`` if None.
        first: ``(R,)`` probabilities of the regimes of the first step; all levels the same if None.
        stay: self-transition probability of every level; the others share the rest evenly.
        jump: probability of each jump.
        qualities: ``(2, 2)`` probabilities ``[i, j] = P(now j | was i)`` of clean and outlier, for each block.
        sizes: factors on the covariance of the measurement noise of outliers; with the largest, a measurement counts
            for next to nothing.
        shares: of the outliers that have each size.
        poor: probability that the prior is worth little.
        start: factor on the prior's covariance then.
        lag: 0 for an estimate from the measurements so far, 1 for one that the next measurement has settled; the
            other is in ``Estimate.info``.
        rule: makes the points for a number of states.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Raises:
        ValueError: motions that do not mix, probabilities that do not sum to one, or blocks of the sensor that do not
            cover its elements.
    """
    if not isinstance(motion, Motion | Sequence):
        raise ValueError(f"motion: expected one, several or a Bank, received {type(motion).__name__}")
    bank = isinstance(motion, Bank) or not isinstance(motion, Motion)
    models = motion if isinstance(motion, Motion) else Bank(motion)
    check_models(models, sensor)
    count = len(models) if isinstance(models, Bank) else 2
    levels = _several("levels", ((1.0,) * count if bank else (0.1, 10.0)) if levels is None else levels)
    jumps = _several("jumps", jumps)
    motions = range(count) if bank else [0] * levels.shape[-1]
    chain = EvenChain(len(motions), jumps.shape[-1], stay=stay, jump=jump) if regimes is None else regimes
    odds = _even(len(motions), jumps.shape[-1], jump) if first is None else first
    chances = Regimes(motions, levels=levels, jumps=jumps, chain=chain, first=odds, home=0 if bank else -1)
    doubts = Qualities(sensor.blocks, chain=qualities, sizes=sizes, shares=shares)
    f = GPB(models, sensor, regimes=chances, qualities=doubts, poor=poor, start=start, lag=lag, rule=rule)
    return with_learning(f, learn)


def _several(name: str, value: Values) -> Tensor:
    several = torch.as_tensor(value, dtype=torch.float64)
    if several.dim() == 0:
        raise ValueError(f"{name}: expected several, received {several.item():g}")
    return several


def _even(levels: int, jumps: int, jump: Value) -> Tensor:
    """Probabilities ``(..., R)`` of the first step: all levels the same."""
    jump = torch.as_tensor(jump, dtype=torch.float64).unsqueeze(-1)
    each = (1 - jumps * jump) / levels
    return torch.cat([each.expand(*jump.shape[:-1], levels), jump.expand(*jump.shape[:-1], jumps)], -1)

"""The filter over regimes of the motion and qualities of the measurement."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from torchfra.filters.checks import check_models
from torchfra.filters.gpb import GPB, Qualities, Regimes
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value, Values
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.presets.values import with_values
from torchfra.sensors.base import Sensor


@with_values
def gpb(
    motion: Motion | Sequence[Motion], sensor: Sensor, *, levels: Values = (0.00371, 0.933), jumps: Values = (6.5,),
    stay: Values = (0.9929, 0.28, 0.9988, 0.0013), renew: Values = (0.117, 0.38, 0.5029985, 1.5e-06),
    qualities: Values = ((0.99913, 0.00087), (0.84, 0.16)), sizes: Values = (4.7, 57.0, 1900.0, 20000.0),
    shares: Values = (0.47, 0.5215, 0.0061, 0.0024), poor: Value = 0.026, start: Value = 135.0, grows: bool = True,
    lag: int = 0, rule: Callable[[int], Rule] = third_degree, values: str | None = None, learn: Collection[str] = (),
) -> GPB:  # fmt: skip
    """The filter to reach for first: outliers, manoeuvres, jumps and a poor start as hypotheses of every step.

    Args:
        motion: how targets move; its regimes are calm, agile and a jump.  Of several motions of one state, or a
            ``Bank``, the first has these regimes, and each of the others is one more.
        sensor: what is measured; outliers come per block of its elements (``Sensor.blocks``).
        levels: factors on the variance of the (first) motion's process noise: of calm and agile.
        jumps: factors on the covariance of the position after a jump, per unit of the normalised innovation squared per
            element.
        stay: self-transition probabilities of the regimes: of each level, any other motion, each jump.
        renew: odds of the regime that follows one that does not stay, in the same order; they sum to one, and other
            motions share theirs evenly.
        qualities: ``(2, 2)`` probabilities ``[i, j] = P(now j | was i)`` of clean and outlier, for each block.
        sizes: factors on the covariance of the measurement noise of outliers.
        shares: of the outliers that have each size.
        poor: probability that the prior is worth little.
        start: factor on the prior's covariance then, but for parameters (``kinds`` of the motion).
        grows: whether the last of the sizes grows to what a measurement asks for.
        lag: 0 for an estimate from the measurements so far, 1 for one that the next measurement has settled; the
            other is in ``Estimate.info``.
        rule: makes the points for a number of states.
        values: name of a set of learned values for what is not given: ``torchfra.values()``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.

    Raises:
        ValueError: motions that do not mix, probabilities that do not sum to one, or blocks of the sensor that do not
            cover its elements.

    Example:
        >>> motion, sensor = torchfra.motion.ConstantVelocity(q=1.0), torchfra.sensors.Position(std=2.0)
        >>> prior = torchfra.Gaussian(torch.zeros(4), torch.eye(4))
        >>> estimate = torchfra.presets.gpb(motion, sensor)(torch.tensor([[0.1, 0.0], [0.0, 90.0]]), prior)
        >>> estimate.info.outlier[:, 0] > 0.5
        tensor([False,  True])
    """
    if not isinstance(motion, Motion | Sequence):
        raise ValueError(f"motion: expected one, several or a Bank, received {type(motion).__name__}")
    models = motion if isinstance(motion, Motion) else Bank(motion)
    check_models(models, sensor)
    count = len(models) if isinstance(models, Bank) else 1
    regimes = Regimes(count, levels=levels, jumps=jumps, stay=stay, renew=renew)
    doubts = Qualities(sensor.blocks, chain=qualities, sizes=sizes, shares=shares, grows=grows)
    f = GPB(models, sensor, regimes=regimes, qualities=doubts, poor=poor, start=start, lag=lag, rule=rule)
    return with_learning(f, learn)

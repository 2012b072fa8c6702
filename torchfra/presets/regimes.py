"""The filter over regimes of the motion and outliers of the measurement."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

from torchfra.filters.gpb import GPB, LearnedNoise, Outliers, Regimes
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value, Values, one_of
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.numbers import as_numbers
from torchfra.presets.preset import preset
from torchfra.sensors.base import Sensor
from torchfra.steps.models import check_models, of_a_module
from torchfra.suggestions import meant


def _and_hard(some: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Values for ``"some"`` manoeuvres, and for ``"hard"`` ones: a regime more, behind any other motion."""
    (*last, jump), (*begins, others, jumps) = some["durations"], some["restart"]
    hard = {"durations": (*last, 0.4343, jump), "restart": (*begins, others - 0.0001, 0.0001, jumps)}
    return {"some": some, "hard": some | hard | {"manoeuvre_factors": (100.0,)}}


MANOEUVRES: dict[str, dict[str, Any]] = {
    "none": {
        "noise_levels": (1.0,), "separate_levels": 0, "manoeuvre_factors": (), "jump_factors": (),
        "durations": (1078, 25.27), "restart": (0.076, 0.924),
    },
    "jumps": {
        "noise_levels": (1.0,), "separate_levels": 0, "manoeuvre_factors": (), "jump_factors": (7.56,),
        "durations": (1078, 25.27, 2.0), "restart": (0.076, 0.914, 0.01),
    },
    "slips": {
        "noise_levels": (1.0, 142.0), "separate_levels": 1, "manoeuvre_factors": (), "jump_factors": (7.56,),
        "durations": (1078, 500.0, 25.27, 2.0), "restart": (0.076, 0.006, 0.908, 0.01),
    },
    **_and_hard({
        "noise_levels": (0.00612, 0.08, 1.0, 30.0, 142.0, 2e4), "separate_levels": (0, 1, 3),
        "manoeuvre_factors": (), "jump_factors": (7.56,),
        "durations": (499.5, 499.5, 1078, 60.0, 19.5, 2.804, 25.27, 2.0),
        "restart": (0.0261, 0.003, 0.0613, 0.02, 0.005, 0.001, 0.8736, 0.01),
    }),
}  # fmt: skip
"""Values for each ``manoeuvres``.  Levels are a ladder, so that process noise that is stated a hundred times off either
way is near one of them, and the calm ones and that of 30 have beliefs of their own, as a single step hardly shows which
it is.  The larger ones share the stated one's: where a manoeuvre begins, they widen it at once.  Restarts of the calm
and the stated level were optimised; the calm level's duration is the largest with consistent covariances of turning
targets.  The others were chosen by hand: where the models hold, where process noise is stated wrongly, among spikes and
heavy tails, and in the scenarios of bearings."""

OF_BANKS: dict[str, dict[str, Any]] = MANOEUVRES | _and_hard({
    "noise_levels": (0.00612, 1.0, 2.05, 142.0, 2e4), "separate_levels": 1,
    "manoeuvre_factors": (), "jump_factors": (7.56,),
    "durations": (499.5, 1078, 7.007, 19.5, 2.804, 25.27, 2.0),
    "restart": (0.0291, 0.0613, 0.159, 0.005, 0.001, 0.7346, 0.01),
})  # fmt: skip
"""The values of several motions, which explain what a ladder of levels would explain as process noise."""

IN_SPACE: dict[str, dict[str, Any]] = MANOEUVRES | _and_hard({
    "noise_levels": (0.00612, 1.0, 142.0, 2e4), "separate_levels": 1,
    "manoeuvre_factors": (), "jump_factors": (7.56,),
    "durations": (499.5, 1078, 19.5, 2.804, 25.27, 2.0),
    "restart": (0.0346, 0.0729, 0.006, 0.0012, 0.8733, 0.012),
})  # fmt: skip
"""The values with climbs: those of ``OF_BANKS`` without the lower agile level, so that a step takes no longer."""

OUTLIER_TRANSITION = ((0.98, 0.02), (0.6, 0.4))


@preset("gpb", words="outliers and manoeuvres as hypotheses", either=True, emphasised=True)
def gpb(
    motion: Motion | Sequence[Motion],
    sensor: Sensor,
    *,
    manoeuvres: str | None = None,
    noise_levels: Values | None = None,
    separate_levels: int | Sequence[int] | None = None,
    manoeuvre_factors: Values | None = None,
    jump_factors: Values | None = None,
    self_transition: Values | None = None,
    restart: Values | None = None,
    burst: Value = 4.0,
    durations: Values | None = None,
    climbs: bool | None = None,
    outlier_transition: Values | None = None,
    outlier_durations: Values | None = None,
    outlier_sizes: Values = (8.77, 54.1, 1230.0, 21000.0),
    outlier_shares: Values = (0.35, 0.35, 0.15, 0.15),
    outlier_offsets: Values | None = None,
    unreliable: Value = 0.005,
    prior_outlier: Value = 0.001,
    prior_inflation: Value = 100.0,
    adaptive_largest_size: bool = True,
    outliers_update: bool = True,
    same_offset: Value | None = None,
    noise: str = "learned",
    noise_doubt: Value = 0.7,
    noise_memory: Value = 400.0,
    noise_least: float = 0.5,
    lag: int = 0,
    rule: Callable[[int], Rule] = third_degree,
    learn: Collection[str] = (),
) -> GPB:
    """The recommended filter: outliers, manoeuvres, jumps and an outlying prior are hypotheses of every step.

    Args:
        motion: how targets move; its regimes are levels of process noise and a jump.  Of several motions of one state,
            or a ``Bank``, the first has these regimes, and each other motion is one more regime.
        sensor: what is measured; each block of its elements has outliers of its own (``Sensor.blocks``).
        manoeuvres: manoeuvres that the (first) motion does not model: ``"none"``; ``"jumps"`` alone; ``"slips"``,
            also times in which it is less accurate than stated; ``"some"``; or ``"hard"``, also turns far beyond its
            process noise, at some loss of accuracy with outliers.  None is ``"slips"`` for a motion that measures
            itself, such as ``Odometry``, and ``"some"`` for any other.  It sets the defaults of the six arguments that
            follow: ``presets.regimes.MANOEUVRES`` and, of several motions, ``OF_BANKS``.
        noise_levels: factors on the variance of the (first) motion's process noise, ascending: calm levels, the stated
            process noise (1), and agile levels.  Calm and agile levels are for targets that do not move as stated.
        separate_levels: the number of lowest levels that keep beliefs of their own, or the indices of any; the others
            share one.  None is the value of ``manoeuvres``; where ``noise_levels`` are given it is the lowest of
            several.  Levels that share a belief can hardly be distinguished: with 0 errors of targets that hardly
            manoeuvre are far larger, as are those of targets that move unlike what is stated.
        manoeuvre_factors: factors on the variance of the stated process noise in a manoeuvre, per unit of the
            normalised innovation squared per element.
        jump_factors: factors on the covariance of the position after a jump, per unit of the normalised innovation
            squared per element.
        self_transition: instead of ``durations``, self-transition probabilities of the regimes, of a step whatever its
            ``dt``, in the same order.
        restart: restart distribution: probabilities of the regime that follows one that ends, in the same order; other
            motions share theirs evenly.  Of several jumps it says how likely each is beside the others.
        burst: how many equal outliers in a row are taken for outliers; a target whose measurements stay elsewhere for
            longer is taken to have jumped.  With 7 the jump's entry of ``durations`` should be some 8 measurements:
            else one jump in eight is followed with the ninth.  A sensor that is wrong for longer needs
            ``manoeuvres="none"``.
        durations: mean sojourn times of the regimes, s: of each level, any other motion, each manoeuvre, each jump; for
            three or more motions also one for each other motion.  That of a jump is in measurements, for which its
            belief stays apart from the others.  However long a step, levels of a single motion last for some two
            measurements at least.
        climbs: whether a calm target may climb or sink by the stated process noise: one more regime for each separate
            level, with its probabilities, and defaults ``presets.regimes.IN_SPACE``.  None is True for a motion in
            space (``Motion.vertical``) if no argument from ``noise_levels`` to ``durations`` is given.
        outlier_transition: ``(2, 2)`` probabilities ``[i, j] = P(now j | was i)`` of no outlier and outlier, for each
            block, from one measurement to the next; ``presets.regimes.OUTLIER_TRANSITION`` if None.
        outlier_durations: instead of it, mean sojourn times, s, without outliers and in a fault of the device.
        outlier_sizes: factors on the covariance of the measurement noise of outliers.
        outlier_shares: share of the outliers that have each size.
        outlier_offsets: mean of the noise of outliers of each size, in units of the nominal noise, as of ranges without
            a line of sight, which are too large; None for 0.
        unreliable: probability that a device is unreliable before its first measurement: that half of what it measures
            are large outliers, for some 200 measurements.
        prior_outlier: probability that the prior is an outlier: that its mean is far off.
        prior_inflation: factor on the prior's covariance in that case, except for components of kind ``"parameter"``;
            it grows with what the first measurement shows, so that the prior may be off by any distance.  1 is for a
            prior that is never in doubt.
        adaptive_largest_size: whether the largest size adapts to the squared residual of a measurement.
        outliers_update: whether outliers update the belief, as measurements with larger noise.
        same_offset: probability that an outlier after another has the same offset, as the fixes of a second target
            have; for linear sensors.  None for 0.
        noise: whether the scale of each block's measurement noise is ``"learned"`` from the inliers, or ``"stated"`` by
            the sensor; ``Estimate.info.noise`` has what it believes.
        noise_doubt: if learned, standard deviation of the log of the factor on the variance of the noise: with 0.7 a
            standard deviation is within a factor of 2 of what is stated in 95 of 100 sensors.
        noise_memory: if learned, number of measurements after which what was learned has fallen to 37 %.
        noise_least: if learned, factor on the stated variance below which the noise is not taken to be, from 0 to 1:
            errors that last look like motion, and who states a larger noise for them is right.
        lag: 0 for the filtered estimate, 1 for the one-step smoothed estimate; the other is in ``Estimate.info``.
        rule: from a dimension to the points: ``torchfra.gaussian.cubature``.
        **options

    Raises:
        ValueError: motions of different states, an unknown word for ``manoeuvres`` or ``noise``, probabilities that do
            not sum to one, ``climbs`` of a motion that is not in space, or blocks of the sensor that do not hold each
            element once.

    Example:
        >>> motion, sensor = torchfra.motion.ConstantVelocity(q=1.0), torchfra.sensors.Position(std=2.0)
        >>> prior = torchfra.Gaussian(torch.zeros(4), torch.eye(4))
        >>> estimate = torchfra.presets.gpb(motion, sensor)(torch.tensor([[0.1, 0.0], [0.0, 90.0]]), prior)
        >>> estimate.info.outlier[:, 0] > 0.5
        tensor([False,  True])
    """
    if not isinstance(motion, Motion | Sequence):
        received = f"{type(motion).__name__}{of_a_module('motion', motion)}"
        raise ValueError(f"motion: expected one, several or a Bank, received {received}")
    models = motion if isinstance(motion, Motion) else Bank(motion)
    check_models(models, sensor)
    count = len(models) if isinstance(models, Bank) else 1
    if manoeuvres is None:
        manoeuvres = "slips" if models.measures_itself else "some"
    if manoeuvres not in MANOEUVRES:
        received = f"{manoeuvres!r}{meant(manoeuvres, MANOEUVRES)}"
        raise ValueError(f"manoeuvres: expected one of {', '.join(MANOEUVRES)}, received {received}")
    one_of(noise=(noise, ("stated", "learned")))
    arguments = {
        "noise_levels": noise_levels, "separate_levels": separate_levels, "manoeuvre_factors": manoeuvre_factors,
        "jump_factors": jump_factors, "self_transition": self_transition, "durations": durations, "restart": restart,
    }  # fmt: skip
    given = {name: x for name, x in arguments.items() if x is not None}
    if climbs and not models.vertical:
        raise ValueError(f"climbs: expected a motion with a height and its rate, received {models.describe()}")
    climbs = bool(models.vertical) and not given if climbs is None else climbs
    values = (IN_SPACE if climbs else OF_BANKS if count > 1 else MANOEUVRES)[manoeuvres] | given
    if self_transition is not None and durations is None:
        del values["durations"]
    if separate_levels is None and noise_levels is not None:
        values["separate_levels"] = min(1, as_numbers(noise_levels, "noise_levels").shape[-1:].numel() - 1)
    regimes = Regimes(count, **values, burst=burst, vertical=models.vertical if climbs else ())
    if outlier_durations is None and outlier_transition is None:
        outlier_transition = OUTLIER_TRANSITION
    outliers = Outliers(
        sensor.blocks,
        outlier_transition=outlier_transition,
        outlier_durations=outlier_durations,
        outlier_sizes=outlier_sizes,
        outlier_shares=outlier_shares,
        outlier_offsets=outlier_offsets,
        adaptive_largest_size=adaptive_largest_size,
        outliers_update=outliers_update,
        unreliable=unreliable,
        same_offset=same_offset,
    )
    learned = LearnedNoise(noise_doubt, noise_memory, noise_least)  # checks values that nobody needs
    f = GPB(
        models,
        sensor,
        regimes=regimes,
        outliers=outliers,
        noise=None if noise == "stated" else learned,
        prior_outlier=prior_outlier,
        prior_inflation=prior_inflation,
        lag=lag,
        rule=rule,
    )
    return f

"""Keywords that several presets share, each documented here once."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypedDict

from torchfra.association.gates import Gate
from torchfra.gaussian.rules import Rule
from torchfra.hyper import Value
from torchfra.robust.base import Robust


class Group(Protocol):
    """A ``TypedDict`` of keywords."""

    __optional_keys__: frozenset[str]


class HuberOptions(TypedDict, total=False):
    """Of the robust update.

    threshold: in standard deviations of the measurement noise, 1.345 if not given: ``robust.Huber``.
    per_element: whether each element of a measurement has its own threshold.
    robust: another robust update instead of Huber weights; not together with ``threshold`` or ``per_element``.
    """

    threshold: Value | None
    per_element: bool
    robust: Robust | None


class FadingOptions(TypedDict, total=False):
    """Of the fading factors: ``adaptive.Fading`` has the defaults.

    weakening: above 1 the factors react less.
    forgetting: memory of the innovations, in [0, 1].
    fading_max: largest factor; with infinity, the paper's formula, the filter may diverge.
    rcond: smallest singular value that is inverted, as a share of the largest; with 0, the paper's, it may diverge.
    states: components that fade, one slice or several groups; the position if not given.
    share: of the factor for each group; if given, the groups are position, velocity, acceleration.
    trace: ``"full"``, or ``"position"`` to compare traces of the faded components only.
    """

    weakening: Value
    forgetting: Value
    fading_max: Value
    rcond: float
    states: slice | Sequence[slice] | None
    share: Value | Sequence[float] | None
    trace: str


class RobustAdaptiveOptions(HuberOptions, FadingOptions, total=False):
    """Those of the robust update and of the fading factors."""


class DecisionOptions(TypedDict, total=False):
    """Of the feedback decision: ``filters.FRA``.

    gate: normalised innovation squared above which a step is abnormal; 5.991 if not given.
    preference: log odds of the robust branch before the next measurement; 0 if not given.
    plain: log odds of a plain branch; no such branch if not given.
    patience: outliers in a row of one offset that are not followed.
    decision: branches are compared by the ``"normalised"`` innovation or by its ``"likelihood"``.
    temperature: 0, if not given, for hard decisions, above for soft ones, to train by.
    memory: innovations count ``"plain"``, or ``"weighted"`` by the robust weights.
    provisional: branch of an abnormal step until it is decided, ``"robust"`` (if not given) or ``"likeliest"``.
    final: branch of an abnormal last step: ``"robust"`` (if not given), ``"adaptive"``, ``"plain"`` or ``"likeliest"``.
    rule: from a dimension to the points, ``cubature.third_degree`` if not given.
    """

    gate: Value
    preference: Value
    plain: Value | None
    patience: float
    decision: str
    temperature: float
    memory: str
    provisional: str
    final: str
    rule: Callable[[int], Rule]


class FeedbackOptions(HuberOptions, FadingOptions, DecisionOptions, total=False):
    """Those of a filter that decides between a robust and an adaptive branch."""


class ChainOptions(TypedDict, total=False):
    """Of the chain of models: ``filters.IMM``.

    self_transition: probability that a model stays active; it switches to the others with equal probability.  It learns
        as one number.
    transition: ``(K, K)`` probabilities instead of ``self_transition``, ``[i, j] = P(now j | was i)``; its rows learn,
        and a step takes more time.  ``f.matrix()`` is that of another filter's ``self_transition``.
    durations: mean sojourn times of the models, s, one number or ``(K,)``, instead of ``self_transition``; then
        probabilities follow from ``dt``, and a ``transition`` is that at the end of a sojourn time.
    """

    self_transition: float
    transition: Value | None
    durations: Value | None


class ModelsOptions(ChainOptions, total=False):
    """Of interacting models.

    initial: ``(K,)`` probabilities of the models before the first step; uniform if not given.
    """

    initial: Value | None


class FeedbackModelsOptions(ModelsOptions, FeedbackOptions, total=False):
    """Those of interacting models, each with the filter of the feedback decision."""


class ScoreOptions(TypedDict, total=False):
    """Of the Huber score of the innovation: ``robust.HuberScore``.

    rule: from a dimension to the points, ``cubature.fifth_degree`` if not given.
    threshold: in standard deviations of the innovation, 1.345 if not given.
    eps: assumed share of outliers, or ``"minimax"``, if not given.
    """

    rule: Callable[[int], Rule]
    threshold: Value
    eps: Value | str


class NoiseOptions(TypedDict, total=False):
    """Of the estimated measurement noise: ``adaptive.SageHusa``.

    forgetting: memory of the innovations, in [0, 1]; 0.96 if not given.
    confidence: in the nominal noise, in [0, 1], one for each block of the sensor or one for all; 0.5 if not given.
    lowest: share of the nominal variance below which the estimate does not fall; 0.25 if not given.
    highest: multiple of the nominal variance above which the estimate does not rise; 1e4 if not given.
    warmup: first innovations, which change nothing; 5 if not given.
    adapt: by the ``"innovation"``, before the update (if not given), or the ``"residual"``, after it.
    """

    forgetting: Value
    confidence: Value | Sequence[float]
    lowest: float
    highest: float
    warmup: int
    adapt: str


class ScansOptions(TypedDict, total=False):
    """Of data association: ``filters.JPDA``.

    gate: measurements that may be a target's: ``torchfra.association``.
    detection: probability that a target is measured, 0.95 if not given.
    lost: probability of so many misses in a row below which a track is lost; 0 for never.
    exact: targets and measurements of a cluster up to which association is exact, ``(4, 10)`` if not given.
    permutations: False for JPDA*, where targets stay beside one another; True if not given.
    temperature: 0, if not given, for gates with a hard edge, above for a soft one, to train by.
    """

    gate: Gate | None
    detection: Value
    lost: float
    exact: tuple[int, int]
    permutations: bool
    temperature: float


class NoiseScansOptions(NoiseOptions, ScansOptions, total=False):
    """Those of the estimated measurement noise and of data association."""


def picked(options: Mapping[str, Any], group: Group) -> dict[str, Any]:
    """Those of the options that a group has."""
    return {name: options[name] for name in options if name in group.__optional_keys__}

"""The feedback-decision robust adaptive filters."""

from __future__ import annotations

from collections.abc import Collection

from typing_extensions import Unpack

from torchfra import register
from torchfra.filters.fra import FRA
from torchfra.motion.base import Motion
from torchfra.presets.learning import with_learning
from torchfra.presets.options import DecisionOptions, FadingOptions, FeedbackOptions, HuberOptions, picked, with_options
from torchfra.presets.single import robust_and_fading
from torchfra.presets.values import with_values
from torchfra.sensors.base import Sensor


@register.filter("fra_srckf", words="robust or adaptive, as published, with two bounds", gated=True, emphasised=True)
@with_options(HuberOptions, FadingOptions, DecisionOptions)
def fra_srckf(
    motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[FeedbackOptions]
) -> FRA:
    """Robust or adaptive at abnormal steps, as the next measurement decides.  Source: Wang et al. (2021), section 2.2.

    Decisions are by the normalised innovation, memory is plain, and patience is 0 if not given.

    Args:
        motion: how targets move.
        sensor: what is measured.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
        **options
    """
    update, fading = robust_and_fading(sensor, learn, options)
    return with_learning(FRA(motion, sensor, robust=update, fading=fading, **picked(options, DecisionOptions)), learn)


@register.filter("fra", words="robust or adaptive, by the likelihood of the next", gated=True, emphasised=True)
@with_values
@with_options(HuberOptions, FadingOptions, DecisionOptions)
def fra(
    motion: Motion, sensor: Sensor, *, values: str | None = None, learn: Collection[str] = (),
    **options: Unpack[FeedbackOptions],
) -> FRA:  # fmt: skip
    """This package's filter: ``fra_srckf`` with ``decision="likelihood", memory="weighted", patience=4, rcond=0.2``.

    Args:
        motion: how targets move.
        sensor: what is measured.
        values: name of a set of learned values for what is not given: ``torchfra.values()``.
        learn: names of hyperparameters to learn, or ``"all"``: ``torchfra.presets``.
        **options
    """
    own: FeedbackOptions = {"decision": "likelihood", "memory": "weighted", "patience": 4.0, "rcond": 0.2, **options}
    return fra_srckf(motion, sensor, learn=learn, **own)

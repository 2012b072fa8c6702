"""The feedback-decision robust adaptive filters."""

from __future__ import annotations

from collections.abc import Collection

from typing_extensions import Unpack

from torchfra.filters.fra import FRA
from torchfra.motion.base import Motion
from torchfra.presets.options import DecisionOptions, FadingOptions, FeedbackOptions, HuberOptions, picked
from torchfra.presets.preset import preset
from torchfra.presets.single import robust_and_fading
from torchfra.sensors.base import Sensor


@preset("fra_srckf", HuberOptions, FadingOptions, DecisionOptions, gated=True, emphasised=True,
        words="robust or adaptive, as published, with two bounds")  # fmt: skip
def fra_srckf(
    motion: Motion, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[FeedbackOptions]
) -> FRA:
    """Robust or adaptive at abnormal steps, as the next measurement decides.  Source: Wang et al. (2021), section 2.2.

    Decisions are by the normalised innovation, memory is plain, and patience is 0 if not given.

    Args:
        **options
    """
    return FRA(motion, sensor, **robust_and_fading(sensor, options), **picked(options, DecisionOptions))


@preset("fra", HuberOptions, FadingOptions, DecisionOptions, gated=True, emphasised=True,
        words="robust or adaptive, by the likelihood of the next")  # fmt: skip
def fra(
    motion: Motion, sensor: Sensor, *, values: str | None = None, learn: Collection[str] = (),
    **options: Unpack[FeedbackOptions],
) -> FRA:  # fmt: skip
    """This package's filter: ``fra_srckf`` with ``decision="likelihood", memory="weighted", patience=4, rcond=0.2``.

    Args:
        **options
    """
    own: FeedbackOptions = {"decision": "likelihood", "memory": "weighted", "patience": 4.0, "rcond": 0.2, **options}
    return fra_srckf(motion, sensor, **own)

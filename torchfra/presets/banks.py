"""Interacting models: a filter around a bank of motions."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from typing_extensions import Unpack

from torchfra import register
from torchfra.filters.base import Filter
from torchfra.filters.imm import IMM
from torchfra.filters.likely_models import LikelyModels
from torchfra.hyper import Value
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.numbers import as_number, fraction
from torchfra.presets.feedback import fra
from torchfra.presets.options import (
    ChainOptions,
    DecisionOptions,
    FadingOptions,
    FeedbackModelsOptions,
    FeedbackOptions,
    HuberOptions,
    ModelsOptions,
    picked,
)
from torchfra.presets.preset import preset
from torchfra.presets.single import srckf
from torchfra.sensors.base import Sensor

Models = Sequence[Motion] | Bank
Inner = Callable[[Motion, Sensor], Filter]


@preset("imm", ChainOptions, ModelsOptions, words="interacting motions", bank=True, listed=False)
def imm(
    models: Models, sensor: Sensor, *, inner: Inner = srckf, learn: Collection[str] = (),
    **options: Unpack[ModelsOptions],
) -> IMM:  # fmt: skip
    """Interacting multiple models.

    Args:
        inner: the filter of each model, ``(motion, sensor) -> Filter``: a preset, or a ``functools.partial`` of one.
        **options

    Raises:
        ValueError: a single motion, or ``self_transition`` that is no probability between 0 and 1.

    Source: Blom & Bar-Shalom (1988); Du & Zhang (2020) for the square-root cubature form.
    """
    bank = _bank(models)
    initial = options.pop("initial", None)
    return IMM(inner(bank, sensor), **_chain(len(bank), options), initial=initial)


@preset("imm_srckf", ChainOptions, ModelsOptions, words="interacting motions", bank=True)
def imm_srckf(models: Models, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[ModelsOptions]) -> IMM:
    """``imm`` with ``srckf`` for each model.  Source: Du & Zhang (2020).

    Args:
        **options
    """
    return imm(models, sensor, **options)


imm_ckf = register.filter("imm_ckf", words="imm_srckf", bank=True, listed=False)(imm_srckf)
"""``imm_srckf`` under the name of the filter with which Du & Zhang (2020) compare theirs.

Covariances and their roots have the same estimates up to rounding, so they cannot explain the difference in accuracy
that the paper reports.  This filter computes with roots too.
"""


@preset("imm_fra", ChainOptions, ModelsOptions, HuberOptions, FadingOptions, DecisionOptions,
        words="interacting motions, each with fra", bank=True, gated=True)  # fmt: skip
def imm_fra(
    models: Models, sensor: Sensor, *, learn: Collection[str] = (), **options: Unpack[FeedbackModelsOptions]
) -> IMM:
    """``imm`` with ``fra`` for each model: for manoeuvring targets and sensors with outliers.

    ``self_transition`` is 0.99, so that one outlier does not change the model, and ``preference`` is 5, as the bank
    explains manoeuvres, so the rest are outliers.

    Args:
        **options
    """
    chain = {"self_transition": 0.99} | picked(options, ModelsOptions)
    inner = partial(fra, **{"preference": 5.0} | picked(options, FeedbackOptions))
    return imm(models, sensor, inner=inner, **chain)


@preset("vsimm_srckf", ChainOptions, words="interacting motions, a few at a time", bank=True, neighbours=True)
def vsimm_srckf(
    models: Models, sensor: Sensor, *, inner: Inner = srckf, neighbours: Sequence[Sequence[int]] | None = None,
    first: Sequence[int] | None = None, unlikely: Value = 0.05, principal: Value = 0.5, values: str | None = None,
    learn: Collection[str] = (), **options: Unpack[ChainOptions],
) -> IMM:  # fmt: skip
    """Interacting models of which a few are active at a time, in the paper three of five.  Source: Du & Zhang (2020).

    Args:
        inner: the filter of each model, ``(motion, sensor) -> Filter``: a preset, or a ``functools.partial`` of one.
        neighbours: of each model, those that it may activate, see ``filters.LikelyModels``; the bank's if None.
        first: models that are active first; the bank's if None: ``filters.LikelyModels``.
        unlikely: probability below which a model is unlikely: ``filters.LikelyModels``.
        principal: probability above which a model activates its neighbours: ``filters.LikelyModels``.
        **options

    Raises:
        ValueError: a single motion, neither ``neighbours`` and ``first`` nor a bank that has them, or
            ``self_transition`` that is no probability between 0 and 1.
    """
    bank = _bank(models)
    neighbours = bank.neighbours if neighbours is None else neighbours
    first = bank.first if first is None else first
    if neighbours is None or first is None:
        raise ValueError("neighbours, first: expected both, or a Bank that has them, received none")
    subset = LikelyModels(neighbours, first, unlikely=unlikely, principal=principal)
    chain = _chain(len(bank), options, matrix=True)
    return IMM(inner(bank, sensor), **chain, subset=subset)


def _bank(models: Models) -> Bank:
    if isinstance(models, Motion) and not isinstance(models, Bank):
        raise ValueError(f"models: expected several motions or a Bank, received {type(models).__name__}")
    return models if isinstance(models, Bank) else Bank(models)


def _chain(count: int, options: Mapping[str, Any], matrix: bool = False) -> dict[str, Any]:
    """What ``IMM`` takes for the options of a chain of ``count`` models: with ``matrix`` no single number."""
    self_transition: float = options.get("self_transition", 0.95)
    transition, durations = options.get("transition"), options.get("durations")
    if durations is not None:
        return {"transition": transition, "durations": durations}
    if not matrix and transition is None and count > 1 and 1 / count <= as_number(self_transition) < 1:
        return {"self_transition": self_transition}
    fraction("self_transition", self_transition)
    if transition is None:
        eye = torch.eye(count, dtype=torch.float64)
        others = (1 - self_transition) / (count - 1) if count > 1 else 0.0
        transition = (self_transition if count > 1 else 1.0) * eye + others * (1 - eye)
    return {"transition": transition}

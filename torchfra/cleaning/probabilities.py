"""What filters of all kinds say of each step: whether it was an outlier, and which regime flew it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.cleaning.batches import Steps
from torchfra.filters import GPB, AlphaBetaInfo, Filter, FRAInfo, GPBInfo
from torchfra.filters.smoothing import SmoothInfo
from torchfra.motion.bank import Bank
from torchfra.readers.columns import Array
from torchfra.types import Estimate


def outlier_of(estimate: Estimate) -> Tensor:
    """Probability ``(..., T)`` that a fix is an outlier, in any of its elements; NaN of filters that do not say."""
    info = estimate.info
    if isinstance(info, SmoothInfo) and info.outlier is None:
        info = info.filtered.info
    match info:
        case AlphaBetaInfo(rejected=rejected):
            return rejected.any(-1).to(estimate.nis)
        case FRAInfo(abnormal=abnormal, adaptive=adaptive, plain=plain):
            return (abnormal & ~adaptive & ~plain).to(estimate.nis)
        case object(outlier=Tensor() as probability):
            return probability.amax(-1)
    return torch.full_like(estimate.nis, torch.nan)


def regimes_of(f: Filter, estimate: Estimate) -> tuple[tuple[str, ...], Tensor]:
    """Names of what the filter weighs at each step, and its probabilities ``(..., T, R)``; none of a single motion."""
    info = estimate.info
    weights = info.probabilities if isinstance(info, SmoothInfo) else None
    if weights is None:
        info = info.filtered.info if isinstance(info, SmoothInfo) else info
        weights = info.regimes if isinstance(info, GPBInfo) else getattr(info, "probabilities", None)
    motions = tuple(f.motion.names) if isinstance(f.motion, Bank) else ()
    if isinstance(f, GPB):
        first, *others = motions
        motions = f"calm {first}", f"agile {first}", *others, "jump"
    if weights is None or not motions:
        return (), estimate.nis.new_zeros(*estimate.nis.shape, 0)
    return motions, weights


def manoeuvre_of(regimes: Tensor) -> Tensor:
    """Probability ``(..., T)`` of any regime but the first, the calm one; NaN of filters without regimes."""
    if not regimes.shape[-1]:
        return regimes.new_full(regimes.shape[:-1], torch.nan)
    return 1 - regimes[..., 0]


def flags_of(steps: Steps, nis: Array, outlier: Array, manoeuvre: Array, gate: float) -> NDArray[np.str_]:
    """``(T,)`` of ``FLAGS``: by the probabilities, and where there are none by the gate, which tells no kind."""
    fix = steps.row >= 0
    flag = np.where(fix & np.isnan(outlier) & (nis > gate), "unclear", "")
    flag = np.where(np.nan_to_num(manoeuvre) > 0.5, "manoeuvre", flag)
    return np.where(fix & (np.nan_to_num(outlier) > 0.5), "outlier", flag)

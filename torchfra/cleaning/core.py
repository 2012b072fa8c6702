"""Cleans tracks: the work of ``torchfra track`` and ``torchfra.clean``."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchfra.catalogue import FILTERS, make_filter
from torchfra.cleaning.batches import Steps, groups, padded, steps_of
from torchfra.cleaning.cleaned import Cleaned, Found
from torchfra.cleaning.probabilities import flags_of, manoeuvre_of, outlier_of, regimes_of
from torchfra.filters import Filter
from torchfra.kernel.build import CompileError
from torchfra.motion.bank import Bank, aircraft
from torchfra.motion.polynomial import ConstantAcceleration
from torchfra.readers.recording import Recording
from torchfra.sensors.position import Position
from torchfra.types import Estimate, Gaussian

GATE = {2: 13.816, 3: 16.266}
"""Normalised innovation squared that one good fix in 1000 exceeds, by dimensions of space (chi-square)."""
DEFAULT = "gpb"
"""The filter that is used unless told otherwise."""
LONGEST_GAP = 60.0
"""Seconds without a usable fix after which a filter of constant gains restarts."""
Fallback = Callable[[str, str], None]
"""Called with the name of a filter that has no kernel, and the reason."""
_TOGETHER = 32
"""Recordings that are filtered as one batch."""


def clean_tracks(
    recordings: Sequence[Recording],
    *,
    filter: str = DEFAULT,
    bank: str | Bank | None = None,
    sigma: float | None = None,
    q: float | None = None,
    smooth: bool = True,
    dt: float | None = None,
    compile: bool = False,
    fallback: Fallback | None = None,
    progress: bool = False,
) -> list[Cleaned]:
    """Recorded tracks, cleaned.

    Args:
        recordings: from ``torchfra.readers.read``.
        filter: its name, out of ``catalogue.track_filters()``.
        bank: of what targets: ``"aircraft"``, ``"ship"``, ``"vehicle"`` or ``"person"``, or a ``Bank`` of your own;
            None chooses by the data.
        sigma: standard deviation of a fix per axis, m; where fixes have their own, a factor on those.  None finds it.
        q: density of the process noise per second, m^2/s^3.  None finds it.
        smooth: whether each estimate knows the fixes after it; False is what a filter on line would say.
        dt: seconds; also estimates at every multiple of it after the first fix, beside those at the fixes.
        compile: whether to run compiled (``Filter.compile``); needs a C++ compiler.
        fallback: called if the filter cannot be compiled, and runs interpreted; None raises the error.
        progress: whether to show a bar.

    Returns:
        One for each recording, in their order.  A track that fails has estimates that are NaN, and says why.

    Raises:
        ValueError: an unknown filter or bank, or a value out of its range.
        CompileError: the filter cannot be compiled, and there is no ``fallback``.
    """
    check_settings(filter, sigma=sigma, q=q, dt=dt)
    done: dict[int, Cleaned] = {}
    f = partial(_filtered, name=filter, sigma=sigma or 25.0, q=q or 1.0, smooth=smooth, compile=compile)
    for group in groups(recordings, _TOGETHER):
        part = [recordings[i] for i in group]
        several = [steps_of(recording, dt) for recording in part]
        made, estimate = f(part, several, fallback=fallback)
        found = Found(filter, smooth, "aircraft", sigma or 25.0, q or 1.0, math.nan)
        done |= zip(group, _split(part, several, estimate, made, found), strict=True)
    return [done[i] for i in range(len(recordings))]


def check_settings(filter: str, *, sigma: float | None = None, q: float | None = None, dt: float | None = None) -> None:
    """Checks arguments of ``clean_tracks``.

    Raises:
        ValueError: an unknown filter, or a value out of its range.
    """
    if sigma is not None and not 0 < sigma < math.inf:
        raise ValueError(f"sigma: expected metres above 0, received {sigma}")
    if q is not None and not 0 <= q < math.inf:
        raise ValueError(f"q: expected m^2/s^3 of 0 or more, received {q}")
    if dt is not None and not 0 < dt < math.inf:
        raise ValueError(f"dt: expected seconds above 0, received {dt}")
    _make(filter, 2, 1.0, 1.0, torch.ones(1))


def _filtered(
    recordings: Sequence[Recording], several: Sequence[Steps], *, name: str, sigma: float, q: float, smooth: bool,
    compile: bool, fallback: Fallback | None,
) -> tuple[Filter, Estimate]:  # fmt: skip
    z, gaps, std = padded(several)
    f, prior = _make(name, z.shape[-1], sigma, q, _periods(recordings)), _prior(z, sigma)
    stated = any(recording.sigma is not None for recording in recordings)
    run = partial(_run, smooth=smooth, z=z, prior=prior, dt=gaps, std=sigma * std if stated else None)
    if not compile:
        return f, run(f)
    try:
        return f, run(copy.copy(f).compile())
    except (CompileError, NotImplementedError) as error:
        if fallback is None:
            raise
        fallback(name, str(error))
    return f, run(f)


def _run(f: Filter, smooth: bool, **measured: Tensor | Gaussian | None) -> Estimate:
    with torch.no_grad():
        estimate: Estimate = f.smooth(**measured) if smooth else f(**measured)  # type: ignore[arg-type]
    return estimate


def _periods(recordings: Sequence[Recording]) -> Tensor:
    """Seconds ``(B,)`` within which nearly all fixes of each recording follow each other."""
    gaps = [np.diff(r.time) if len(r.time) > 1 else [1.0] for r in recordings]
    return torch.tensor([np.quantile(g, 0.9) for g in gaps], dtype=torch.float64)


def _prior(z: Tensor, sigma: float) -> Gaussian:
    """At the first fix, of any speed."""
    d = z.shape[-1]
    mean = torch.cat([z[:, 0], torch.zeros(len(z), 2 * d, dtype=torch.float64)], -1)
    std = torch.tensor([10 * sigma, 300.0, 5.0], dtype=torch.float64).repeat_interleave(d)
    return Gaussian(mean, std.diag())


def _make(name: str, d: int, sigma: float, q: float, period: Tensor) -> Filter:
    """The filter of this name for positions in ``d`` dimensions, where nearly all fixes come within ``period``."""
    entry, options = FILTERS.get(name), dict[str, object]()
    if entry is not None and entry.gated:
        options["gate"] = GATE[d]
    if entry is not None and entry.constant_gains:
        options |= {"longest": LONGEST_GAP, "period": period}
    return make_filter(name, ConstantAcceleration(q, d), Position(sigma, dims=d), aircraft(q, d), **options)


def _split(
    recordings: Sequence[Recording], several: Sequence[Steps], estimate: Estimate, f: Filter, found: Found
) -> list[Cleaned]:
    """What is known of each recording after they were filtered as one batch."""
    d = several[0].raw.shape[1]
    names, regimes = regimes_of(f, estimate)
    outlier = outlier_of(estimate)
    manoeuvre = manoeuvre_of(regimes)
    results = []
    for i, (recording, steps) in enumerate(zip(recordings, several, strict=True)):
        k = len(steps.time)
        mean, covariance = estimate.mean[i, :k, : 2 * d], estimate.covariance[i, :k, : 2 * d, : 2 * d]
        nis, wrong, other = (x[i, :k].numpy() for x in (estimate.nis, outlier, manoeuvre))
        result = Cleaned(
            recording, steps.time, steps.row, steps.raw, mean.numpy(), covariance.numpy(), nis, wrong, other,
            flags_of(steps, nis, wrong, other, GATE[d]), found, (), names, regimes[i, :k].numpy(),
        )  # fmt: skip
        results.append(result)
    return results

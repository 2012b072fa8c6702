"""Cleans tracks: the work of ``torchfra track`` and ``torchfra.clean``."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from torchfra.cleaning import time_stamps
from torchfra.cleaning.batches import Steps, groups, least_sigma, step_of_heights, steps_of
from torchfra.cleaning.cleaned import Cleaned, Found
from torchfra.cleaning.flags import GATE, MATTERS, flags
from torchfra.cleaning.kinds import KINDS, Kind, check_kind, check_speeds, kind_of
from torchfra.cleaning.positions import ROW, Answer, Settings, answers, period_of
from torchfra.cleaning.process_noise import LONGEST
from torchfra.cleaning.segments import inside, segments
from torchfra.cleaning.varying_sigma import with_varying_sigma
from torchfra.geodesy import to_geodetic
from torchfra.readers.columns import Array
from torchfra.readers.recording import Recording
from torchfra.running.jobs import finished, one_thread
from torchfra.tables import duration, metres

if TYPE_CHECKING:  # the default filter needs none of the others, whose import takes as long as cleaning a track
    from torchfra.filters import Filter
    from torchfra.motion.bank import Bank

DEFAULT = "gpb"
"""The filter that is used by default."""
_FEW = 10
"""Number of fixes below which sigma is unsure."""
_LITTLE_GAIN = 0.75
"""Share of the standard deviation of a fix above which its estimate is hardly more certain than the fix."""
_RETURNS, _HARDLY_MOVES, _WANDERS = 15.0, 2.5, (1.5, 3.5)
"""Seconds between fixes in which a target may go and come back; the usual way between fixes, in standard deviations,
below which that is not told from noise (of noise alone it is 1.7); and how many times as long the way over eight fixes
is of who wanders: 1 at rest, 2.8 if courses are forgotten, 8 of who goes straight on."""
_OPEN = 0.5
"""Sigma is unsure if one below this share of it is not ruled out."""
_REPEATED = 0.5
"""Factor on the stated standard deviations below which a track does not show them: its receiver has smoothed it."""
_AS_STATED = "Standard deviations are as stated: the track does not show which ones its fixes have"
_SWIMS = 3.0
"""Speed, m/s, that seals and turtles do not keep up, as filters of Argos take it.

Source: McConnell, Chambers & Fedak (1992), Antarctic Science 4, 393.
"""
_WORTHWHILE = 20_000
"""Fewest fixes of a process, whose start takes as long as cleaning some thousands."""
FAILURES = (ValueError, np.linalg.LinAlgError, torch.linalg.LinAlgError)  # type: ignore[attr-defined]
"""Errors that are reported as the failure of one track; all others are mistakes of the program and are raised."""


def clean_tracks(
    recordings: Sequence[Recording],
    *,
    filter: str = DEFAULT,
    bank: str | Bank | None = None,
    sigma: float | None = None,
    q: float | None = None,
    smooth: bool = True,
    dt: float | None = None,
    repair: bool = True,
    jobs: int = 1,
) -> list[Cleaned]:
    """Recorded tracks, cleaned.

    The default, ``"gpb"`` without a ``Bank`` of your own, weighs levels of process noise and outliers in closed form
    (``cleaning.closed_form``); ``Cleaned.filters`` gives the same as modules.
    Other filters run as the catalogue has them, with the sigma and q that this one has found.

    Args:
        recordings: from ``torchfra.readers.read``.
        filter: its name, out of ``catalogue.track_filters()``.
        bank: kind of target, or a ``Bank`` of your own, as of ``torchfra.clean``.
        sigma: standard deviation of a fix per axis, m, or a factor on those of the fixes; None finds it.
        q: density of the process noise per second, m^2/s^3; None finds it.
        smooth: whether estimates are smoothed; False gives those of a filter on line.
        dt: seconds; also estimates at every multiple of it.
        repair: whether fixes with wrong time stamps, as are frequent in ADS-B and AIS, are first moved along the path
            to where the target was: where tracks show such errors, and not for a filter on line.
        jobs: the most processes that share the work of the default filter.

    Returns:
        One for each recording, in their order.  A track that fails has estimates that are NaN, and says why.

    Raises:
        ValueError: an unknown filter or bank, one that targets are far too fast for, or a value out of its range.
        ChildProcessError: a process was killed, for example when memory ran out.
    """
    check_settings(filter, sigma=sigma, q=q, dt=dt, bank=bank)
    if jobs < 1:
        raise ValueError(f"jobs: expected 1 or more, received {jobs}")
    if isinstance(bank, str):
        check_speeds(recordings, bank)
    default = _is_default(filter, bank)
    settings = Settings(sigma, q, smooth, filter, bank, dt, repair and smooth)
    several = list[tuple[list[int], Settings]]()
    for argos, own in ((False, settings), (True, settings._replace(sigma=1.0))):  # whose errors are as they are stated
        chosen = [i for i, one in enumerate(recordings) if (sigma is None and one.source.argos) == argos]
        some = groups([recordings[i] for i in chosen], ROW if default else math.inf)[::-1]  # the longest tracks first
        several += [([chosen[i] for i in group], own) for group in some]
    fixes = sum(len(recording.time) for recording in recordings)
    jobs = min(jobs, len(several), fixes // _WORTHWHILE) if default else 1
    parts = [([recordings[i] for i in group], own) for group, own in several]
    done: dict[int, Cleaned] = {}
    for number, results in finished(_clean_group, parts, max(jobs, 1)):
        done |= zip(several[number][0], results, strict=True)
    return [replace(done[i], recording=recording) for i, recording in enumerate(recordings)]


def _clean_group(recordings: Sequence[Recording], settings: Settings) -> list[Cleaned]:
    """Cleans recordings of one batch; with ``settings.repair``, also their time stamps."""
    measured = [_as_measured(recording) for recording in recordings]
    moved = _moved(measured, settings.bank) if settings.repair else {}
    placed = [moved[i][0] if i in moved else recording for i, recording in enumerate(measured)]
    try:
        done = _clean_batch(placed, measured, settings)
    except FAILURES:  # of one recording; the others are cleaned without it
        done = [_alone(*of, settings) for of in zip(placed, measured, strict=True)]
    for i, (_, variance) in moved.items():
        done[i] = time_stamps.as_recorded(done[i], measured[i], variance)
    return done


def _moved(recordings: Sequence[Recording], bank: str | Bank | None) -> dict[int, tuple[Recording, Array]]:
    """Results of ``moved_along`` for recordings with wrong stamps, by number."""
    moved = {}
    for i, recording in enumerate(recordings):
        if np.isinf(recording.position).any():
            continue  # it fails later, with its reason
        _, kind = _kind(recording, bank)
        if time_stamps.stamps_are_wrong(recording, kind):
            moved[i] = time_stamps.moved_along(recording, kind)
    return moved


def _kind(recording: Recording, bank: str | Bank | None) -> tuple[str, Kind]:
    """The kind of a target, as given or as the file says, and its name."""
    return (bank, KINDS[bank]) if isinstance(bank, str) else kind_of(recording)


def _as_measured(recording: Recording) -> Recording:
    """The recording without altitudes that the reader has filled in."""
    if recording.filled is None or not recording.filled.any():
        return recording
    position = recording.position.copy()
    position[recording.filled, 2] = np.nan
    return replace(recording, position=position, filled=None)


def check_settings(
    filter: str, *, sigma: float | None = None, q: float | None = None, dt: float | None = None,
    bank: str | Bank | None = None,
) -> None:  # fmt: skip
    """Checks arguments of ``clean_tracks``.

    Raises:
        ValueError: an unknown filter or bank, or a value out of its range.
    """
    if sigma is not None and not 0 < sigma < math.inf:
        raise ValueError(f"sigma: expected metres above 0, received {sigma}")
    if q is not None and not 0 <= q < math.inf:
        raise ValueError(f"q: expected m^2/s^3 of 0 or more, received {q}")
    if dt is not None and not 0 < dt < math.inf:
        raise ValueError(f"dt: expected seconds above 0, received {dt}")
    if isinstance(bank, str):
        check_kind(bank)
    elif not (bank is None or _is_bank(bank)):
        raise ValueError(f"bank: expected a kind of target, a Bank or None, received {bank!r}")
    if filter != DEFAULT:
        from torchfra.cleaning.catalogue_filters import make

        one = torch.ones(1, dtype=torch.float64)
        make(filter, 2, one, one, one)


def _clean_batch(recordings: Sequence[Recording], measured: Sequence[Recording], settings: Settings) -> list[Cleaned]:
    """Recordings of the same dimensions, cleaned; how fine positions are is seen where they were ``measured``."""
    if any(np.isinf(recording.position).any() for recording in recordings):
        raise ValueError("position: expected finite metres or NaN, received infinity")
    names, kinds = zip(*(_kind(recording, settings.bank) for recording in recordings), strict=True)
    tracks = [
        steps_of(one, kind, settings.dt)._replace(least=least_sigma(of), height_step=step_of_heights(of))
        for one, kind, of in zip(recordings, kinds, measured, strict=True)
    ]
    default = _is_default(settings.filter, settings.bank)
    # Other filters take sigma and q from this one, but no estimates.
    closed_form = settings if default else settings._replace(smooth=False)
    with one_thread():
        found = answers(tracks, closed_form)
        # Aircraft that report themselves are located by satellites, whose errors do not grow with the range.
        asked = [recording.source.word != "aircraft" for recording in recordings]
        tracks, found = with_varying_sigma(tracks, closed_form, found, asked)
    every = [_found(settings, *of) for of in zip(names, tracks, found, strict=True)]
    if default:
        results = [_of_answer(*of) for of in zip(recordings, tracks, found, every, strict=True)]
    else:
        results = _by_filter(recordings, tracks, every, settings)
    again = [i for i, one in enumerate(results) if _is_stated(one) and one.found.sigma > 1 and one.found.sigma_unsure]
    if again:  # motion that is no noise may explain why fixes are farther off than they state
        some = _clean_batch(
            [recordings[i] for i in again], [measured[i] for i in again], settings._replace(sigma=1.0)
        )  # fmt: skip
        for i, one in zip(again, some, strict=True):
            results[i] = replace(one, found=replace(one.found, notes=(*one.found.notes, _AS_STATED)))
    return [_as_stated(*of) for of in zip(results, tracks, strict=True)]


def _is_stated(one: Cleaned) -> bool:
    """Whether fixes state their accuracy, and a factor on it was looked for."""
    return one.recording.sigma is not None and "sigma" in one.found.estimated


def _as_stated(one: Cleaned, steps: Steps) -> Cleaned:
    """The result with the standard deviations that the file states, where the track does not show its own.

    The residuals of fixes that a receiver has smoothed, or of ones too far apart, say nothing of how good they are, so
    no estimate is more certain than its fix.
    """
    found = one.found
    if not _is_stated(one) or (found.sigma >= _REPEATED and not found.sigma_unsure):
        return one
    d = one.raw.shape[1]
    at = np.maximum.accumulate(np.where(one.row >= 0, np.arange(len(one.time)), 0))  # of the last fix
    more = np.maximum(steps.std[at] ** 2 - np.diagonal(one.covariance, axis1=1, axis2=2)[:, :d], 0.0)
    covariance = one.covariance.copy()
    covariance[:, range(d), range(d)] += more
    found = replace(
        found, sigma=1.0, estimated=found.estimated - {"sigma"}, sigma_unsure="", notes=(*found.notes, _AS_STATED)
    )
    return replace(one, covariance=covariance, found=found)


def _of_answer(recording: Recording, steps: Steps, answer: Answer, found: Found) -> Cleaned:
    """The result of the default filter for a track."""
    result = _result(recording, steps, *answer[:5], found, answer.height)
    return replace(result, parameters=answer.parameters)


def _result(
    recording: Recording, steps: Steps, mean: Array, covariance: Array, nis: Array, outlier: Array, manoeuvre: Array,
    found: Found, sigma_of_height: float = math.nan,
) -> Cleaned:  # fmt: skip
    """A track with its estimates, flags and segments, and its mean NIS; the height's sigma is that of all if NaN."""
    fix = (steps.row >= 0) & ~np.isnan(steps.raw[:, :2]).any(1)  # an altitude may be missing
    origin, d = recording.origin, steps.raw.shape[1]
    height = to_geodetic(mean[:, :3], origin)[2] if origin is not None and d == 3 else None
    listed = segments(steps.time, mean, covariance, height)
    sigma = np.full(d, found.sigma if recording.sigma is None else max(found.sigma, 1.0))
    if not math.isnan(sigma_of_height):
        sigma[2] = sigma_of_height
    off = (steps.raw - mean[:, :d]) / (sigma * steps.std)
    matters = (np.linalg.norm(off[:, :2], axis=1) > MATTERS) | (np.abs(off[:, 2:]) > MATTERS).any(1)
    flag = flags(fix & matters, nis, outlier, manoeuvre, inside(steps.time, listed), GATE[d])
    good = fix & ~np.isnan(steps.raw).any(1) & (flag != "outlier")
    mean_nis = float(nis[good].mean() / d) if good.any() else math.nan
    found = replace(found, nis=mean_nis, stated=recording.sigma is not None)
    if recording.sigma is None and np.ptp(own := found.sigma * steps.std[steps.measured, 0]) > 0:
        note = f"Sigma varies along the track: {metres(own.min())} to {metres(own.max())}"
        found = replace(found, notes=(*found.notes, note))
    if recording.source.argos and (note := _fast(steps, mean)):
        found = replace(found, notes=(*found.notes, note))
    if "sigma" in found.estimated:
        found = replace(found, sigma_unsure=found.sigma_unsure or _why_unsure(steps, covariance, found.sigma))
    arrays = mean, covariance, nis, outlier, manoeuvre, flag
    result = Cleaned(recording, steps.time, steps.row, steps.raw, *arrays, found, listed)
    if result.failed.all():
        result = replace(result, found=replace(found, failure=f"NaN or infinity in all of {len(steps.time)} steps"))
    return result


def _fast(steps: Steps, mean: Array) -> str:
    """What is said of a path of Argos where it is faster than what swims; "" where it nowhere is."""
    at = steps.measured
    speed = np.linalg.norm(np.diff(mean[at, :2], axis=0), axis=1) / np.diff(steps.time[at])
    fast = int((speed > _SWIMS).sum())
    return f"Faster than what swims ({_SWIMS:g} m/s): {fast:,} of {len(speed):,} ways of the path" if fast else ""


def _why_unsure(steps: Steps, covariance: Array, sigma: float) -> str:
    """Why sigma is unsure; "" if estimates are more certain than their fixes, and these farther apart than noise."""
    fixes, at = steps.at(steps.measured), covariance[steps.measured]
    if len(fixes.time) < _FEW:
        return f"{len(fixes.time)} fixes are too few to estimate sigma"
    ratio = np.sqrt(np.trace(at[:, :2, :2], axis1=1, axis2=2) / 2) / (sigma * fixes.std[:, 0])
    if np.median(ratio) < _LITTLE_GAIN and not _returns(fixes, sigma):
        return ""
    return _unsure(fixes)


def _returns(fixes: Steps, sigma: float) -> bool:
    """Whether fixes are hardly farther apart than noise of a target that may return between them, and does not rest."""
    raw, std, period = fixes.raw[:, :2], sigma * fixes.std[:, 0], period_of(fixes)
    way, far = (float(np.median(np.linalg.norm(raw[k:] - raw[:-k], axis=1) / std[k:])) for k in (1, 8))
    wanders = period > LONGEST or _WANDERS[0] < far / max(way, 1e-9) < _WANDERS[1]
    return period >= _RETURNS and way < _HARDLY_MOVES and wanders


def _unsure(steps: Steps) -> str:
    """A sentence on a track in which noise and motion cannot be distinguished."""
    return f"Fixes {duration(period_of(steps))} apart hardly distinguish noise from motion: sigma is unsure"


def _is_default(name: str, bank: str | Bank | None) -> bool:
    """Whether a filter is the closed form, which divides long tracks into rows."""
    return name == DEFAULT and (bank is None or isinstance(bank, str))


def _is_bank(bank: object) -> bool:
    """Whether it is a ``Bank``; without an import, as there is none before its module is imported."""
    module = sys.modules.get("torchfra.motion.bank")
    return module is not None and isinstance(bank, module.Bank)


def _found(settings: Settings, kind: str, steps: Steps, answer: Answer) -> Found:
    """The settings of a track, and notes on it."""
    bank, notes = "own" if _is_bank(settings.bank) else kind, tuple[str, ...]()
    if not math.isnan(answer.height):
        notes = (*notes, f"Sigma of the height: {metres(answer.height)}")
    unsure = answer.lowest < _OPEN * answer.sigma and steps.measured.sum() >= _FEW
    estimated = frozenset(key for key in ("sigma", "q") if getattr(settings, key) is None)
    why = _unsure(steps) if unsure else ""
    return Found(
        settings.filter, settings.smooth, bank, answer.sigma, answer.q, math.nan, estimated, notes, sigma_unsure=why
    )


def _by_filter(
    recordings: Sequence[Recording], tracks: Sequence[Steps], every: Sequence[Found], settings: Settings
) -> list[Cleaned]:
    """Tracks cleaned by a filter of the catalogue, one batch for each kind of targets."""
    from torchfra.cleaning.catalogue_filters import BANKS, estimated, make, outlier_of

    results: dict[int, Cleaned] = {}
    for bank in sorted({found.bank for found in every}):
        chosen = [i for i, found in enumerate(every) if found.bank == bank]
        part, d = [tracks[i] for i in chosen], tracks[0].raw.shape[1]
        sigma, q, period = (
            torch.tensor(x, dtype=torch.float64)
            for x in ([every[i].sigma for i in chosen], [every[i].q for i in chosen], [period_of(x) for x in part])
        )
        own = settings.bank if not isinstance(settings.bank, str) else None
        f = make(settings.filter, d, sigma, q, period, own or BANKS[bank](q, d, continuous=True))
        smooths, notes = _smooths(f, settings.smooth)
        estimate = estimated(f, part, sigma, settings._replace(smooth=smooths))
        columns = (estimate.nis, outlier_of(estimate), torch.full_like(estimate.nis, math.nan))
        for b, i in enumerate(chosen):
            k = len(tracks[i].time)
            mean, covariance = estimate.mean[b, :k, : 2 * d], estimate.covariance[b, :k, : 2 * d, : 2 * d]
            nis, outlier, manoeuvre = (x[b, :k].numpy() for x in columns)
            found = replace(every[i], smooth=smooths, notes=every[i].notes + notes)
            results[i] = _result(
                recordings[i], tracks[i], mean.numpy(), covariance.numpy(), nis, outlier, manoeuvre, found
            )
    return [results[i] for i in range(len(tracks))]


def _smooths(f: Filter, wanted: bool) -> tuple[bool, tuple[str, ...]]:
    """Whether a filter is smoothed, and a note if it cannot be."""
    try:
        f.limits.check_smooths()
    except NotImplementedError as error:
        return False, (f"not smoothed: {error}",) if wanted else ()
    return wanted, ()


def _alone(recording: Recording, measured: Recording, settings: Settings) -> Cleaned:
    """Cleans one recording; the result of one that cannot be cleaned is NaN, with the reason."""
    try:
        return _clean_batch([recording], [measured], settings)[0]
    except FAILURES as error:
        time, raw = recording.time - recording.time[0], recording.position
        k, d = raw.shape
        nothing, mean, covariance = (np.full((k, *[2 * d] * rank), np.nan) for rank in (0, 1, 2))
        found = Found(settings.filter, settings.smooth, "", math.nan, math.nan, math.nan, failure=str(error))
        return Cleaned(
            recording, time, np.arange(k), raw, mean, covariance, nothing, nothing, nothing, np.full(k, ""), found,
        )  # fmt: skip

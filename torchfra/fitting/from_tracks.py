"""``torchfra.fit``: the values of a filter from tracks."""

from __future__ import annotations

import time
from collections.abc import Collection
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor

from torchfra import losses
from torchfra.filters import Filter
from torchfra.fitting.data import Batch, Source, batch_of
from torchfra.fitting.descent import Descent
from torchfra.fitting.errors import certainty
from torchfra.fitting.fitted import Fitted, FitTracks
from torchfra.fitting.judging import Judged, judged
from torchfra.fitting.minibatches import Minibatches, Settings, starting_points
from torchfra.fitting.newton import Sums, minimised
from torchfra.fitting.objective import LossFunction, Objective, compiled, objective_of
from torchfra.fitting.vector import Vector, copied
from torchfra.running import checkpoints, distributed
from torchfra.running.progress import progress_bar

FEWEST = 4
"""Tracks of which some can be held out."""
WORSE = 4.0
"""Increase of the validation loss by the last steps, in its standard errors, beyond which they are undone.  The values
before them were chosen by that loss, and so are often better by 2 standard errors even if the last steps are right."""


def fit(
    filter: Filter, data: Source, *, learn: Collection[str] | None = None, loss: str | LossFunction | None = None,
    scale: float | None = None, skip: int = 0, runs: int = 400, iterations: int | None = None, batch: int = 64,
    lr: float = 0.1, clip: float = 10.0, validate_every: int = 10, patience: int = 5, held_out: float = 0.3,
    restarts: int = 1, spread: float = 1.0, polish: bool = True, errors: str | None = None,
    compile: bool | None = None, checkpoint: str | Path | None = None, resume: bool = False, seed: int = 0,
    quiet: bool = False,
) -> Fitted:  # fmt: skip
    """Learns values of a filter from tracks, with standard errors; all runs on the filter's device.

    The tracks are split at random: most are for learning, half of the others for validation, the rest for a test.  Adam
    follows the mean gradient of minibatches, each track's bounded; from the values of the best validation Newton's
    method continues over all tracks for learning, and its Hessian gives the standard errors.  One to three tracks, such
    as a single time series, are not split: they are all there is to learn from, to stop by and to judge.

    Args:
        filter: any preset; it stays as it is.
        data: a ``Scenario``; a function of a seed, or of a seed and a number of runs; measurements ``z (N, T, m)``,
            or ``(T, m)`` of one track; a dictionary of tensors ``z, std, dt, u, prior, truth`` (or a scenario's
            ``Tracks``); a sequence of these, one for each track or batch, such as a ``DataLoader``, which is read once
            to its end; or recordings of ``torchfra.readers``, whose fixes are the measurements.  Without a ``prior``
            that of a track is its first whole measurement with the current noise: this needs a sensor that ``locates``,
            and no ``std``.
        learn: names of hyperparameters; None for those that are learnable already (``presets.gpb(..., learn=...)``).
        loss: ``"likelihood"`` of the measurements, ``"smoothed"``: the density of each given those before and after it;
            with a truth also ``"robust"``, ``"mse"`` (of the position) and ``"nll"``, see ``torchfra.losses``; or a
            function of an estimate and a batch that gives a number for each track.  None: the robust error if there is
            a truth, else the likelihood.
        scale: position error, m, above which the robust loss flattens; None for the filter's median error at the start,
            on the tracks for learning.
        skip: steps at the start of each track that do not count.
        runs: tracks of a scenario or a function.
        iterations: of Adam, at most; None for 200, or none where no track is held out: with nothing to stop it by,
            Newton's method alone takes a tenth of the time.
        batch: tracks of an iteration, over all processes of ``torchrun``.
        lr: rate of Adam in unconstrained values; it falls to a tenth.
        clip: largest norm of one track's gradient, in medians of those of its minibatch that are not 0.
        validate_every: iterations between validations.
        patience: validations without improvement after which it stops.
        held_out: share of the tracks that are not learned from; 0 for none, as of fewer than four tracks.
        restarts: starts, all descended from at once; the first is the filter's values.
        spread: standard deviation of the other starts, in unconstrained values: 1 is a factor of e.
        polish: whether Newton's method follows; without it standard errors are those of values near the best.
        errors: ``"hessian"`` (the default for likelihoods) or ``"sandwich"`` (for all others).
        compile: whether the filter runs as compiled kernels; None where it can, and a note says where it cannot.
        checkpoint: where the descent is kept, to ``resume`` from after an interruption.
        resume: whether to go on from there, with bit-equal results.
        seed: of the split, minibatches, starts and resamples, and of what is simulated.
        quiet: whether to show no progress bar (there is none where standard error is no terminal).

    Raises:
        ValueError: arguments that do not fit each other or are out of range; a checkpoint of another fit.
        CompileError, NotImplementedError: ``compile=True`` and the filter cannot be compiled.
    """
    begun = time.perf_counter()
    f = copied(filter, learn)
    vector = Vector(f)
    settings = Settings(
        "", Settings.iterations if iterations is None else iterations, batch, lr, clip, validate_every, patience,
        held_out, restarts, spread, polish, "hessian" if errors is None else errors, skip=skip, runs=runs, seed=seed,
    )  # fmt: skip
    path = _file(checkpoint, resume)
    tracks = batch_of(f, data, runs=runs, seed=seed)
    objective = objective_of(f, vector, data, tracks, loss, scale, skip)
    notes, runs_compiled = compiled(objective, tracks, compile)
    start = vector.raw()
    used, lost = _finite(objective, tracks, start)
    notes += [f"{lost} tracks have no finite loss at the start and are left out"] if lost else []
    parts = _split(used, settings)  # of which the first alone is learned from, widths of priors and scales too
    train, valid, test = (part.begun_as(parts[0]) for part in parts)
    counts = {name: len(part.z) for name, part in zip(("train", "validation", "test"), parts, strict=True)}
    if parts[2] is used:
        counts |= {"validation": 0, "test": 0}
        notes.append("no track is held out: before and after are of those that are learned from")
        settings = replace(settings, iterations=iterations or 0)
    if scale is None:
        objective.choose_scale(train)
    settings = settings.of(objective, errors)

    learner = Minibatches(objective, train, valid, starting_points(start, vector.directions, settings), settings)
    first = float(objective.losses(start[None, None], valid.to(torch.float64)).median())
    same = {"learn": vector.names, "start": start.tolist(), "data": used.sums(), "loss at the start": first}
    descent = Descent(learner, learner.values, learner.validation(), asdict(settings) | same)
    if path is not None and resume:
        descent.resume(path, "fit")
    for row in descent.run(progress_bar(descent.remaining, "fit", not quiet)):
        if path is not None and "validation" in row and distributed.rank() == 0:
            descent.save(path)
    best = descent.best["raw"][int(descent.scores.argmin())]
    sums, raw, more = _polished(Sums(objective, train.to(torch.float64), vector.directions), best, valid, settings)
    known = certainty(vector, raw, sums.curvature(raw[None]), settings.errors)
    vector.store(raw)
    f.requires_grad_(False)
    held = _judged(own := FitTracks(objective, sums, test), start, raw, settings.seed)
    lines = [*notes, *descent.notes, *more, *known.notes]
    lines += [row.note(name, len(test.z)) for name, row in held.items() if row.lost]
    return Fitted(
        f, vector.named(start), vector.named(raw), known, held, descent.rows,
        descent.scores.tolist(), settings, runs_compiled, str(tracks.z.dtype).removeprefix("torch."),
        counts | {"left out": lost},
        time.perf_counter() - begun, lines, own, raw,
    )  # fmt: skip


def _finite(objective: Objective, tracks: Batch, raw: Tensor) -> tuple[Batch, int]:
    """The tracks whose loss is finite at the start, and how many are not.

    Raises:
        ValueError: none is left.
    """
    finite = objective.losses(raw[None, None], tracks)[0].isfinite()
    if not bool(finite.any()):
        raise ValueError(f"data: expected a track whose loss is finite at the start, received none of {len(finite)}")
    return tracks.rows(finite), int((~finite).sum())


def _split(tracks: Batch, settings: Settings) -> tuple[Batch, Batch, Batch]:
    """Tracks for learning, for validation and for the test: all of them for each where none is held out."""
    if not settings.held_out or len(tracks.z) < FEWEST:
        return tracks, tracks, tracks
    order = torch.randperm(len(tracks.z), generator=torch.Generator().manual_seed(settings.seed))
    out = min(max(2, round(settings.held_out * len(order))), len(order) - 2)
    test, valid, train = order.split([out // 2, out - out // 2, len(order) - out])
    return tracks.rows(train), tracks.rows(valid), tracks.rows(test)


def _file(checkpoint: str | Path | None, resume: bool) -> Path | None:
    """The file of the checkpoint.

    Raises:
        ValueError: no file, or none to resume from; or it is there and ``resume`` is not asked for.
    """
    if not isinstance(checkpoint, str | Path | None) or (checkpoint is None and resume):
        raise ValueError(f"checkpoint: expected the name of a file, received {checkpoint!r}")
    path = None if checkpoint is None else Path(checkpoint)
    if path is not None and not resume and checkpoints.found(path):
        raise ValueError(f"checkpoint: {path} holds a fit already: resume=True continues it")
    return path


def _polished(sums: Sums, best: Tensor, valid: Batch, settings: Settings) -> tuple[Sums, Tensor, list[str]]:
    """Tracks whose losses are not chaotic, the values where the sum of their losses is least, and notes on both."""
    raw, count = best, len(sums.batch.z)
    for again in (False, True):
        regular = sums.not_chaotic(raw[None])
        if again and bool(regular.all()):
            break  # the least sum of the same tracks is known
        sums = Sums(sums.objective, sums.batch.rows(regular), sums.directions)
        raw = minimised(sums, best[None])[0][0] if settings.polish else best
    chaotic = count - len(sums.batch.z)
    notes = (
        [f"{chaotic} tracks whose loss is chaotic do not count in the last steps and standard errors"]
        if chaotic
        else []
    )
    one, other = (sums.objective.losses(x[None, None], valid)[0] for x in (best, raw))
    change = other - one
    error = change.std(correction=0) / len(change) ** 0.5
    if not bool(change.isfinite().all()) or (len(change) > 2 and bool(change.mean() > WORSE * error)):
        return sums, best, [*notes, "the last steps made validation worse: values are those of the best validation"]
    return sums, raw, notes


def _judged(own: FitTracks, start: Tensor, raw: Tensor, seed: int) -> dict[str, Judged]:
    """Before and after on held-out tracks: the loss, and the position error where there is a truth."""
    objective, test = own.objective, own.test
    before, after = (objective.losses(x[None, None], test)[0] for x in (start, raw))
    name = objective.loss if isinstance(objective.loss, str) else "loss"
    table = {name: own.judge(before, after, seed)}
    if test.truth is not None:
        errors = [
            losses.mse(objective.estimate(x[None, None], test).mean[0], test.truth, objective.states).cpu()
            for x in (start, raw)
        ]
        one, other = (x.flatten(1).mean(1) if x.dim() > 1 else x for x in errors)
        table["position RMSE"] = judged(one, other, root=True, seed=seed)
    return table

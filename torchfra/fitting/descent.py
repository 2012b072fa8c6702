"""Descent: iterations of whatever learns, with validation, early stopping and checkpoints.

``torchfra.fit`` and ``train.tune`` both learn by it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from torchfra import state_files
from torchfra.running import checkpoints, distributed

KINDS: dict[str, type] = {"settings": dict, "iteration": int, "values": dict, "optimiser": dict, "best": dict,
                          "scores": Tensor, "improved": int, "rows": list}  # fmt: skip
"""Fields of a checkpoint, and their types."""


class Optimiser(Protocol):
    """Holds numbers between iterations, as an optimiser of torch does."""

    def state_dict(self) -> dict[str, Any]:
        """The numbers."""
        ...

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Takes over saved numbers."""
        ...


class Learner(Protocol):
    """What a descent iterates: it changes values, of one start or of R starts side by side."""

    @property
    def optimiser(self) -> Optimiser:
        """The optimiser of the values."""
        ...

    def step(self, iteration: int) -> dict[str, float]:
        """Changes the values once; columns of the learning curve, of which ``"loss"`` and ``"left out"`` are shown.

        All that is random follows from the number of the iteration, from 0, so that a resumed descent sees the same.
        """
        ...

    def validation(self) -> Tensor:
        """Losses ``()`` or ``(R,)``, on the CPU, of the values on tracks that are not learned from."""
        ...

    def natural(self, start: int) -> dict[str, float]:
        """The values of one of the starts in natural units, columns of the learning curve."""
        ...


class Descent:
    """Iterations until the last, or until validation has not improved for long.

    Args:
        learner: what learns.
        values: the module whose state the learner changes; of R starts each tensor is ``(R, ...)``.
        scores: losses ``()`` or ``(R,)`` at the start, on the CPU, which validation has to improve on.
        settings: all that identifies the descent; ``iterations``, ``validate_every`` (iterations between validations)
            and ``patience`` (validations without improvement after which it stops) among them.
    """

    def __init__(self, learner: Learner, values: nn.Module, scores: Tensor, settings: Mapping[str, Any]) -> None:
        self.learner, self.values, self.settings = learner, values, dict(settings)
        self.iterations, self.validate_every, self.patience = (
            int(settings[name]) for name in ("iterations", "validate_every", "patience")
        )
        self.still = torch.zeros(scores.numel(), dtype=torch.int64)
        """For how many iterations in a row all gradients of a start have been exactly 0."""
        self.iteration, self.improved = 0, 0
        """Iterations that are done, and how many were when a validation last improved."""
        self.best, self.scores = self._state(), scores
        """The state of ``values`` at each start's best validation, and its loss; both on the CPU."""
        self.rows: list[dict[str, float]] = []
        """Rows of the learning curve, one for each iteration."""

    @property
    def done(self) -> bool:
        """Whether the last iteration is done, or validation has not improved for long."""
        unimproved = (self.iteration - self.improved) / self.validate_every
        return self.iteration >= self.iterations or unimproved >= self.patience

    @property
    def remaining(self) -> range:
        """The iterations that are left."""
        return range(self.iteration, self.iterations)

    def run(self, bar: Iterable[int]) -> Iterator[dict[str, float]]:
        """Iterates until it is done; the row of each iteration.

        Args:
            bar: ``remaining``, behind a progress bar or not.
        """
        for _ in bar:
            if self.done:
                return
            row = self.advance()
            if hasattr(bar, "set_postfix"):
                bar.set_postfix(loss=f"{row['loss']:.4f}", left_out=row["left out"])
            yield row

    def advance(self) -> dict[str, float]:
        """One iteration; its row of the learning curve."""
        columns = self.learner.step(self.iteration)
        self.iteration += 1
        groups = getattr(self.learner.optimiser, "param_groups", ())  # a search has none
        gradients = [x.grad for group in groups for x in group["params"] if x.grad is not None]
        if gradients:
            zero = torch.cat([(x == 0).reshape(len(self.still), -1) for x in gradients], 1).all(1).cpu()
            self.still = torch.where(zero, self.still + 1, 0)
        row = {"iteration": self.iteration, **columns}
        if self.iteration % self.validate_every == 0 or self.iteration == self.iterations:
            scores = self.learner.validation()
            row["validation"] = float(scores.min())
            if self.keep(scores):
                self.improved = self.iteration
        row |= self.learner.natural(int(self.scores.argmin()))
        self.rows.append(row)
        return row

    @property
    def notes(self) -> list[str]:
        """A sentence if starts rest where their loss is flat, which no loss and no failure tells."""
        resting = int((self.still >= self.validate_every).sum())
        if not resting:
            return []
        count = f"{resting} of {len(self.still)} starts"
        return [f"{count} rest where all gradients are exactly 0, as values do that a step was too long for: lower lr"]

    def keep(self, scores: Tensor) -> bool:
        """Keeps the values of the starts for which these losses are the least so far; whether there are any."""
        better = scores < self.scores
        self.scores = torch.where(better, scores, self.scores)
        for name, x in self._state().items():
            which = better.reshape(better.shape + (1,) * (x.dim() - better.dim()))
            self.best[name] = torch.where(which, x, self.best[name])
        return bool(better.any())

    def _state(self) -> dict[str, Tensor]:
        return {name: x.detach().to("cpu", copy=True) for name, x in self.values.state_dict().items()}

    def save(self, path: Path) -> None:
        """Writes a checkpoint; the one before stays: see ``checkpoints.save``."""
        state = {"settings": self.settings, "iteration": self.iteration, "values": self._state(),
                 "optimiser": self.learner.optimiser.state_dict(), "best": self.best, "scores": self.scores,
                 "improved": self.improved, "rows": self.rows}  # fmt: skip
        checkpoints.save(state, path)

    def resume(self, path: Path, program: str) -> bool:
        """Continues from the newest checkpoint that can be read; whether there was one: see ``checkpoints.load``."""
        return checkpoints.load(path, self._take, program)

    def _take(self, path: Path) -> None:
        """Continues from a checkpoint.

        Raises:
            OtherSettingsError: it has other settings.
            ValueError: it is damaged, or something else.
        """
        state = state_files.read(path)
        if not isinstance(state, dict) or not all(isinstance(state.get(name), kind) for name, kind in KINDS.items()):
            raise ValueError(f"expected {', '.join(KINDS)}, received something else")
        settings, rows = state["settings"], state["rows"]
        other = [key for key, value in self.settings.items() if key not in settings or not _same(settings[key], value)]
        if other:
            raise checkpoints.OtherSettingsError(
                f"resume: expected the settings of {path}, these differ: {', '.join(other)}"
            )
        if len(rows) != state["iteration"] or not all(isinstance(row, dict) for row in rows):
            raise ValueError(f"rows: expected one for each of {state['iteration']} iterations, received something else")
        if state["scores"].shape != self.scores.shape:
            raise ValueError(f"scores: expected {tuple(self.scores.shape)}, received {tuple(state['scores'].shape)}")
        for values in (state["best"], state["values"]):
            state_files.load_values(self.values, values)
        try:
            self.learner.optimiser.load_state_dict(state["optimiser"])
        except Exception as error:  # torch raises errors of many types
            raise ValueError(f"expected the state of the optimiser, received something else ({error})") from None
        self.iteration, self.improved, self.rows = state["iteration"], state["improved"], rows
        self.best, self.scores = state["best"], state["scores"]


def _same(a: object, b: object) -> bool:
    """Whether two settings are the same but for rounding, which differs between processors."""
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-12) or (math.isnan(a) and math.isnan(b))
    return bool(a == b)


def bounded(losses: Tensor, gradients: Tensor, clip: float | Tensor) -> tuple[Tensor, Tensor]:
    """Gradients of single tracks with bounded norms, so that no track dominates a step of descent.

    Args:
        losses: ``(..., N)`` loss of each track.
        gradients: ``(..., N, P)`` gradient of each track.
        clip: largest norm of a gradient, a number or ``(..., 1 or N)``.

    Returns:
        The gradients ``(..., N, P)``, 0 for a track whose loss or gradient is NaN or infinite, and ``(..., N)`` bool,
        which tracks are finite.
    """
    finite = losses.isfinite() & gradients.isfinite().all(-1)
    norm = torch.linalg.vector_norm(gradients, dim=-1)
    shorter = torch.where(norm > clip, clip / norm, 1.0).unsqueeze(-1)
    return torch.where(finite.unsqueeze(-1), gradients * shorter, 0.0), finite


def summands(losses: Tensor, gradients: Tensor, clip: float | Tensor) -> Tensor:
    """Of each track ``(..., N, P + 2)``: its bounded gradient, its loss, and a 1; all 0 where one is not finite."""
    clipped, finite = bounded(losses, gradients, clip)
    return torch.cat([clipped, torch.stack([torch.where(finite, losses, 0.0), finite.to(losses)], -1)], -1)


def means(sums: Tensor) -> tuple[Tensor, Tensor, int]:
    """Mean losses ``(G,)``, mean gradients ``(G, P)`` and the number of tracks in them, over all processes.

    Args:
        sums: ``(G, P + 2)`` of the ``summands`` of this process's tracks, in G groups.
    """
    sums = distributed.summed(sums)
    mean = sums[:, :-1] / sums[:, -1:].clamp_min(1)
    return mean[:, -1], mean[:, :-1], int(sums[:, -1].sum())


def follow(optimiser: torch.optim.Optimizer, gradient: Tensor, rate: float) -> None:
    """One step of an optimiser, at this learning rate, along the gradient of all its parameters, one after another."""
    (group,) = optimiser.param_groups
    parts = gradient.flatten().split([parameter.numel() for parameter in group["params"]])
    for parameter, part in zip(group["params"], parts, strict=True):
        parameter.grad = part.reshape(parameter.shape).to(parameter, copy=True)
    group["lr"] = rate
    optimiser.step()


def falling(rate: float, progress: float) -> float:
    """A learning rate that falls to a tenth along half a cosine; ``progress`` is the share of iterations done."""
    return rate * (0.55 + 0.45 * math.cos(math.pi * progress))

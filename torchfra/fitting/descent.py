"""Gradient descent on minibatches from several starts at once, with early stopping and checkpoints."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from torchfra.fitting.data import Batch
from torchfra.fitting.errors import KINDS as KINDS_OF_ERRORS
from torchfra.fitting.newton import median_of_nonzero
from torchfra.fitting.objective import Objective
from torchfra.hyper import one_of
from torchfra.numbers import is_integer
from torchfra.running import distributed

KINDS: dict[str, type] = {"key": str, "iteration": int, "raw": torch.Tensor, "optimiser": dict, "best": torch.Tensor,
                          "scores": torch.Tensor, "since": int, "rows": list}  # fmt: skip
"""Fields of a checkpoint, and their types."""


@dataclass(frozen=True)
class Settings:
    """Settings of a fit: see ``torchfra.fit``.

    Raises:
        ValueError: a setting is out of its range.
    """

    loss: str
    iterations: int = 200
    batch: int = 64
    lr: float = 0.1
    clip: float = 10.0
    validate_every: int = 10
    patience: int = 5
    held_out: float = 0.3
    restarts: int = 1
    spread: float = 1.0
    polish: bool = True
    errors: str = "hessian"
    scale: float = math.nan
    skip: int = 0
    runs: int = 400
    seed: int = 0

    def __post_init__(self) -> None:
        positive = dict.fromkeys(("batch", "validate_every", "patience", "restarts", "runs"), 1)
        for name, least in {**positive, **dict.fromkeys(("iterations", "skip", "seed"), 0)}.items():
            value = getattr(self, name)
            if not is_integer(value, least):
                raise ValueError(f"{name}: expected a whole number of at least {least}, received {value!r}")
            object.__setattr__(self, name, int(value))  # torch's generators take no integers of numpy
        for name in ("lr", "clip", "spread"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not 0 < value < math.inf:
                raise ValueError(f"{name}: expected a number above 0, received {value!r}")
        one_of(errors=(self.errors, KINDS_OF_ERRORS))
        if not isinstance(self.held_out, float) or not 0 < self.held_out < 1:
            raise ValueError(f"held_out: expected a share between 0 and 1, received {self.held_out!r}")

    def of(self, objective: Objective, errors: str | None) -> Settings:
        """The settings with the chosen loss, and the kind of standard errors, by default the one for that loss."""
        kind = errors or ("hessian" if objective.name == "likelihood" else "sandwich")
        return replace(self, loss=objective.name, scale=objective.scale, errors=kind)


class Descent:
    """Gradient descents from R starts, side by side.

    Args:
        objective: the loss.
        train: tracks to learn from.
        valid: tracks for validation, by which the descent stops.
        starts: ``(R, P)`` unconstrained values.
        settings: of the fit.
    """

    def __init__(self, objective: Objective, train: Batch, valid: Batch, starts: Tensor, settings: Settings) -> None:
        self.objective, self.train, self.valid, self.settings = objective, train, valid, settings
        self.raw = nn.Parameter(starts.clone())
        self.optimiser: Any = torch.optim.Adam([self.raw], lr=settings.lr)
        self.iteration, self.since = 0, 0
        """``since``: validations in which no start has improved."""
        self.best, self.scores = starts.clone(), self.validation(starts)
        """``(R, P)`` the values of each start's best validation, and ``(R,)`` its loss."""
        self.rows: list[dict[str, float]] = []
        """Rows of the learning curve."""

    @property
    def done(self) -> bool:
        """Whether the last iteration is done, or validation has not improved for long."""
        return self.iteration >= self.settings.iterations or self.since >= self.settings.patience

    def validation(self, raw: Tensor) -> Tensor:
        """``(R,)`` mean losses per track on the validation tracks, infinite where one is NaN."""
        return self.objective.losses(raw.unsqueeze(1), self.valid).mean(1).nan_to_num(nan=math.inf)

    def advance(self) -> dict[str, float]:
        """One iteration; its row of the learning curve."""
        loss, gradient, left_out = self._gradient()
        self.raw.grad = gradient
        self.optimiser.param_groups[0]["lr"] = falling(self.settings.lr, self.iteration / self.settings.iterations)
        self.optimiser.step()
        self.iteration += 1
        row = {"iteration": self.iteration, "loss": float(loss.min()), "left out": left_out}
        if self.iteration % self.settings.validate_every == 0 or self.iteration == self.settings.iterations:
            raw = self.raw.detach()
            scores = self.validation(raw)
            better = scores < self.scores
            self.scores = torch.where(better, scores, self.scores)
            self.best = torch.where(better.unsqueeze(-1), raw, self.best)
            self.since = 0 if bool(better.any()) else self.since + 1
            row["validation"] = float(self.scores.min())
        leader = self.raw.detach()[int(self.scores.argmin())]
        natural = self.objective.vector.natural(leader).tolist()
        row |= zip(self.objective.vector.names, natural, strict=True)
        self.rows.append(row)
        return row

    def _gradient(self) -> tuple[Tensor, Tensor, int]:
        """Mean losses ``(R,)`` and mean bounded gradients ``(R, P)`` of a minibatch, over all processes."""
        chosen = self._minibatch()
        share = distributed.share(len(chosen))
        part = self.train.rows(chosen[share.start : share.stop])
        losses, gradients = self.objective.gradients(self.raw.detach().unsqueeze(1), part)
        norms = torch.cat(distributed.gathered(torch.linalg.vector_norm(gradients, dim=-1)), 1)
        usual = median_of_nonzero(norms, 1).unsqueeze(1)
        clipped, finite = bounded(losses, gradients, self.settings.clip * usual)
        table = torch.cat(
            [clipped, torch.where(finite, losses, 0.0).unsqueeze(-1), finite.to(losses).unsqueeze(-1)], -1
        )
        sums = distributed.summed(table.sum(1))
        means = sums[:, :-1] / sums[:, -1:].clamp_min(1)
        return means[:, -1], means[:, :-1], int(len(self.raw) * len(chosen) - sums[:, -1].sum())

    def _minibatch(self) -> Tensor:
        """Numbers of the next tracks; they follow from seed and iteration, so that a resumed fit sees the same ones."""
        count, size = len(self.train.z), min(self.settings.batch, len(self.train.z))
        epoch, place = divmod(self.iteration, max(1, count // size))
        generator = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + epoch)
        return torch.randperm(count, generator=generator)[place * size : (place + 1) * size]

    def state(self, key: str) -> dict[str, Any]:
        """Contents of a checkpoint; ``key`` identifies its tracks and settings."""
        return {"key": key, "iteration": self.iteration, "raw": self.raw.detach(), "best": self.best,
                "optimiser": self.optimiser.state_dict(), "scores": self.scores, "since": self.since,
                "rows": copy.deepcopy(self.rows)}  # fmt: skip

    def resume(self, state: Mapping[str, Any]) -> None:
        """Continues from ``state``.

        Raises:
            ValueError: it does not fit.
        """
        if not all(isinstance(state.get(name), kind) for name, kind in KINDS.items()):
            raise ValueError(f"expected {', '.join(KINDS)}, received something else")
        if state["raw"].shape != self.raw.shape:
            raise ValueError(f"expected {tuple(self.raw.shape)} values, received {tuple(state['raw'].shape)}")
        with torch.no_grad():
            self.raw.copy_(state["raw"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.iteration, self.since, self.rows = state["iteration"], state["since"], list(state["rows"])
        self.best, self.scores = state["best"], state["scores"]


def starting_points(raw: Tensor, directions: Tensor, settings: Settings) -> Tensor:
    """``(R, P)``: the values as they are, and others around them, normal in unconstrained values."""
    generator = torch.Generator().manual_seed(settings.seed)
    noise = torch.randn(settings.restarts, directions.shape[1], generator=generator, dtype=torch.float64)
    noise[0] = 0.0
    return raw + settings.spread * noise @ directions.mT


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


def falling(rate: float, progress: float) -> float:
    """A learning rate that falls to a tenth along half a cosine; ``progress`` is the share of iterations done."""
    return rate * (0.55 + 0.45 * math.cos(math.pi * progress))

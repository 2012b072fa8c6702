"""What ``torchfra.fit`` learns with: minibatches of the tracks, from several starts at once; and its settings."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from torchfra.fitting.data import Batch
from torchfra.fitting.descent import falling, follow, means, summands
from torchfra.fitting.errors import KINDS as KINDS_OF_ERRORS
from torchfra.fitting.newton import median_of_nonzero
from torchfra.fitting.objective import Objective
from torchfra.hyper import one_of
from torchfra.numbers import as_number, is_integer, positive
from torchfra.running import distributed


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
        counts = dict.fromkeys(("batch", "validate_every", "patience", "restarts", "runs"), 1)
        for name, least in {**counts, **dict.fromkeys(("iterations", "skip", "seed"), 0)}.items():
            value = getattr(self, name)
            if not is_integer(value, least):
                raise ValueError(f"{name}: expected a whole number of at least {least}, received {value!r}")
            object.__setattr__(self, name, int(value))  # torch's generators take no integers of numpy
        for name in ("lr", "clip", "spread"):
            positive(name, getattr(self, name))
        one_of(errors=(self.errors, KINDS_OF_ERRORS))
        if isinstance(self.held_out, bool) or not 0 <= as_number(self.held_out) < 1:
            raise ValueError(f"held_out: expected a share from 0 to below 1, received {self.held_out!r}")

    def of(self, objective: Objective, errors: str | None) -> Settings:
        """The settings with the chosen loss, and the kind of standard errors, by default the one for that loss."""
        kind = errors or ("hessian" if objective.name == "likelihood" else "sandwich")
        return replace(self, loss=objective.name, scale=objective.scale, errors=kind)


class Minibatches:
    """Values of R starts, which follow the mean gradients of minibatches: a ``Learner``.

    Args:
        objective: the loss.
        train: tracks to learn from.
        valid: tracks for validation.
        starts: ``(R, P)`` unconstrained values.
        settings: of the fit.
    """

    def __init__(self, objective: Objective, train: Batch, valid: Batch, starts: Tensor, settings: Settings) -> None:
        self.objective, self.train, self.valid, self.settings = objective, train, valid, settings
        self.values = nn.ParameterDict({"raw": starts.clone()})
        self.optimiser = torch.optim.Adam(self.values.parameters(), lr=settings.lr)

    @property
    def raw(self) -> Tensor:
        """``(R, P)`` the unconstrained values."""
        raw: Tensor = self.values["raw"].detach()
        return raw

    def step(self, iteration: int) -> dict[str, float]:
        """Changes the values once, over all processes."""
        chosen = self._minibatch(iteration)
        share = distributed.share(len(chosen))
        part = self.train.rows(chosen[share.start : share.stop])
        losses, gradients = self.objective.gradients(self.raw.unsqueeze(1), part)
        norms = torch.cat(distributed.gathered(torch.linalg.vector_norm(gradients, dim=-1)), 1)
        typical = median_of_nonzero(norms, 1).unsqueeze(1)
        loss, gradient, count = means(summands(losses, gradients, self.settings.clip * typical).sum(1))
        follow(self.optimiser, gradient, falling(self.settings.lr, iteration / self.settings.iterations))
        return {"loss": float(loss.min()), "left out": len(self.raw) * len(chosen) - count}

    def validation(self) -> Tensor:
        """``(R,)`` mean losses per track on the validation tracks, infinite where one is NaN."""
        return self.objective.losses(self.raw.unsqueeze(1), self.valid).mean(1).nan_to_num(nan=math.inf)

    def natural(self, start: int) -> dict[str, float]:
        """The values of a start, in natural units."""
        return self.objective.vector.named(self.raw[start])

    def _minibatch(self, iteration: int) -> Tensor:
        """Numbers of the next tracks: each once in an epoch, in an order that follows from the seed and the epoch."""
        count, size = len(self.train.z), min(self.settings.batch, len(self.train.z))
        epoch, place = divmod(iteration, max(1, count // size))
        generator = torch.Generator().manual_seed(self.settings.seed * 1_000_003 + epoch)
        return torch.randperm(count, generator=generator)[place * size : (place + 1) * size]


def starting_points(raw: Tensor, directions: Tensor, settings: Settings) -> Tensor:
    """``(R, P)``: the values as they are, and others around them, normal in unconstrained values."""
    generator = torch.Generator().manual_seed(settings.seed)
    noise = torch.randn(settings.restarts, directions.shape[1], generator=generator, dtype=torch.float64)
    noise[0] = 0.0
    return raw + settings.spread * noise @ directions.mT

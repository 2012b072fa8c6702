"""The values that a filter learns as one vector: unconstrained for the optimiser, in natural units for people."""

from __future__ import annotations

import copy
import math
from collections.abc import Collection, Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.distributions import transform_to

from torchfra.filters import Filter
from torchfra.hyper import Hyper, element_names, hypers, named

F = TypeVar("F", bound=Filter)
NORMAL_95 = 1.959963984540054
"""Standard deviations of a normal distribution on either side that hold 95 % of it."""


class Vector:
    """Reads and writes the learned hyperparameters of a filter; all are unconstrained, ``raw (..., P)``, unless named.

    The vector is float64 on the CPU wherever the filter is: it is short, and its numbers are read one by one.

    Args:
        f: the filter; its parameters are hyperparameters that have one value each, not a batch of values.

    Raises:
        ValueError: the filter has no parameters, or others than hyperparameters.
    """

    def __init__(self, f: nn.Module) -> None:
        known = {path: hyper for path, hyper in hypers(f).items() if hyper.raw.requires_grad}
        others = {name for name, _ in f.named_parameters()} - {f"{path}.raw" for path in known}
        if others:
            expected = "a filter whose parameters are hyperparameters (others learn in a loop of your own)"
            raise ValueError(f"filter: expected {expected}, received {', '.join(sorted(others))}")
        if not known:
            names = ", ".join(dict.fromkeys(path.rpartition(".")[2] for path in hypers(f)))
            expected = f"names of hyperparameters ({names}), or a preset with learn=..."
            raise ValueError(f"learn: expected {expected}, received none")
        for path, hyper in known.items():
            if hyper.batch_rank:
                expected = "one value each (restarts= and sweep try several)"
                raise ValueError(f"filter: expected {expected}, received {path} {tuple(hyper.raw.shape)}")
        self.hypers: dict[str, Hyper] = known
        self.names = [name for path, hyper in known.items() for name in element_names(path, hyper)]
        """The name of each number, ``"motion.q[1]"``."""
        self.directions = torch.block_diag(*(_directions(hyper) for hyper in known.values()))
        """``(P, Q)`` orthonormal directions in which values change: probabilities do not if all logits grow alike."""

    def raw(self) -> Tensor:
        """``(P,)`` the values of the filter at the moment."""
        return torch.cat([hyper.raw.detach().flatten().to("cpu", torch.float64) for hyper in self.hypers.values()])

    def store(self, raw: Tensor) -> None:
        """Writes ``(P,)`` into the filter."""
        with torch.no_grad():
            for hyper, part in zip(self.hypers.values(), self._split(raw), strict=True):
                hyper.raw.copy_(part.reshape(hyper.raw.shape))

    def parameters(self, raw: Tensor) -> dict[str, Tensor]:
        """Parameters by name for ``torch.func.functional_call``, from ``raw (..., P)``."""
        return {
            f"{path}.raw": part.reshape((*raw.shape[:-1], *hyper.raw.shape))
            for (path, hyper), part in zip(self.hypers.items(), self._split(raw), strict=True)
        }

    def natural(self, raw: Tensor) -> Tensor:
        """``(..., P)`` in natural units."""
        parts = [
            transform_to(hyper.constraint)(part.reshape((*raw.shape[:-1], *hyper.raw.shape))).reshape(
                (*raw.shape[:-1], -1)
            )
            for hyper, part in zip(self.hypers.values(), self._split(raw), strict=True)
        ]
        return torch.cat(parts, -1)

    def named(self, raw: Tensor) -> dict[str, float]:
        """``raw (P,)`` in natural units, by name."""
        return dict(zip(self.names, self.natural(raw).tolist(), strict=True))

    def unconstrained(self, name: str, values: Sequence[float]) -> Tensor:
        """One number's natural values as unconstrained ones ``(K,)``.

        Raises:
            ValueError: an unknown name, a probability of several that sum to one, or a value out of its range.
        """
        path = name.partition("[")[0]
        if name not in self.names or self.hypers[path].sums_to_one:
            free = [n for n in self.names if not self.hypers[n.partition("[")[0]].sums_to_one]
            raise ValueError(f"name: expected one of {free}, received {name!r}")
        raw: Tensor = Hyper(torch.tensor(values, dtype=torch.float64), self.hypers[path].constraint, name=name).raw
        return raw

    def errors(self, raw: Tensor, covariance: Tensor) -> Tensor:
        """``(P,)`` standard errors in natural units, from those of ``raw (P,)``, by the delta method."""
        slope = torch.func.jacrev(self.natural)(raw)
        errors: Tensor = (slope @ covariance @ slope.mT).diagonal().clamp_min(0).sqrt()
        return errors

    def intervals(self, raw: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
        """``(P,)`` each: 95 % intervals in natural units, those of the unconstrained values transformed."""
        reach = NORMAL_95 * covariance.diagonal().clamp_min(0).sqrt()
        ends = self.natural(raw - reach), self.natural(raw + reach)
        shares = self.natural(raw)  # probabilities that sum to one have an interval of their log odds
        wide = NORMAL_95 * self.errors(raw, covariance) / (shares * (1 - shares)).clamp_min(1e-300)
        logit = torch.logit(shares)
        odds = torch.sigmoid(logit - wide), torch.sigmoid(logit + wide)
        summing = torch.cat([
            torch.full((hyper.raw.numel(),), hyper.sums_to_one) for hyper in self.hypers.values()
        ])  # fmt: skip
        low, high = (torch.where(summing, a, b) for a, b in zip(odds, ends, strict=True))
        return low, high

    def _split(self, raw: Tensor) -> Sequence[Tensor]:
        parts: Sequence[Tensor] = raw.split([hyper.raw.numel() for hyper in self.hypers.values()], -1)
        return parts


def copied(f: F, learn: Collection[str] | None) -> F:
    """A copy whose values of these names learn, and no others.

    Raises:
        ValueError: not a filter, or unknown names.
    """
    if not isinstance(f, Filter):
        raise ValueError(f"filter: expected a filter, received {type(f).__name__}")
    if not isinstance(learn, Collection | None):
        raise ValueError(f"learn: expected names of hyperparameters, received {learn!r}")
    f = copy.deepcopy(f)
    if learn is not None:
        for parameter in f.parameters():
            parameter.requires_grad_(False)
        for path, hyper in named(f, learn).items():
            hyper.learn(path)
            hyper.raw.requires_grad_()
    return f


def _directions(hyper: Hyper) -> Tensor:
    """Directions ``(k, q)`` in which the unconstrained numbers of a hyperparameter change its value."""
    count = hyper.raw.numel()
    if not hyper.sums_to_one:
        return torch.eye(count, dtype=torch.float64)
    size = hyper.raw.shape[-1]
    contrasts = torch.zeros(size, size - 1, dtype=torch.float64)  # Helmert's
    for j in range(1, size):
        contrasts[:j, j - 1], contrasts[j, j - 1] = 1.0, -float(j)
        contrasts[:, j - 1] /= math.sqrt(j * (j + 1))
    rows: Tensor = torch.block_diag(*[contrasts] * (count // size))
    return rows

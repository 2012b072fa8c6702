"""Visibility of targets that are occluded at times, as a Markov chain for each target and sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.linalg.safe import safe_divide
from torchfra.numbers import as_number, positive
from torchfra.targets.checks import by_sensor


class Visibility:
    """A Markov chain with two states: visible to a sensor, and hidden; a hidden target is never measured.

    The probability that a target is visible, given that it exists, is predicted to each scan and updated by it.  The
    ``detection`` of the sensor is that of visible targets.  Successive misses thus indicate that a target is hidden
    rather than that it has ceased to exist.

    Args:
        seen: mean sojourn time of the visible state, s; infinite if a target stays visible.
        hidden: mean sojourn time of the hidden state, s.

    Raises:
        ValueError: seconds that are not above 0, or a hidden time that is not finite.

    Source: Brekke, Hem & Tokle (2021), "Multitarget Tracking With Multiple Models and Visibility: Derivation and
    Verification on Maritime Radar Data".  Differs: the chain is one of continuous time, and each sensor has its own.
    """

    def __init__(self, seen: float, hidden: float) -> None:
        if not as_number(seen) > 0:
            raise ValueError(f"seen: expected seconds above 0, received {seen}")
        self.seen, self.hidden = float(seen), positive("hidden", hidden, "finite seconds")

    @property
    def share(self) -> float:
        """Stationary probability of the visible state."""
        return 1 / (1 + self.hidden / self.seen)

    def predicted(self, visible: Tensor, dt: Tensor) -> Tensor:
        """Probabilities ``(N,)`` of the visible state, predicted by ``dt (N,)`` seconds."""
        rate = 1 / self.seen + 1 / self.hidden
        return self.share + (visible - self.share) * torch.exp(-rate * dt)

    def __repr__(self) -> str:
        return f"Visibility(seen={self.seen:g}, hidden={self.hidden:g})"


class Chains(NamedTuple):
    """The chains of every sensor, the filter's own first."""

    sensors: tuple[Visibility, ...]

    def predicted(self, visible: Tensor, dt: Tensor) -> Tensor:
        """Probabilities ``(N, S)`` for each sensor, predicted by ``dt (N,)`` seconds."""
        return torch.stack([of.predicted(x, dt) for of, x in zip(self.sensors, visible.unbind(-1), strict=True)], -1)

    def first(self, like: Tensor, sensor: int) -> Tensor:
        """Initial probabilities ``(K, S)`` of targets, as many as ``like (K,)``, that this sensor has just measured."""
        shares = [1.0 if i == sensor else of.share for i, of in enumerate(self.sensors)]
        return like.new_tensor(shares).expand(len(like), -1)

    def updated(self, visible: Tensor, sensor: int, log_missed: Tensor, log_miss: Tensor) -> Tensor:
        """Probabilities ``(N, S)`` updated by a scan of one sensor: a measured target is visible.

        Args:
            visible: ``(N, S)`` probabilities before the scan.
            sensor: number of the sensor.
            log_missed: ``(N,)`` log probability that each was missed, given the scan.
            log_miss: log probability that a visible target is missed: a number or ``(N,)``.
        """
        before = visible[:, sensor]
        hidden = safe_divide(1 - before, 1 + before * torch.expm1(log_miss))  # of one that was missed
        now = 1 - log_missed.exp() * hidden
        return torch.cat([visible[:, :sensor], now.unsqueeze(-1), visible[:, sensor + 1 :]], -1)


def check_visibility(visibility: Mapping[str | None, Visibility] | None, names: Sequence[str]) -> Chains | None:
    """The chains of the filter's own sensor, None, and of those with ``names``; others are always visible.

    Raises:
        ValueError: one of no sensor, or what is no visibility.
    """
    chains, always = by_sensor("visibility", visibility, names, Visibility), Visibility(math.inf, 1.0)
    return Chains(tuple(chains.get(name, always) for name in (None, *names))) if chains else None

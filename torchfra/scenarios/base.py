"""What a scenario is, and noise that does not depend on how many runs are asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfra.association.clutter import Clutter
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.motion.spherical import Spherical
from torchfra.sensors.base import Sensor
from torchfra.types import Estimate, Gaussian

BLOCK = 256
"""Runs that are always simulated together, so that a run never depends on how many others are asked for."""


class Tracks(NamedTuple):
    """A batch of tracks: what was, what was measured, and what a filter may know."""

    truth: Tensor
    """``(B, T, n)`` states, of several targets ``(B, N, T, n)``; NaN where unknown."""
    z: Tensor
    """``(B, T, m)`` measurements, or scans ``(B, T, J, m)`` in which they are in any order; NaN is missing."""
    u: Tensor | None
    """``(T, k)`` or ``(B, T, k)`` what the models need to know at each step."""
    prior: Gaussian
    """``mean (B, n)`` and ``scale_tril (n, n)`` or ``(B, n, n)``: each run's belief one step before the first;
    of several targets ``(B, N, n)`` and ``(B, N, n, n)``."""


@dataclass(frozen=True)
class Scenario:
    """An experiment.

    Args:
        name: what it is called.
        motion: the model that filters use; the truth may well do something else.
        sensor: what measures.
        prior: the belief all runs start from, or the centre of what they start from (each run's own: ``Tracks.prior``).
        dt: seconds per step.
        steps: measurements per run.
        block: simulates the ``BLOCK`` runs of these numbers, ``(BLOCK,)``, from a generator.
        settings: what to write beside results.
        bank: motions for interacting models, which may know more of the targets than ``motion`` does.
        others: components of the state besides position and velocity whose error is of interest, by name.
        clutter: how dense false measurements are, of scans of several targets.
        detection: probability that a target is measured, of scans.
        shown: makes the truth's coordinates of an estimate in the motion's, if those are others.
    """

    name: str
    motion: Motion
    sensor: Sensor
    prior: Gaussian
    dt: float
    steps: int
    block: Callable[[np.random.Generator, Tensor], Tracks]
    settings: dict[str, object]
    bank: Bank | None = None
    others: Mapping[str, slice] = field(default_factory=dict)
    clutter: Clutter | None = None
    detection: float = 1.0
    cartesian: Callable[[Estimate], Estimate] = lambda estimate: estimate

    @property
    def position(self) -> slice:
        """The state's position components."""
        return self.motion.position

    @property
    def truth_position(self) -> slice:
        """The truth's position components, of estimates that ``cartesian`` has converted too."""
        return slice(0, 3) if isinstance(self.motion, Spherical) else self.position

    @property
    def quantities(self) -> dict[str, slice]:
        """Components of the state whose errors are of interest, by name."""
        return {"position": self.position, "velocity": self.velocity, **self.others}

    @property
    def velocity(self) -> slice:
        """The state's velocity components."""
        return self.motion.velocity

    def simulate(self, runs: int, seed: int = 0, *, first: int = 0, dtype: torch.dtype = torch.float64) -> Tracks:
        """Simulated runs ``first`` to ``first + runs``.

        Args:
            runs: how many.
            seed: of the random numbers.
            first: of the first run; run i of a seed is the same to the bit in every call.
            dtype: of the result.

        Raises:
            ValueError: ``runs`` below 1, ``seed`` or ``first`` below 0.
        """
        if runs < 1 or seed < 0 or first < 0:
            raise ValueError(f"runs, seed, first: expected at least 1, 0, 0, received {runs}, {seed}, {first}")
        numbers = range(first // BLOCK, -(-(first + runs) // BLOCK))
        blocks = [
            self.block(np.random.default_rng([seed, n]), torch.arange(n * BLOCK, (n + 1) * BLOCK)) for n in numbers
        ]
        cut = slice(first - numbers[0] * BLOCK, first - numbers[0] * BLOCK + runs)

        def joined(parts: list[Tensor]) -> Tensor:
            return torch.cat(parts)[cut].to(dtype)

        roots = [b.prior.scale_tril for b in blocks]
        root = roots[0].to(dtype) if roots[0].dim() == 2 else joined(roots)
        prior = Gaussian(joined([b.prior.mean for b in blocks]), root)
        u = blocks[0].u
        if u is not None:
            u = u.to(dtype) if u.dim() == 2 else joined([b.u for b in blocks if b.u is not None])
        return Tracks(joined([b.truth for b in blocks]), joined([b.z for b in blocks]), u, prior)


def contaminated(outliers: str, size: float | None, share: float) -> Callable[[np.random.Generator, Any], Tensor]:
    """Draws by how much the standard deviation of each measurement grows: 1 for most.

    Args:
        outliers: what grows: ``"covariance"`` or ``"std"``, or ``"none"``.
        size: how many times it grows; None for an integer from 1 to 20, drawn each time.
        share: of the measurements that it happens to.

    Raises:
        ValueError: an argument that is none of those.
    """
    if outliers not in ("covariance", "std", "none"):
        raise ValueError(f"outliers: expected 'covariance', 'std' or 'none', received {outliers!r}")
    if not (size is None or 1 <= size < float("inf")) or not 0 <= share <= 1:
        raise ValueError(f"size, share: expected 1 or more and a share in [0, 1], received {size}, {share}")

    def grown(rng: np.random.Generator, shape: Any) -> Tensor:
        wild, drawn = torch.from_numpy(rng.random(shape)) < share, torch.from_numpy(rng.integers(1, 21, shape))
        times = drawn.double() if size is None else torch.full(tuple(shape), float(size), dtype=torch.float64)
        times = {"covariance": times.sqrt(), "std": times, "none": torch.ones_like(times)}[outliers]
        return torch.where(wild, times, 1.0)

    return grown

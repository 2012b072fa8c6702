"""Scenarios, and random numbers of a run that do not depend on the number of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfra.association.clutter import Clutter
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.numbers import is_integer
from torchfra.scenarios.law import Law
from torchfra.sensors.base import Sensor
from torchfra.types import Estimate, Gaussian

BLOCK = 256
"""Runs that are always simulated together, so that a run does not depend on the number of runs."""


class Tracks(NamedTuple):
    """A batch of tracks: the truth, the measurements, the inputs and the prior."""

    truth: Tensor
    """``(B, T, n)`` states, of several targets ``(B, N, T, n)``; NaN where unknown."""
    z: Tensor
    """``(B, T, m)`` measurements, or scans ``(B, T, J, m)`` in which they are in any order; NaN is missing."""
    u: Tensor | None
    """``(T, k)`` or ``(B, T, k)`` inputs of the models at each step."""
    prior: Gaussian
    """``mean (B, n)`` and ``scale_tril (n, n)`` or ``(B, n, n)``: the belief of each run one step before the first;
    of several targets ``(B, N, n)`` and ``(B, N, n, n)``."""


@dataclass(frozen=True)
class Scenario:
    """An experiment: the models that filters use, and the tracks to use them on.

    Errors of estimates, whatever coordinates the filters' state has::

        estimate = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
        metrics.rmse(scenario.cartesian(estimate).mean, tracks.truth, scenario.truth_position)

    Where filters estimate in the truth's coordinates, ``cartesian`` changes nothing and ``position`` is the same as
    ``truth_position``.  Where they do not (``clutter_*``, ``noise_change``: modified spherical coordinates),
    ``position`` is a ValueError, as there are no components that estimates and truth have in common.

    Args:
        name: of the experiment.
        motion: the model that filters use; the targets may move otherwise.
        sensor: what is measured.
        prior: the prior of all runs, or the centre of their priors (each run's own: ``Tracks.prior``).
        dt: seconds per step; a tensor ``(T,)`` where steps differ.
        steps: measurements per run.
        block: simulates the runs of these numbers, ``(BLOCK,)`` or one for each recording, from a generator.
        settings: metadata of results.
        bank: motions for interacting models, which may describe the targets better than ``motion``.
        extra_quantities: components of the truth besides position and velocity whose errors are of interest, by name.
        clutter: how dense false measurements are, of scans of several targets.
        detection: probability that a target is measured, of scans.
        conversion: from estimates in the motion's coordinates to ``[position, velocity]`` in Cartesian ones, which are
            the truth's; None if the motion's coordinates are the truth's.
        limit: position error, root mean square over time, above which a run has diverged, m; None for one that follows
            the scale of the scenario (``torchfra.evaluation.divergence_limit``).
        recordings: names of the runs where measurements are recorded; after the last comes the first again.
        law: the true models of targets and measurements, where these are known, for ``scenarios.bound``.
    """

    name: str
    motion: Motion
    sensor: Sensor
    prior: Gaussian
    dt: float | Tensor
    steps: int
    block: Callable[[np.random.Generator, Tensor], Tracks] = field(repr=False)
    settings: Mapping[str, object]
    bank: Bank | None = None
    extra_quantities: Mapping[str, slice] = field(default_factory=dict)
    clutter: Clutter | None = None
    detection: float = 1.0
    conversion: Callable[[Estimate], Estimate] | None = None
    limit: float | None = None
    recordings: tuple[str, ...] = ()
    law: Law | None = field(default=None, repr=False)

    def cartesian(self, estimate: Estimate) -> Estimate:
        """The estimate in the truth's coordinates; unchanged where filters estimate in these anyway."""
        return estimate if self.conversion is None else self.conversion(estimate)

    @property
    def mean_dt(self) -> float:
        """Seconds of a step, on average."""
        return float(self.dt.mean()) if isinstance(self.dt, Tensor) else self.dt

    @property
    def time(self) -> Tensor:
        """Seconds ``(T,)`` from the prior to each measurement."""
        return torch.as_tensor(self.dt, dtype=torch.float64).expand(self.steps).cumsum(0)

    @property
    def truth_position(self) -> slice:
        """Position components of the truth, and of estimates converted by ``cartesian``."""
        return self.motion.position if self.conversion is None else slice(0, self.motion.dims)

    @property
    def truth_velocity(self) -> slice:
        """Velocity components of the truth, and of estimates converted by ``cartesian``."""
        return self.motion.velocity if self.conversion is None else slice(self.motion.dims, 2 * self.motion.dims)

    @property
    def position(self) -> slice:
        """Position components of estimates and truth alike.

        Raises:
            ValueError: estimates have other coordinates than the truth.
        """
        self._check_same_coordinates("position")
        return self.motion.position

    @property
    def velocity(self) -> slice:
        """Velocity components of estimates and truth alike.

        Raises:
            ValueError: estimates have other coordinates than the truth.
        """
        self._check_same_coordinates("velocity")
        return self.motion.velocity

    @property
    def quantities(self) -> dict[str, slice]:
        """Components of the truth, and of converted estimates, whose errors are of interest, by name."""
        return {"position": self.truth_position, "velocity": self.truth_velocity, **self.extra_quantities}

    def _check_same_coordinates(self, name: str) -> None:
        if self.conversion is not None:
            raise ValueError(
                f"{name}: estimates of {self.name} have other coordinates than the truth; compare "
                f"scenario.cartesian(estimate).mean with tracks.truth in the components scenario.truth_{name}"
            )

    def simulate(self, runs: int, seed: int = 0, *, first: int = 0, dtype: torch.dtype = torch.float64) -> Tracks:
        """Simulates the runs from ``first`` up to, not including, ``first + runs``.

        Args:
            runs: number of runs.
            seed: of the random numbers.
            first: number of the first run; run i of a seed is the same to the bit in every call.
            dtype: of the result.

        Raises:
            ValueError: ``runs`` below 1, ``seed`` or ``first`` below 0.
        """
        received = (runs, seed, first)
        if not all(is_integer(x, least) for x, least in zip(received, (1, 0, 0), strict=True)):
            values = ", ".join(map(repr, received))
            raise ValueError(f"runs, seed, first: expected whole numbers, runs of at least 1, received {values}")
        size = len(self.recordings) or BLOCK
        numbers = range(first // size, -(-(first + runs) // size))
        blocks = [self.block(np.random.default_rng([seed, n]), torch.arange(n * size, (n + 1) * size)) for n in numbers]
        cut = slice(first - numbers[0] * size, first - numbers[0] * size + runs)

        def joined(parts: list[Tensor]) -> Tensor:
            return torch.cat(parts)[cut].to(dtype)

        roots = [b.prior.scale_tril for b in blocks]
        root = roots[0].to(dtype) if roots[0].dim() == 2 else joined(roots)
        prior = Gaussian(joined([b.prior.mean for b in blocks]), root)
        u = blocks[0].u
        if u is not None:
            u = u.to(dtype) if u.dim() == 2 else joined([b.u for b in blocks if b.u is not None])
        return Tracks(joined([b.truth for b in blocks]), joined([b.z for b in blocks]), u, prior)


def of_tracks(tracks: Tracks, motion: Motion, sensor: Sensor, *, dt: float = 1.0, name: str = "tracks") -> Scenario:
    """A scenario whose runs are the given tracks, one after the other.

    Args:
        tracks: a batch, ``z (B, T, m)``; an unknown truth is NaN.
        motion: the motion of filters.
        sensor: the sensor that has measured.
        dt: seconds per step.
        name: name of the scenario.

    Raises:
        ValueError: measurements that are no batch of tracks, a truth of another number of tracks or steps, no prior.
    """
    z, truth = tracks.z, tracks.truth
    if not isinstance(truth, Tensor) or not isinstance(tracks.prior, Gaussian) or not len(z):
        received = f"{type(truth).__name__}, {type(tracks.prior).__name__} and {len(z)} tracks"
        raise ValueError(
            f"tracks: expected a truth (NaN where unknown), a prior and one track or more, received {received}"
        )
    if z.dim() != 3 or truth.dim() != 3 or truth.shape[:2] != z.shape[:2]:
        received = f"{tuple(truth.shape)} and {tuple(z.shape)}"
        raise ValueError(f"tracks: expected truth (B, T, n) and z (B, T, m), received {received}")
    count, n = len(z), tracks.prior.mean.shape[-1]
    mean = tracks.prior.mean.expand(count, n)

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        return Tracks(truth, z, tracks.u, Gaussian(mean, tracks.prior.scale_tril))

    names = tuple(f"track {i + 1}" for i in range(count))
    prior = Gaussian(mean[0], tracks.prior.scale_tril.reshape(-1, n, n)[0])
    return Scenario(name, motion, sensor, prior, dt, z.shape[1], block, {"tracks": count}, recordings=names)

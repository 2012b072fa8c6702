"""An infrared sensor and a laser on a vehicle watch aircraft, alone or among false measurements: Chen, Zou & Wu.

Directions have errors of 1 mrad, ranges of some metres; from some step on the measurement noise may be larger than the
filters assume.  Filters work in modified spherical coordinates, the truth is Cartesian: see ``Scenario``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.association.clutter import Clutter
from torchfra.coordinates import belief_from_cartesian, belief_to_cartesian, from_cartesian
from torchfra.hyper import one_of
from torchfra.motion.base import Motion
from torchfra.motion.polynomial import ConstantVelocity
from torchfra.motion.spherical import Spherical
from torchfra.motion.turn import CoordinatedTurn
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.scenarios.law import Law
from torchfra.sensors.infrared import InfraredLaser
from torchfra.types import Estimate, Gaussian

STEPS, DT, Q = 100, 1.0, 0.5**2
STARTS = torch.tensor(
    [[1500.0, 500.0, 1000.0, 30.0, 40.0, 50.0], [500.0, 1500.0, 1000.0, 40.0, 30.0, 50.0]], dtype=torch.float64
)
"""``(2, 6)`` Cartesian states of the aircraft one step before the first scan, m and m/s."""
ROOT = torch.tensor([30.0, 30.0, 30.0, 5.0, 5.0, 5.0], dtype=torch.float64).diag()
"""Root of the covariance of the initial beliefs, m and m/s."""
REGION = 200.0
"""Half the edge of the cube around each target in which its false measurements are uniform, m."""


@dataclass(frozen=True)
class Conditions:
    """Settings of targets and sensor: the arguments of ``clutter_straight``, which explains them.

    Raises:
        ValueError: a value out of its range.
    """

    noise_scale: float
    change: int
    std: tuple[float, ...]
    truth_noise: float
    clutter: int = 0
    detection: float = 1.0

    def __post_init__(self) -> None:
        for name, good, wanted in (
            ("noise_scale", self.noise_scale > 0, "a value above 0"),
            ("change", self.change >= 0, "0 or more steps"),
            ("clutter", self.clutter >= 0, "0 or more measurements"),
            ("detection", 0 < self.detection <= 1, "a probability above 0"),
            ("std", len(self.std) == 3 and min(self.std) > 0, "three values above 0"),
            ("truth_noise", self.truth_noise >= 0, "a variance of 0 or more"),
        ):
            if not good:
                raise ValueError(f"{name}: expected {wanted}, received {getattr(self, name)}")

    def sensor(self) -> InfraredLaser:
        """The sensor as filters assume it."""
        return InfraredLaser(torch.tensor(self.std, dtype=torch.float64))


def clutter_straight(
    *,
    noise_scale: float = 1.0,
    change: int = 20,
    clutter: int = 6,
    detection: float = 0.95,
    std: Sequence[float] = (1e-3, 1e-3, 5.0),
    truth_noise: float = 0.0,
    counts: str = "diffuse",
) -> Scenario:
    """Scenario 1: two aircraft on straight lines that cross at 100 s, in clutter; 100 scans, 1 s apart.

    Args:
        noise_scale: how many times larger than the filters assume the standard deviation of the measurement noise is,
            after the step ``change``.
        change: the last step at which it is what the filters assume.
        clutter: false measurements per scan, shared out among the targets, evenly in a cube around each.
        detection: probability that a target is measured.
        std: of azimuth, elevation (rad) and range (m), as the filters assume.
        truth_noise: variance of the targets' random acceleration, m^2/s^4.
        counts: what filters assume of the number of false measurements: ``"diffuse"``, all numbers equally probable, or
            ``"poisson"`` with ``clutter`` expected.

    Raises:
        ValueError: an argument out of its range.

    Source: Chen, Zou & Wu, scenario 1.  Differs: the initial states are those of their scenario 2; the
    measurement noise and its change, the clutter region and the detection are chosen here, as theirs are lost.
    """
    motion = ConstantVelocity(Q, 3)
    conditions = Conditions(noise_scale, change, tuple(std), truth_noise, clutter, detection)
    return _scans("clutter-straight", motion, DT, conditions, counts, {})


def clutter_crossing(
    *,
    noise_scale: float = 1.0,
    change: int = 20,
    clutter: int = 6,
    detection: float = 0.95,
    std: Sequence[float] = (1e-3, 1e-3, 5.0),
    truth_noise: float = 0.0,
    counts: str = "diffuse",
    rate: float = math.radians(0.5),
    dt: float = DT,
) -> Scenario:
    """Scenario 2: two aircraft that turn towards each other and meet at 44 s, in clutter; 100 scans.

    Args:
        noise_scale: as in ``clutter_straight``.
        change: as in ``clutter_straight``.
        clutter: as in ``clutter_straight``.
        detection: as in ``clutter_straight``.
        std: as in ``clutter_straight``.
        truth_noise: as in ``clutter_straight``.
        counts: as in ``clutter_straight``.
        rate: of the turns, to opposite sides, rad/s.  The paper has 0.5 rad/s: circles of 100 m, which stay a
            kilometre apart; for those choose ``dt`` of 0.1 or less.
        dt: seconds between scans.

    Raises:
        ValueError: an argument out of its range.

    Source: Chen, Zou & Wu, scenario 2.
    """
    if not dt > 0:
        raise ValueError(f"dt: expected seconds above 0, received {dt}")
    motion = CoordinatedTurn(rate * torch.tensor([1.0, -1.0], dtype=torch.float64), Q, 3)
    conditions = Conditions(noise_scale, change, tuple(std), truth_noise, clutter, detection)
    return _scans("clutter-crossing", motion, dt, conditions, counts, {"rate": rate, "dt": dt})


def noise_change(*, noise_scale: float = 5.0, change: int = 40, truth_noise: float = 0.0) -> Scenario:
    """The first of the two aircraft alone, without false measurements; the measurement noise grows at 40 s.

    Args:
        noise_scale: as in ``clutter_straight``.
        change: as in ``clutter_straight``.
        truth_noise: as in ``clutter_straight``.

    Raises:
        ValueError: an argument out of its range.
    """
    conditions, motion = Conditions(noise_scale, change, (1e-3, 1e-3, 10.0), truth_noise), ConstantVelocity(Q, 3)

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        truth, z, prior = targets(rng, motion, DT, STARTS[:1], conditions)
        first = Gaussian(prior.mean[:, 0], prior.scale_tril[:, 0])
        return Tracks(truth[:, 0], z[:, 0], None, first)

    prior = belief_from_cartesian(Gaussian(STARTS[0], ROOT))
    settings = {"noise_scale": noise_scale, "change": change, "truth_noise": truth_noise}
    return Scenario("noise-change", Spherical(motion), conditions.sensor(), prior, DT, STEPS, block, settings,
                    conversion=cartesian, law=_law_of(motion, DT, conditions))  # fmt: skip


# ---------------------------------------------------------------- simulation


def cartesian(estimate: Estimate) -> Estimate:
    """An estimate in modified spherical coordinates as ``[position, velocity]``."""
    return estimate._replace(**belief_to_cartesian(Gaussian(estimate.mean, estimate.scale_tril))._asdict())


def _scans(
    name: str, motion: Motion, dt: float, conditions: Conditions, counts: str, more: dict[str, object]
) -> Scenario:
    """A scenario of both aircraft in scans with missed and false measurements; ``more`` are further settings."""
    one_of(counts=(counts, ("diffuse", "poisson")))
    if counts == "poisson" and conditions.clutter == 0:
        raise ValueError("counts: expected 'diffuse' where there are no false measurements, received 'poisson'")

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        truth, z, prior = targets(rng, motion, dt, STARTS, conditions)
        return Tracks(truth, scanned(rng, truth, z, conditions), None, prior)

    keys = ("noise_scale", "change", "clutter", "detection")
    settings = {"counts": counts} | {key: getattr(conditions, key) for key in keys} | more
    rate = float(conditions.clutter) if counts == "poisson" else None
    clutter = Clutter(volume=len(STARTS) * (2 * REGION) ** 3, rate=rate)
    prior = belief_from_cartesian(Gaussian(STARTS, ROOT))
    return Scenario(name, Spherical(motion), conditions.sensor(), prior, dt, STEPS, block, settings, clutter=clutter,
                    detection=conditions.detection, conversion=cartesian,
                    law=_law_of(motion, dt, conditions, "origins of measurements"))  # fmt: skip


def _law_of(motion: Motion, dt: float, conditions: Conditions, *known: str) -> Law:
    """The law of one aircraft's motion in Cartesian coordinates; ``known`` names further known quantities."""
    sensor, noise = conditions.sensor(), motion.process_noise(torch.tensor(dt, dtype=torch.float64))
    scale = torch.where(_changed(conditions), conditions.noise_scale, 1.0).unsqueeze(-1)
    root = noise * math.sqrt(conditions.truth_noise / Q) if conditions.truth_noise else None
    std = torch.tensor(conditions.std, dtype=torch.float64) * scale
    known = (*(["motion"] if root is None else []), "noise", *known)
    return Law(ROOT, motion, lambda x, u: sensor(from_cartesian(x)), std, root, known=known)


def _changed(conditions: Conditions) -> Tensor:
    """``(STEPS,)`` bool: steps at which the measurement noise has changed."""
    return torch.arange(1, STEPS + 1) > conditions.change


def targets(
    rng: np.random.Generator, motion: Motion, dt: float, starts: Tensor, conditions: Conditions
) -> tuple[Tensor, Tensor, Gaussian]:
    """Truth ``(BLOCK, N, T, 6)``, measurements ``(BLOCK, N, T, 3)`` and priors ``(BLOCK, N)`` of the targets.

    ``starts`` are their states ``(N, 6)``, or ``(BLOCK, N, 6)`` of each run, one step before the first scan.
    """
    count, seconds = starts.shape[-2], torch.tensor(dt, dtype=torch.float64)
    offsets = torch.from_numpy(rng.standard_normal((BLOCK, count, 6))) @ ROOT
    shocks = torch.from_numpy(rng.standard_normal((STEPS, BLOCK, count, 3))) * math.sqrt(conditions.truth_noise / Q)
    draw = torch.from_numpy(rng.standard_normal((BLOCK, count, STEPS, 3)))
    matrix, root = motion.transition(seconds), motion.process_noise(seconds)
    assert matrix is not None
    state, states = starts.expand(BLOCK, count, 6), []
    for shock in shocks:
        state = (matrix @ state.unsqueeze(-1)).squeeze(-1) + (root @ shock.unsqueeze(-1)).squeeze(-1)
        states.append(state)
    truth = torch.stack(states, 2)
    scale = torch.where(_changed(conditions), conditions.noise_scale, 1.0).unsqueeze(-1)
    z = conditions.sensor()(from_cartesian(truth)) + torch.tensor(conditions.std, dtype=torch.float64) * scale * draw
    return truth, z, belief_from_cartesian(Gaussian(starts + offsets, ROOT))


def scanned(rng: np.random.Generator, truth: Tensor, z: Tensor, conditions: Conditions) -> Tensor:
    """Scans ``(BLOCK, T, J, 3)`` in random order: measurements of targets, some missed, and false ones around them."""
    count, clutter = truth.shape[1], conditions.clutter
    missed = torch.from_numpy(rng.random((BLOCK, count, STEPS))) >= conditions.detection
    z = torch.where(missed.unsqueeze(-1), torch.nan, z)
    offsets = REGION * (2 * torch.from_numpy(rng.random((BLOCK, clutter, STEPS, 3))) - 1)
    around = torch.arange(clutter) % count  # the target that each false measurement lies around
    false = pad(truth[:, around, :, :3] + offsets, (0, 3))  # at rest
    every = torch.cat([z, conditions.sensor()(from_cartesian(false))], 1).movedim(1, 2)
    order = torch.from_numpy(rng.random((BLOCK, STEPS, count + clutter))).argsort(-1)
    return every.gather(2, order.unsqueeze(-1).expand_as(every))

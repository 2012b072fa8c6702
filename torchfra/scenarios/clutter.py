"""An infrared sensor and a laser on a vehicle watch aircraft, alone or among false measurements: Chen, Zou & Wu.

Directions good to 1 mrad, ranges to some metres; the noise may be larger than the data sheet says from some step on.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchfra.association.clutter import Clutter
from torchfra.coordinates import belief_from_cartesian, belief_to_cartesian, from_cartesian
from torchfra.hyper import one_of
from torchfra.motion.base import Motion
from torchfra.motion.polynomial import ConstantVelocity
from torchfra.motion.spherical import Spherical
from torchfra.motion.turn import CoordinatedTurn
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.sensors.infrared import InfraredLaser
from torchfra.types import Estimate, Gaussian

STEPS, DT, Q = 100, 1.0, 0.5**2
_STARTS = torch.tensor(
    [[1500.0, 500.0, 1000.0, 30.0, 40.0, 50.0], [500.0, 1500.0, 1000.0, 40.0, 30.0, 50.0]], dtype=torch.float64
)
_ROOT = torch.tensor([30.0, 30.0, 30.0, 5.0, 5.0, 5.0], dtype=torch.float64).diag()


def clutter_straight(
    *,
    noise_scale: float = 1.0,
    change: int = 20,
    clutter: int = 6,
    region: float = 200.0,
    detection: float = 0.95,
    std: Sequence[float] = (1e-3, 1e-3, 5.0),
    truth_noise: float = 0.0,
    counts: str = "diffuse",
) -> Scenario:
    """Scenario 1: two aircraft on straight lines that cross at 100 s, in clutter; 100 scans, 1 s apart.

    Args:
        noise_scale: how many times larger the standard deviation of the noise really is, from ``change`` on.
        change: the last step at which it is what the filters assume.
        clutter: false measurements per scan, shared out among the targets.
        region: half the edge of the cube around each target that they fall in evenly, m.
        detection: probability that a target is measured.
        std: of azimuth, elevation (rad) and range (m), as the filters assume.
        truth_noise: variance of a noise acceleration of the targets, m^2/s^4.
        counts: what filters assume of the number of false measurements: ``"diffuse"``, any is alike, or ``"poisson"``
            with ``clutter`` expected.

    Raises:
        ValueError: an argument out of its range.

    Source: Chen, Zou & Wu, scenario 1.  Differs: the initial states are those of their scenario 2; noise, clutter
    region, detection and what changes are ours, theirs are lost.
    """
    motion = ConstantVelocity(Q, 3)
    given = _Given(noise_scale, change, clutter, region, detection, tuple(std), truth_noise)
    return _scans("clutter-straight", motion, DT, given, counts, {})


def clutter_crossing(
    *,
    noise_scale: float = 1.0,
    change: int = 20,
    clutter: int = 6,
    region: float = 200.0,
    detection: float = 0.95,
    std: Sequence[float] = (1e-3, 1e-3, 5.0),
    truth_noise: float = 0.0,
    counts: str = "diffuse",
    rate: float = math.radians(0.5),
    dt: float = DT,
) -> Scenario:
    """Scenario 2: two aircraft that turn towards each other and meet at 44 s, in clutter; 100 scans.

    Args:
        noise_scale: see ``clutter_straight``, as all up to ``truth_noise``.
        change: see there.
        clutter: see there.
        region: see there.
        detection: see there.
        std: see there.
        truth_noise: see there.
        counts: see there.
        rate: of the turns, to opposite sides, rad/s.  The paper prints 0.5 rad/s: circles of 100 m, which never come
            within a kilometre of each other; with those take ``dt`` of 0.1 or less.
        dt: seconds between scans.

    Raises:
        ValueError: an argument out of its range.

    Source: Chen, Zou & Wu, scenario 2.
    """
    if not dt > 0:
        raise ValueError(f"dt: expected seconds above 0, received {dt}")
    motion = CoordinatedTurn(rate * torch.tensor([1.0, -1.0], dtype=torch.float64), Q, 3)
    given = _Given(noise_scale, change, clutter, region, detection, tuple(std), truth_noise)
    return _scans("clutter-crossing", motion, dt, given, counts, {"rate": rate, "dt": dt})


def noise_change(
    *, noise_scale: float = 5.0, change: int = 40, std: Sequence[float] = (1e-3, 1e-3, 10.0), truth_noise: float = 0.0
) -> Scenario:
    """The first of the two aircraft alone, without false measurements; the noise grows at 40 s.

    Args:
        noise_scale: see ``clutter_straight``, as all others.
        change: see there.
        std: see there.
        truth_noise: see there.

    Raises:
        ValueError: an argument out of its range.
    """
    given = _Given(noise_scale, change, 0, 1.0, 1.0, tuple(std), truth_noise)
    motion, sensor = ConstantVelocity(Q, 3), given.sensor()

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        truth, z, prior = _targets(rng, motion, DT, _STARTS[:1], given)
        first = Gaussian(prior.mean[:, 0], prior.scale_tril[:, 0])
        return Tracks(truth[:, 0], z[:, 0], None, first)

    prior = belief_from_cartesian(Gaussian(_STARTS[0], _ROOT))
    settings: dict[str, object] = {"noise_scale": noise_scale, "change": change, "truth_noise": truth_noise}
    return Scenario("noise-change", Spherical(motion), sensor, prior, DT, STEPS, block, settings, cartesian=_cartesian)


class _Given:
    """What the scenarios have in common, checked."""

    def __init__(
        self, noise_scale: float, change: int, clutter: int, region: float, detection: float, std: tuple[float, ...],
        truth_noise: float,
    ) -> None:  # fmt: skip
        for name, value, good, wanted in (
            ("noise_scale", noise_scale, noise_scale > 0, "a value above 0"),
            ("change", change, change >= 0, "0 or more steps"),
            ("clutter", clutter, clutter >= 0, "0 or more measurements"),
            ("region", region, region > 0, "metres above 0"),
            ("detection", detection, 0 < detection <= 1, "a probability above 0"),
            ("std", std, len(std) == 3 and min(std) > 0, "three values above 0"),
            ("truth_noise", truth_noise, truth_noise >= 0, "a variance of 0 or more"),
        ):
            if not good:
                raise ValueError(f"{name}: expected {wanted}, received {value}")
        self.noise_scale, self.change, self.clutter, self.region = noise_scale, change, clutter, region
        self.detection, self.std, self.truth_noise = detection, std, truth_noise

    def sensor(self) -> InfraredLaser:
        return InfraredLaser(torch.tensor(self.std, dtype=torch.float64))


def _cartesian(estimate: Estimate) -> Estimate:
    """Positions and velocities of an estimate in modified spherical coordinates."""
    return estimate._replace(**belief_to_cartesian(Gaussian(estimate.mean, estimate.scale_tril))._asdict())


def _scans(name: str, motion: Motion, dt: float, given: _Given, counts: str, settings: dict[str, object]) -> Scenario:
    one_of(counts=(counts, ("diffuse", "poisson")))
    if counts == "poisson" and given.clutter == 0:
        raise ValueError("counts: expected 'diffuse' where there are no false measurements, received 'poisson'")
    sensor, targets = given.sensor(), len(_STARTS)

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        truth, z, prior = _targets(rng, motion, dt, _STARTS, given)
        missed = torch.from_numpy(rng.random((BLOCK, targets, STEPS))) >= given.detection
        z = torch.where(missed.unsqueeze(-1), torch.nan, z)
        offset = given.region * (2 * torch.from_numpy(rng.random((BLOCK, given.clutter, STEPS, 3))) - 1)
        whose = torch.arange(given.clutter) % targets
        false = torch.nn.functional.pad(truth[:, whose, :, :3] + offset, (0, 3))  # at rest
        scans = torch.cat([z, sensor(from_cartesian(false))], 1).movedim(1, 2)  # (BLOCK, T, J, m)
        order = torch.from_numpy(rng.random((BLOCK, STEPS, targets + given.clutter))).argsort(-1)
        return Tracks(truth, scans.gather(2, order.unsqueeze(-1).expand_as(scans)), None, prior)

    settings = {
        key: getattr(given, key) for key in ("noise_scale", "change", "clutter", "region", "detection")
    } | settings
    settings = {"counts": counts} | settings
    rate = float(given.clutter) if counts == "poisson" else None
    clutter = Clutter(volume=targets * (2 * given.region) ** 3, rate=rate)
    prior = belief_from_cartesian(Gaussian(_STARTS, _ROOT))
    return Scenario(name, Spherical(motion), sensor, prior, dt, STEPS, block, settings, clutter=clutter,
                    detection=given.detection, cartesian=_cartesian)  # fmt: skip


def _targets(
    rng: np.random.Generator, motion: Motion, dt: float, starts: Tensor, given: _Given
) -> tuple[Tensor, Tensor, Gaussian]:
    """Truth ``(BLOCK, N, T, 6)``, measurements ``(BLOCK, N, T, 3)`` and priors ``(BLOCK, N)`` of the targets."""
    count, seconds = len(starts), torch.tensor(dt, dtype=torch.float64)
    off = torch.from_numpy(rng.standard_normal((BLOCK, count, 6))) @ _ROOT
    shocks = torch.from_numpy(rng.standard_normal((STEPS, BLOCK, count, 3))) * math.sqrt(given.truth_noise / Q)
    noise = torch.from_numpy(rng.standard_normal((BLOCK, count, STEPS, 3)))
    matrix, root = motion.transition(seconds), motion.process_noise(seconds)
    assert matrix is not None
    state, states = starts.expand(BLOCK, count, 6), []
    for shock in shocks:
        state = (matrix @ state.unsqueeze(-1)).squeeze(-1) + (root @ shock.unsqueeze(-1)).squeeze(-1)
        states.append(state)
    truth = torch.stack(states, 2)
    grown = torch.where(torch.arange(1, STEPS + 1) > given.change, given.noise_scale, 1.0).unsqueeze(-1)
    sensor = given.sensor()
    z = sensor(from_cartesian(truth)) + torch.tensor(given.std, dtype=torch.float64) * grown * noise
    return truth, z, belief_from_cartesian(Gaussian(starts + off, _ROOT))

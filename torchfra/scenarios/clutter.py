"""An infrared sensor and a laser on a vehicle watch aircraft, alone or among false measurements: Chen, Zou & Wu.

Directions have errors of 1 mrad, ranges of some metres; from some step on the measurement noise may be larger than the
filters assume.  Filters work in modified spherical coordinates, the truth is Cartesian: see ``Scenario``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchfra.coordinates import belief_from_cartesian
from torchfra.motion.polynomial import ConstantVelocity
from torchfra.motion.spherical import Spherical
from torchfra.motion.turn import CoordinatedTurn
from torchfra.scenarios.base import Scenario, Tracks
from torchfra.scenarios.two_aircraft import DT, ROOT, STARTS, STEPS, Conditions, Q, cartesian, law_of, scans, targets
from torchfra.types import Gaussian


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
        noise_scale: how many times larger than the filters assume the standard deviation of the measurement noise is,
            after the step ``change``.
        change: the last step at which it is what the filters assume.
        clutter: false measurements per scan, shared out among the targets.
        region: half the edge of the cube around each target that they fall in evenly, m.
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
    conditions = Conditions(noise_scale, change, tuple(std), truth_noise, clutter, region, detection)
    return scans("clutter-straight", motion, DT, conditions, counts, {})


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
        noise_scale: as in ``clutter_straight``.
        change: as in ``clutter_straight``.
        clutter: as in ``clutter_straight``.
        region: as in ``clutter_straight``.
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
    conditions = Conditions(noise_scale, change, tuple(std), truth_noise, clutter, region, detection)
    return scans("clutter-crossing", motion, dt, conditions, counts, {"rate": rate, "dt": dt})


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
                    conversion=cartesian, law=law_of(motion, DT, conditions))  # fmt: skip

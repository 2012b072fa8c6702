"""Targets in space that speed up and turn, seen by a Doppler radar, in five kinds, each harder than the one before.

A target flies straight, at a constant speed or speeding up (in half of the parts), and turns between two straight
parts, in its plane or (in three of ten turns) up or down, by any angle of a range at a constant acceleration.

Source: Greenberg, Yannay & Mannor (2023), "Optimization or Architecture: How to Hack Kalman Filtering".  The paper
names what is added from kind to kind; numbers are those of the simulator that its authors have published with it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from learned.okf import Cholesky, Model, Tracks, draws
from torchfra.linalg.triangular import tria
from torchfra.sensors import Position, RangeBearing, RangeRates, Sensor, Stacked
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian

NOISE, EVEN_NOISE = (10.0, math.radians(1.0), math.radians(3.0)), 100.0
"""Standard deviations of a position: of range, m, bearing and elevation, rad; of each axis where noise is even, m."""
DOPPLER = 5.0
"""Standard deviation of the rate of the range, m/s."""
NEAR, BOX = 200.0, (4000.0, 4000.0, 400.0)
"""Standard deviation of the centre of a track that is near, and else the largest distance of its start, m."""
SPEED, CLIMB, EVEN_SPEED = (70.0, 15.0), math.radians(6.0), 80.0
"""Mean and standard deviation of speeds, m/s, standard deviation of the climb, rad; or of each axis, m/s."""
SPEEDING, FASTEST = 0.5, 150.0
"""Share of the straight parts in which a target speeds up, and the speed at which that ends, m/s."""
VERTICAL, STEEPEST, LESS = 0.3, math.radians(30.0), 0.2
"""Share of the turns that are up or down, the climb at which these end, and what part of the acceleration they have."""
ANGLES, VERTICAL_ANGLES = (math.radians(45.0), math.radians(270.0)), 0.1
"""Range of the angle of a turn, rad, and the part of it in vertical turns."""
SHORTEST = 5.0
"""A straight part lasts so long or longer, s."""


class Kind(NamedTuple):
    """What targets do."""

    even: bool = False
    """Velocities and the noise of positions are Gaussian and the same in all directions."""
    near: bool = False
    """The centre of a track is near the radar."""
    acceleration: float = 0.0
    """The largest, m/s^2; those of parts are between half of it and this."""
    turns: tuple[int, int] = (0, 0)
    """The fewest and the most of a track."""
    lasts: tuple[float, float] = (30.0, 8.0)
    """Mean and standard deviation of how long a straight part lasts, log-normal, s."""


KINDS = {
    "toy": Kind(even=True, near=True),
    "close": Kind(near=True),
    "const_v": Kind(),
    "const_a": Kind(acceleration=16.0),
    "free": Kind(acceleration=32.0, turns=(1, 3), lasts=(10.0, 2.0)),
}
"""The five of the paper, by its names: in all directions alike near the radar; with a radar's noise and level flight;
far off; speeding up; turning."""


def simulate(kind: Kind, runs: int, seed: int) -> Tracks:
    """Tracks in steps of a second; ``z (B, T, 4)`` is the measured position, m, and the rate of the range, m/s."""
    uniform, normal = draws(runs, seed)
    place = NEAR * normal(3) if kind.near else torch.tensor(BOX, dtype=torch.float64) * uniform(-1.0, 1.0, 3)
    speed, heading, climb = (SPEED[0] + SPEED[1] * normal()).abs(), uniform(0.0, 2 * math.pi), CLIMB * normal()
    velocity = EVEN_SPEED * normal(3) if kind.even else speed.unsqueeze(-1) * towards(heading, climb)

    fewest, most = kind.turns
    number = torch.arange(2 * most + 1)  # of parts: turns are the odd ones
    turns, last = number % 2 == 1, 2 * uniform(fewest, most + 1).long()
    speeding, vertical = uniform(0.0, 1.0, len(number)) < SPEEDING, uniform(0.0, 1.0, len(number)) < VERTICAL
    mean, std = kind.lasts
    seconds = log_normal(mean, torch.where(speeding | (number == 0), std, mean), normal(len(number)))
    factor = torch.where(turns, torch.where(vertical, LESS, 1.0), torch.where(speeding, 1.0, 0.0))
    acceleration = kind.acceleration * uniform(0.5, 1.0, len(number)) * factor
    angle = uniform(*ANGLES, len(number)) * torch.where(vertical, VERTICAL_ANGLES, 1.0)
    side = torch.where(uniform(0.0, 1.0, len(number)) < 0.5, -1.0, 1.0)

    def of_part(x: Tensor, part: Tensor) -> Tensor:
        return x.expand(runs, -1).gather(1, part.unsqueeze(-1)).squeeze(-1)

    def steps(part: Tensor, speed: Tensor) -> Tensor:
        turning = (of_part(angle, part) * speed / of_part(acceleration, part)).ceil()
        return torch.where(of_part(turns, part), turning, of_part(seconds, part).clamp_min(SHORTEST).ceil() - 1)

    states, part = [torch.cat([place, velocity], -1)], torch.zeros(runs, dtype=torch.long)
    left = steps(part, velocity.norm(dim=-1))
    while bool((part <= last).any()):
        now = part.minimum(last)
        place, velocity = moved(
            place, velocity, *(of_part(x, now) for x in (acceleration, side, turns, turns & vertical))
        )
        states.append(torch.where((part <= last).unsqueeze(-1), torch.cat([place, velocity], -1), torch.nan))
        left = left - 1
        part = torch.where(left == 0, part + 1, part)
        left = torch.where(left == 0, steps(part.minimum(last), velocity.norm(dim=-1)), left)
    path = torch.stack(states, 1)
    if kind.near:
        centre = path[..., :3].nanmean(1, keepdim=True) - path[:, :1, :3]
        path = torch.cat([path[..., :3] - centre, path[..., 3:]], -1)
    return Tracks(path, measured(kind, path, normal(path.shape[1], 4)))


def log_normal(mean: float, std: Tensor, normal: Tensor) -> Tensor:
    """Log-normal numbers of a mean and a standard deviation, from standard normal ones."""
    spread = (1 + (std / mean).square()).log()
    return (math.log(mean) - spread / 2 + spread.sqrt() * normal).exp()


def towards(heading: Tensor, climb: Tensor) -> Tensor:
    """Unit vectors ``(..., 3)``; headings count from x to y, rad."""
    return torch.stack([heading.cos() * climb.cos(), heading.sin() * climb.cos(), climb.sin()], -1)


def moved(
    place: Tensor, velocity: Tensor, acceleration: Tensor, side: Tensor, turns: Tensor, vertical: Tensor
) -> tuple[Tensor, Tensor]:
    """Positions and velocities ``(B, 3)`` a second later, of targets that speed up, turn or turn up or down."""
    speed, level = velocity.norm(dim=-1), velocity[:, :2].norm(dim=-1)
    heading, climb = torch.atan2(velocity[:, 1], velocity[:, 0]), torch.atan2(velocity[:, 2], level)
    faster = torch.where(speed < FASTEST, (speed + acceleration).clamp_max(FASTEST), speed)
    turned = heading + side * acceleration / level
    steeper = torch.where(side * climb < STEEPEST, climb + side * torch.atan2(acceleration, speed), climb)
    after = torch.where(
        turns.unsqueeze(-1),
        speed.unsqueeze(-1) * towards(torch.where(vertical, heading, turned), torch.where(vertical, steeper, climb)),
        faster.unsqueeze(-1) * towards(heading, climb),
    )
    moved = (velocity + after) / 2
    # On an arc the mean velocity is shorter than the chord by x / tan x of half the angle.
    half = acceleration / level / 2
    chord = torch.where(turns & ~vertical, half.tan() / half, 1.0)
    return place + moved * torch.stack([chord, chord, torch.ones_like(chord)], -1), after


def measured(kind: Kind, path: Tensor, normal: Tensor) -> Tensor:
    """Measurements ``(..., 4)`` of states ``(..., 6)``, with standard normal noise of that shape."""
    place, velocity = path.chunk(2, -1)
    rate = (place * velocity).sum(-1) / place.norm(dim=-1) + DOPPLER * normal[..., 3]
    if kind.even:
        found = place + EVEN_NOISE * normal[..., :3]
    else:
        found = located(polar(place) + torch.tensor(NOISE, dtype=path.dtype) * normal[..., :3])
    return torch.cat([found, rate.unsqueeze(-1)], -1)


def polar(place: Tensor) -> Tensor:
    """Positions ``(..., 3)`` as ranges, m, bearings clockwise from +y and elevations, rad."""
    return RangeBearing(1.0, dims=3)(place)


def located(polar: Tensor) -> Tensor:
    """The positions ``(..., 3)`` of these."""
    return RangeBearing(1.0, dims=3).locate(polar)


# ---------------------------------------------------------------- what filters assume


def direction(z: Tensor) -> Tensor:
    """Unit vectors ``(..., 3)`` towards positions, which measurements begin with; where there is none, any."""
    return torch.nn.functional.normalize(z[..., :3].nan_to_num(1.0), dim=-1)


def matrix(place: Tensor) -> Tensor:
    """What is measured of a state: its position, and its velocity in the direction of ``place (..., 3)``."""
    places = torch.eye(3, 6, dtype=place.dtype).expand(*place.shape[:-1], 3, 6)
    return torch.cat([places, torch.nn.functional.pad(direction(place), (3, 0)).unsqueeze(-2)], -2)


def start(z: Tensor) -> Tensor:
    """First states ``(B, 6)``: as measured, without a speed across."""
    return torch.cat([z[:, :3], z[:, 3:] * direction(z)], -1)


MODEL = Model(matrix, start, 1e6)
"""The direction in which the rate is measured is that of the measured position."""


class Doppler(Sensor):
    """What ``matrix`` says of the direction ``u (..., 3)``."""

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """Position and speed along ``u`` of states ``(..., 6)``."""
        assert u is not None
        return torch.cat([x[..., :3], (x[..., 3:6] * u).sum(-1, keepdim=True)], -1)


class AnyDoppler(Doppler):
    """With noise of any covariance ``(4, 4)``."""

    def __init__(self, covariance: Tensor) -> None:
        super().__init__(6, [False] * 4, noise=torch.linalg.cholesky(covariance))
        self.noise = Cholesky(covariance)

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """As it is learned, where a measurement has none of its own."""
        return super().measurement_noise(z, std, self.noise(z) if std is None and root is None else root)


def sensor(kind: Kind) -> Sensor:
    """What the radar does, as its data sheet says."""
    places = (
        Position(EVEN_NOISE, dims=3) if kind.even else RangeBearing(torch.tensor(NOISE, dtype=torch.float64), dims=3)
    )
    return Stacked(places, RangeRates([[0.0, 0.0, 0.0]], DOPPLER))


class Converted(Doppler):
    """With the radar's noise turned to where a target is."""

    def __init__(self) -> None:
        super().__init__(6, [False] * 4, torch.tensor([*NOISE, DOPPLER], dtype=torch.float64))

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """Of range, bearing, elevation and rate, by their first derivatives at the measured position."""
        assert self.std is not None
        std = self.std(z) if std is None else std
        places = torch.nn.functional.pad(turned(z[..., :3].nan_to_num(1.0), std[..., :3]), (0, 1, 0, 1))
        return super().measurement_noise(z, None, places + torch.diag_embed(std * std.new_tensor([0, 0, 0, 1])))


def turned(place: Tensor, std: Tensor) -> Tensor:
    """A root ``(..., 3, 3)`` of the covariance of a position for errors of range, m, bearing and elevation, rad."""
    x, y, z = place.unbind(-1)
    level, none = torch.hypot(x, y), torch.zeros_like(x)
    bearing, elevation = torch.stack([y, -x, none], -1), torch.stack([-z * x / level, -z * y / level, level], -1)
    return torch.stack([direction(place), bearing, elevation], -1) * std.unsqueeze(-2)


def after_first(kind: Kind, tracks: Tracks) -> Tensor:
    """``(B, T, 4)`` what ``sensor`` measures after the first step, which is missing."""
    z = tracks.z if kind.even else torch.cat([polar(tracks.z[..., :3]), tracks.z[..., 3:]], -1)
    return without_first(z)


def without_first(z: Tensor) -> Tensor:
    """``z (B, T, 4)`` with a first step that is missing."""
    return torch.cat([torch.full_like(z[:, :1], torch.nan), z[:, 1:]], 1)


def believed(kind: Kind, tracks: Tracks, learned: Tracks) -> Gaussian:
    """The belief ``(B, 6)`` once the first measurement counts: the position by the data sheet, the velocity by samples.

    Args:
        kind: of targets.
        tracks: that begin.
        learned: tracks with a truth, which say how far the first velocities are off.
    """
    first, n = tracks.z[:, 0], len(tracks.z)
    off = (learned.truth[:, 0] - start(learned.z[:, 0]))[:, 3:]
    velocity = torch.linalg.cholesky(off.mT @ off / len(off)).expand(n, 3, 3)
    if kind.even:
        place = EVEN_NOISE * torch.eye(3, dtype=first.dtype).expand(n, 3, 3)
    else:
        place = tria(turned(first[:, :3], torch.tensor(NOISE, dtype=first.dtype)))
    pad = torch.nn.functional.pad
    return Gaussian(start(first), pad(place, (0, 3, 0, 3)) + pad(velocity, (3, 0, 3, 0)))

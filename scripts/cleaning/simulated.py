"""What moves in legs of steady turn, speed and climb, or rests between its ways; animals, whose velocity wanders."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from torchfra.readers.columns import Array

_FINE = 5
"""Steps of a second in which they are moved."""


class Leg(NamedTuple):
    """What a target does until the next leg."""

    seconds: float
    rate: float = 0.0
    """Deg/s to the left."""
    speed: float | None = None
    """M/s; None for that of the leg before."""
    climb: float = 0.0
    """M/s."""


class Handling(NamedTuple):
    """The response of a target to its legs."""

    lag: float
    """Seconds that turns and climbs take to set in."""
    pull: float
    """Most that the speed changes, m/s^2."""
    gust: float
    """Root of the density of noise in the acceleration, m/s^1.5."""


def ship(rng: np.random.Generator, seconds: int) -> Array:
    """Positions ``(seconds + 1, 2)``, m: 3 to 11 m/s, legs of minutes, turns of 0.2 to 2.5 deg/s that set in slowly."""

    def leg() -> Leg:
        if rng.random() < 0.5:
            return Leg(rng.uniform(60.0, 400.0), speed=rng.uniform(3.0, 11.0) if rng.random() < 0.3 else None)
        return _turn(rng, rng.uniform(0.2, 2.5), rng.uniform(20.0, 180.0))

    return _moved(rng, seconds, rng.uniform(3.0, 11.0), leg, Handling(8.0, 0.05, 0.02))[:, :2]


def drone(rng: np.random.Generator, seconds: int) -> Array:
    """Positions ``(seconds + 1, 3)``, m: 4 to 15 m/s, legs of half a minute, turns of 3 to 20 deg/s, climbs."""

    def leg() -> Leg:
        what = rng.random()
        if what < 0.5:
            return Leg(rng.uniform(15.0, 60.0), speed=rng.uniform(4.0, 15.0) if rng.random() < 0.3 else None)
        if what < 0.65:
            return Leg(rng.uniform(8.0, 20.0), climb=rng.uniform(-3.0, 3.0))
        return _turn(rng, rng.uniform(3.0, 20.0), rng.uniform(40.0, 270.0))

    return _moved(rng, seconds, rng.uniform(4.0, 15.0), leg, Handling(1.0, 1.0, 0.05))


class Manner(NamedTuple):
    """How somebody goes along a street, each from least to most."""

    speed: tuple[float, float]
    """M/s at first."""
    speeds: tuple[float, float]
    """M/s of later legs, some of which change it."""
    straight: float
    """Most seconds of a leg straight on; the least are 10."""
    rate: tuple[float, float]
    """Deg/s of turns."""
    angle: tuple[float, float]
    """Degrees of turns."""
    pull: float
    """Most that the speed changes, m/s^2."""


MANNERS = {
    "walk": Manner((1.0, 1.6), (0.8, 1.8), 60.0, (15.0, 60.0), (30.0, 120.0), 0.5),
    "bike": Manner((3.0, 7.0), (3.0, 8.0), 90.0, (4.0, 25.0), (20.0, 110.0), 0.7),
    "car": Manner((6.0, 16.0), (5.0, 20.0), 60.0, (3.0, 20.0), (10.0, 95.0), 1.8),
}
"""Parameters of those who go along streets, by kind."""


def along_streets(rng: np.random.Generator, seconds: int, manner: Manner) -> Array:
    """Positions ``(seconds + 1, 2)``, m: legs straight on, of which two in five change the speed, and turns."""

    def leg() -> Leg:
        if rng.random() < 0.5:
            speed = rng.uniform(*manner.speeds) if rng.random() < 0.4 else None
            return Leg(rng.uniform(10.0, manner.straight), speed=speed)
        return _turn(rng, rng.uniform(*manner.rate), rng.uniform(*manner.angle))

    return _moved(rng, seconds, rng.uniform(*manner.speed), leg, Handling(1.0, manner.pull, 0.05))[:, :2]


class Outing(NamedTuple):
    """How somebody rests and moves, each from least to most."""

    rest: tuple[float, float]
    """Seconds of a rest."""
    legs: tuple[int, int]
    """Straight legs of an outing."""
    leg: tuple[float, float]
    """Seconds of a leg."""
    speed: tuple[float, float]
    """M/s of a leg."""
    turn: float
    """Most radians from the course of a leg to that of the next."""
    home: float = math.inf
    """Metres from the first place from which on an outing leads back to it."""


OUTINGS = {
    "walk": Outing((60.0, 28_800.0), (3, 25), (20.0, 180.0), (0.8, 1.8), 1.6, 3000.0),
    "car": Outing((300.0, 21_600.0), (5, 40), (15.0, 240.0), (6.0, 28.0), 1.6, 20_000.0),
    "ship": Outing((14_400.0, 108_000.0), (5, 30), (600.0, 10_800.0), (4.0, 11.0), 0.5),
    "aircraft": Outing((2500.0, 28_800.0), (4, 15), (120.0, 2400.0), (120.0, 240.0), 1.0),
    "animal": Outing((720.0, 28_800.0), (5, 60), (60.0, 900.0), (0.05, 0.6), 3.0, 5000.0),
}
"""Parameters of those who rest between outings, by kind."""


def resting(rng: np.random.Generator, steps: int, dt: float, outing: Outing) -> Array:
    """Positions ``(steps + 1, 2)``, m, every ``dt`` s: rests, and outings of straight legs between them."""
    times, places = [0.0], [np.zeros(2)]
    while times[-1] < steps * dt:
        times.append(times[-1] + rng.uniform(*outing.rest))
        places.append(places[-1])
        away = np.linalg.norm(places[-1]) > outing.home
        course = math.atan2(*-places[-1][::-1]) if away else rng.uniform(-math.pi, math.pi)
        for _ in range(rng.integers(*outing.legs)):
            course += rng.uniform(-outing.turn, outing.turn)
            seconds, speed = rng.uniform(*outing.leg), rng.uniform(*outing.speed)
            times.append(times[-1] + seconds)
            places.append(places[-1] + seconds * speed * np.array([math.cos(course), math.sin(course)]))
    return np.stack([np.interp(dt * np.arange(steps + 1), times, along) for along in np.transpose(places)], 1)


def animal(rng: np.random.Generator, steps: int, dt: float) -> Array:
    """Positions ``(steps + 1, 2)``, m, every ``dt`` s: a velocity of 0.3 to 0.7 m/s that is forgotten in 2 to 5 hours.

    Source: Johnson et al. (2008), Ecology 89, 1208: the correlated random walk in continuous time.
    """
    speed, forgotten = rng.uniform(0.3, 0.7) / math.sqrt(2), rng.uniform(2.0, 5.0) * 3600.0
    velocity = speed * lasting(rng, (steps, 2), dt, forgotten)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(velocity * dt, axis=0)])


def lasting(rng: np.random.Generator, shape: tuple[int, int], dt: float, seconds: float) -> Array:
    """A Gauss-Markov process ``(k, d)`` of variance 1 that is forgotten in so many seconds to a share of 1 / e."""
    kept, values = math.exp(-dt / seconds), rng.standard_normal(shape)
    for step in range(1, len(values)):
        values[step] = kept * values[step - 1] + math.sqrt(1 - kept**2) * values[step]
    return values


def _turn(rng: np.random.Generator, rate: float, angle: float) -> Leg:
    """A turn by so many degrees, to either side."""
    return Leg(angle / rate, float(rng.choice([-1, 1])) * rate)


def _moved(rng: np.random.Generator, seconds: int, speed: float, legs: Callable[[], Leg], handling: Handling) -> Array:
    """Positions ``(seconds + 1, 3)`` of a target whose turn rate, speed and climb follow what each leg wants."""
    heading, rate, climb, wanted = rng.uniform(-math.pi, math.pi), 0.0, 0.0, speed
    leg, left, dt = Leg(0.0), 0.0, 1 / _FINE
    lag, pull, gust = handling
    velocity = np.empty((seconds * _FINE, 3))
    for step in range(len(velocity)):
        if left <= 0:
            leg = legs()
            left, wanted = leg.seconds, wanted if leg.speed is None else leg.speed
        left -= dt
        rate += (leg.rate - rate) * dt / lag
        climb += (leg.climb - climb) * dt / lag
        along, across = gust * math.sqrt(dt) * rng.standard_normal(2)
        speed += min(max(wanted - speed, -pull), pull) * dt + along
        heading += math.radians(rate) * dt + across / speed
        velocity[step] = speed * math.cos(heading), speed * math.sin(heading), climb
    return np.concatenate([np.zeros((1, 3)), np.cumsum(velocity * dt, axis=0)])[::_FINE]

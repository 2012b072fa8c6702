"""Ships and drones: legs of steady turn, speed and climb that follow each other, as of a bank of motions."""

from __future__ import annotations

import numpy as np

from torchfra.readers.columns import Array

_FINE = 5
"""Steps of a second in which they are moved."""


def ship(rng: np.random.Generator, seconds: int) -> Array:
    """Positions ``(seconds + 1, 2)``, m: 3 to 11 m/s, legs of minutes, and turns of 0.2 to 2.5 deg/s that set in slowly."""
    speed = rng.uniform(3.0, 11.0)

    def leg() -> tuple[float, float, float, float]:
        if rng.random() < 0.5:
            return rng.uniform(60.0, 400.0), 0.0, rng.uniform(3.0, 11.0) if rng.random() < 0.3 else -1.0, 0.0
        rate, angle = rng.uniform(0.2, 2.5), rng.uniform(20.0, 180.0)
        return angle / rate, rng.choice([-1, 1]) * rate, -1.0, 0.0

    return _moved(rng, seconds, speed, leg, lag=8.0, pull=0.05, gust=0.02)[:, :2]


def drone(rng: np.random.Generator, seconds: int) -> Array:
    """Positions ``(seconds + 1, 3)``, m: 4 to 15 m/s, legs of half a minute, turns of 3 to 20 deg/s, climbs of 3 m/s."""
    speed = rng.uniform(4.0, 15.0)

    def leg() -> tuple[float, float, float, float]:
        what = rng.random()
        if what < 0.5:
            return rng.uniform(15.0, 60.0), 0.0, rng.uniform(4.0, 15.0) if rng.random() < 0.3 else -1.0, 0.0
        if what < 0.65:
            return rng.uniform(8.0, 20.0), 0.0, -1.0, rng.uniform(-3.0, 3.0)
        rate, angle = rng.uniform(3.0, 20.0), rng.uniform(40.0, 270.0)
        return angle / rate, rng.choice([-1, 1]) * rate, -1.0, 0.0

    return _moved(rng, seconds, speed, leg, lag=1.0, pull=1.0, gust=0.05)


def _moved(rng, seconds, speed, leg, *, lag, pull, gust):  # type: ignore[no-untyped-def]
    """Positions ``(seconds + 1, 3)`` of a target whose turn rate, speed and climb follow what each leg wants."""
    heading, rate, climb, wanted_speed = rng.uniform(-180.0, 180.0), 0.0, 0.0, speed
    position, left, dt = np.zeros(3), 0.0, 1 / _FINE
    path = np.empty((seconds + 1, 3))
    wanted_rate = wanted_climb = 0.0
    for step in range(seconds * _FINE + 1):
        if step % _FINE == 0:
            path[step // _FINE] = position
        if left <= 0:
            left, wanted_rate, new, wanted_climb = leg()
            wanted_speed = new if new > 0 else wanted_speed
        rate += (wanted_rate - rate) * dt / lag
        climb += (wanted_climb - climb) * dt / lag
        speed += np.clip(wanted_speed - speed, -pull, pull) * dt + gust * np.sqrt(dt) * rng.standard_normal()
        heading += rate * dt + np.degrees(gust / max(speed, 1.0)) * np.sqrt(dt) * rng.standard_normal()
        angle = np.radians(heading)
        position = position + dt * np.array([speed * np.cos(angle), speed * np.sin(angle), climb])
        left -= dt
    return path

"""Cleaned tracks as tests make them, without any filter."""

import numpy as np

from torchfra.cleaning import Cleaned, Found, Segment
from torchfra.geodesy import to_enu
from torchfra.readers import Recording
from torchfra.readers.recording import Source

TURN = (Segment(10.0, 30.0, "left turn", 2.5),)
DAY = 1_714_730_400.0
"""2024-05-03, 10:00 UTC."""
FOUND = Found(
    "gpb",
    True,
    "aircraft",
    20.0,
    0.5,
    1.03,
    frozenset({"sigma", "q"}),
    ("fixes 20 m off, say the innovations",),
)


def straight(steps=40, d=3, *, name="3c6444 DLH1AB", origin=(48.0, 11.0, 400.0), source=None, rejected=(7,), off=2000.0,
             start=DAY, period=2.0):  # fmt: skip
    """A target that flies north-east at 100 m/s and climbs at 5 m/s, 10 m of noise, and fixes that are ``off``."""
    rng, time = np.random.default_rng(0), period * np.arange(steps)
    velocity = np.array([80.0, 60.0, 5.0])[:d]
    position = time[:, None] * velocity + np.array([0.0, 0.0, 1000.0])[:d]
    raw = position + 10 * rng.standard_normal((steps, d))
    raw[[k for k in rejected if k < steps], :2] += off
    source = source or Source(name="flights.csv", columns={"time": "timestamp"}, unit=0.3048, notes=("feet",))
    recording = Recording(name, start + time, raw, origin, {}, row=3 * np.arange(steps) + 1, source=source)
    return made(recording, time, position, np.broadcast_to(velocity, (steps, d)), rejected)


def made(recording, time, position, velocity, rejected=(), segments=TURN):
    """All that cleaning gives back, around a recording and a path."""
    steps, d = position.shape
    root = np.tril(np.random.default_rng(1).uniform(0.5, 1.0, (2 * d, 2 * d))) + 3 * np.eye(2 * d)
    wrong = np.isin(np.arange(steps), list(rejected))
    return Cleaned(
        recording, time, np.arange(steps), recording.position, np.concatenate([position, velocity], 1),
        np.broadcast_to(root @ root.T, (steps, 2 * d, 2 * d)).copy(), np.where(wrong, 4e4, float(d)),
        np.where(wrong, 0.99, 0.01), np.full(steps, 0.1), np.where(wrong, "outlier", ""), FOUND, tuple(segments),
    )  # fmt: skip


def geodetic(latitude, longitude, altitude, origin, *, name="ship", time=None, source=None):
    """A recording whose fixes and cleaned positions are the given places, at rest."""
    enu = to_enu(latitude, longitude, altitude, origin)
    time = np.arange(len(enu), dtype=float) if time is None else time
    recording = Recording(name, DAY + time, enu, origin, {}, row=np.arange(len(enu)), source=source or Source())
    return made(recording, time, enu, np.ones_like(enu), segments=())

"""Random cells: motion, sensor, time steps, what is wrong with measurements and what is stated wrongly, all drawn."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize, one_hot

from torchfra.hyper import one_of
from torchfra.linalg.triangular import apply
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.motion.odometry import Odometry
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.motion.turn import CoordinatedTurn
from torchfra.numbers import is_integer
from torchfra.scenarios.base import BLOCK, Scenario, Tracks
from torchfra.sensors.base import Sensor
from torchfra.sensors.direction import Bearings, RangeBearing
from torchfra.sensors.position import Position
from torchfra.sensors.ranges import Ranges
from torchfra.types import Gaussian

KINDS = (
    "none", "spikes", "element", "quantised", "heavy", "pairs", "bursts", "proportional", "one-sided", "half",
    "first", "prior", "moved", "reset",
)  # fmt: skip
"""What may be wrong in a cell, in the order in which cells have it."""
MOTIONS = ("velocity", "acceleration", "odometry", "gyroscope", "bank")
SENSORS = ("position", "radar", "bearings", "ranges")
SPACINGS = ("even", "jittered", "mixed")
SHORTEST, LONGEST = 0.01, 60.0
"""Seconds of a time step."""
LIMIT = 100.0
"""Position error, root mean square over time, above which a run has diverged, in standard deviations ``std``."""
_TURN, _STAY = math.radians(3.0), 0.95
"""Radians that a target turns in a typical step; the probability that a motion of the bank goes on in one."""


@dataclass(frozen=True)
class OpenCell:
    """What a random cell has; with the defaults a plain one, in which all is as stated."""

    kind: str = "none"
    """What is wrong: one of ``KINDS``, see ``open_cell``."""
    motion: str = "velocity"
    """``"velocity"`` or ``"acceleration"``, constant but for white noise; ``"odometry"`` with a measured heading, or
    with a ``"gyroscope"``; or a ``"bank"`` of constant velocity and a turn to each side."""
    sensor: str = "position"
    """``"position"``, ``"radar"`` for range and bearing, ``"bearings"`` of two stations, ``"ranges"`` to four."""
    index: float = 0.1
    """The manoeuvring index: process noise of a typical step by the measurement noise, both as standard deviations."""
    dt: float = 1.0
    """Seconds of a typical step."""
    spacing: str = "even"
    """All steps are alike; or ``"jittered"``, from half of ``dt`` to three halves; or ``"mixed"``, from a tenth to ten
    times, within the bounds of 0.01 and 60 s."""
    std: float = 1.0
    """Standard deviation of a measured position, m."""
    share: float = 0.05
    """Of the measurements that are outliers, except where the kind says how many there are."""
    size: float = 10.0
    """Of an outlier or of a jump, in standard deviations: the length of the vector of its elements."""
    freedom: float = 2.0
    """Degrees of freedom of heavy tails, by Student's t."""
    length: int = 4
    """Measurements of a burst."""
    one_sided: bool = False
    """Whether all elements of an outlier are too large, where half of all measurements are outliers."""
    turn: bool = False
    """Whether the target turns for a sixth of the time, which no model knows; not with odometry, which measures it."""
    doubt: float = 1.0
    """Standard deviation of the prior's position, in those of the measurements."""
    stated_q: float = 1.0
    """Factor on the variance of the process noise that is stated."""
    stated_std: float = 1.0
    """Factor on the standard deviation of the measurement noise that is stated."""

    def scenario(self, *, steps: int = 100, follow: int = 5) -> Scenario:
        """The tracks of such a cell: see ``open_cell``."""
        return _scenario(self, steps, follow, ())


def draw_cell(cell: int, *, seed: int = 0, kind: str | None = None) -> OpenCell:
    """What the random cell of this number has.

    Args:
        cell: its number; the same for any number of cells.  Cells have the kinds in turn.
        seed: of the random numbers.
        kind: to have instead, one of ``KINDS``.

    Raises:
        ValueError: an argument out of its range.
    """
    if not (is_integer(cell, 0) and is_integer(seed, 0)):
        raise ValueError(f"cell, seed: expected whole numbers from 0, received {cell!r}, {seed!r}")
    if kind is not None:
        one_of(kind=(kind, KINDS))
    rng = np.random.default_rng([seed, cell, len(KINDS)])

    def between(low: float, high: float) -> float:
        return float(10 ** rng.uniform(low, high))

    def one(*of: Any) -> Any:
        return of[int(rng.integers(len(of)))]

    return OpenCell(
        kind=KINDS[cell % len(KINDS)] if kind is None else kind,
        motion=one("velocity", "velocity", "velocity", "acceleration", "acceleration", "odometry", "gyroscope", "bank"),
        sensor=one("position", "position", "position", "radar", "bearings", "ranges"),
        index=between(-2, 0),
        dt=between(math.log10(SHORTEST), math.log10(LONGEST)),
        spacing=one("even", "even", "jittered", "mixed"),
        std=between(-1, 2),
        share=one(0.005, 0.02, 0.05, 0.1),
        size=between(math.log10(3), 6),
        freedom=one(1.5, 2.0, 3.0),
        length=one(3, 4, 6, 10),
        one_sided=one(False, True),
        turn=one(False, False, True),
        doubt=between(-1, 1),
        stated_q=one(1.0, 1.0, 1.0, 1.0, 1.0, 10.0, 0.1, 0.01),
        stated_std=one(1.0, 1.0, 1.0, 1.0, 0.5, 2.0),
    )


def open_cell(
    cell: int = 0, *, seed: int = 0, kind: str | None = None, steps: int = 100, follow: int = 5
) -> Scenario:  # fmt: skip
    """Tracks of a cell that is drawn at random, to judge filters where nobody has looked.

    What is wrong goes in turn (``KINDS``); what else a cell has is drawn for each by itself (``OpenCell``, the
    ``settings`` of the scenario).

    - ``"none"``: nothing but what is stated wrongly, as in all others.
    - ``"spikes"``: single outliers of one size, of 3 to 1e6 standard deviations, in any direction.
    - ``"element"``: outliers of one element of a measurement only.
    - ``"quantised"``: offsets of whole multiples of one size, as of wrong lanes and cycles.
    - ``"heavy"``: tails of Student's t with 1.5 to 3 degrees of freedom.
    - ``"pairs"``: two outliers in a row, of one offset.
    - ``"bursts"``: 3 to 10 in a row, of one offset if they are fewer than ``follow``, else each of its own.
    - ``"proportional"``: twice the value; of an angle beside a range, the angle is right.
    - ``"one-sided"``: outliers of which all elements are too large.
    - ``"half"``: half of all measurements are outliers.
    - ``"first"``: one outlier among the first three measurements.
    - ``"prior"``: its position is 25 to 2500 standard deviations off.
    - ``"moved"``: the target was carried to another place, with another velocity.
    - ``"reset"``: the receiver was reset: its positions are shifted from then on, and the truth is what it measures.

    Some contradict each other, and no filter can be right in both:

    - A burst of k equal fixes is a jump (``"moved"``, ``"reset"``) until fix k + 1.  ``follow`` says where the line is:
      bursts of one offset are shorter, and estimates are judged from measurement ``follow`` after a jump on.
    - An outlier at the first measurement (``"first"``) is a prior that is off (``"prior"``) until the second one.
      Estimates are judged from the third measurement on where the prior is off.
    - An outlier at the last measurement is the beginning of a turn, or of a noise that is stated 100 times too small.
    - Outliers of up to some six standard deviations, heavy tails and half of all measurements are noise that is stated
      as half of what it is; where they are one-sided, half of all measurements place the target elsewhere.

    Args:
        cell: its number.
        seed: of what is drawn; ``Scenario.simulate`` has one for the tracks.
        kind: what is wrong, instead of what the number says.
        steps: measurements of a run, at least 30.
        follow: number of measurements after a jump, the first at the new place included, with the last of which the
            estimate has to be there.  The truth is NaN, which is not judged, before that.

    Raises:
        ValueError: an argument out of its range.

    Source: this project; Kalata (1984) for the manoeuvring index.
    """
    return _scenario(draw_cell(cell, seed=seed, kind=kind), steps, follow, (seed, cell))


def _scenario(cell: OpenCell, steps: int, follow: int, salt: tuple[int, ...]) -> Scenario:
    _check(cell, steps, follow)
    seconds = _seconds(cell, steps, salt)
    truths, stated = _motions(cell, 1.0), _motions(cell, cell.stated_q)
    real, sensed = _sensor(cell, 1.0), _sensor(cell, cell.stated_std)
    root = _spread(cell, truths[0]).diag()
    size = truths[0].size

    def block(rng: np.random.Generator, numbers: Tensor) -> Tracks:
        rng = np.random.default_rng([int(rng.integers(2**62)), *salt])  # cells of one seed have noise of their own

        def normal(*shape: int) -> Tensor:
            return torch.from_numpy(rng.standard_normal((BLOCK, *shape)))

        mean = torch.zeros(BLOCK, size, dtype=torch.float64)
        mean[:, :2] = 50 * cell.std * normal(2)
        if truths[0].orders > 1:
            mean[:, 2:4] = _speed(cell) * normal(2)
        jump = _jumps(cell, rng, steps)
        u = _inputs(cell, rng, seconds)
        truth = _path(cell, rng, truths, seconds, mean + apply(root, normal(size)), u, jump)
        clean = real(truth, u)
        unit = real.measurement_noise(clean).std
        noise = normal(steps, real.size)
        if cell.kind == "heavy":
            scale = rng.chisquare(cell.freedom, (BLOCK, steps, 1)) / cell.freedom
            noise = noise / torch.from_numpy(scale).sqrt()
        outlying, offset = _outliers(cell, rng, steps, real.size, follow)
        if cell.kind == "proportional":
            twice = torch.where(real.angles & ~real.angles.all(), clean, 2 * clean)
            z = torch.where(outlying, twice, clean + unit * noise)
        else:
            z = clean + unit * (noise + offset)
        if cell.kind == "prior":
            away = normalize(normal(2), dim=-1)
            mean[:, :2] += away * root[0, 0] * torch.from_numpy(rng.choice([25.0, 250.0, 2500.0], (BLOCK, 1)))
            truth[:, :2] = torch.nan
        for later in range(follow - 1):  # not judged
            at = (torch.arange(steps) - later).expand(BLOCK, -1) == jump.unsqueeze(-1)
            truth = torch.where(at.unsqueeze(-1), torch.nan, truth)
        z = real.difference(z, torch.zeros_like(z))  # angles in (-pi, pi]
        if cell.sensor in ("radar", "ranges"):
            z = torch.where(real.angles, z, z.abs())
        return Tracks(truth, z, u, Gaussian(mean, root))

    prior = Gaussian(torch.zeros(size, dtype=torch.float64), root)
    dt = cell.dt if cell.spacing == "even" else seconds
    bank = Bank(stated) if len(stated) > 1 else None
    settings = asdict(cell) | {"follow": follow}
    return Scenario(
        "open", stated[0], sensed, prior, dt, steps, block, settings, bank, limit=LIMIT * cell.std
    )  # fmt: skip


def _check(cell: OpenCell, steps: int, follow: int) -> None:
    """Checks what a cell has.

    Raises:
        ValueError: names what is out of its range.
    """
    one_of(kind=(cell.kind, KINDS), motion=(cell.motion, MOTIONS), sensor=(cell.sensor, SENSORS))
    one_of(spacing=(cell.spacing, SPACINGS))
    for name in ("index", "dt", "std", "size", "freedom", "doubt", "stated_q", "stated_std"):
        if not 0 < getattr(cell, name) < math.inf:
            raise ValueError(f"{name}: expected a finite value above 0, received {getattr(cell, name)}")
    if not 0 <= cell.share <= 1:
        raise ValueError(f"share: expected one from 0 to 1, received {cell.share}")
    for name, value, least in (("steps", steps, 30), ("follow", follow, 1), ("length", cell.length, 1)):
        if not is_integer(value, least):
            raise ValueError(f"{name}: expected a whole number of {least} or more, received {value!r}")


# ---------------------------------------------------------------- models


def _seconds(cell: OpenCell, steps: int, salt: tuple[int, ...]) -> Tensor:
    """Seconds of each step ``(T,)``."""
    drawn = np.random.default_rng(salt).uniform(-1, 1, steps)
    factor = {"even": 0 * drawn + 1, "jittered": 1 + 0.5 * drawn, "mixed": 10**drawn}[cell.spacing]
    seconds = torch.from_numpy(cell.dt * factor)
    return seconds if cell.spacing == "even" else seconds.clamp(SHORTEST, LONGEST)


def _motions(cell: OpenCell, off: float) -> list[Motion]:
    """The motion, or those of the bank, with a process noise that is ``off`` by a factor on its variance."""
    orders = {"velocity": 2, "bank": 2, "acceleration": 3}.get(cell.motion, 1)
    q = off * (cell.index * cell.std) ** 2 / cell.dt ** (2 * orders - 1)
    if cell.motion == "acceleration":
        return [ConstantAcceleration(q, continuous=True)]
    if orders == 2:
        turns = [CoordinatedTurn(sign * _TURN / cell.dt, q, continuous=True) for sign in (1, -1)]
        return [ConstantVelocity(q, continuous=True), *(turns if cell.motion == "bank" else [])]
    heading = q / (2 * _speed(cell) * cell.dt) ** 2  # half as much across the way as the position has by itself
    bias = heading / (20 * cell.dt) ** 2 if cell.motion == "gyroscope" else None
    return [Odometry(q, heading, heading / 16, bias)]


def _sensor(cell: OpenCell, off: float) -> Sensor:
    """The sensor, which measures a position near the origin to ``std``, or states ``off`` times that."""
    away, std = _away(cell), cell.std * off
    places = torch.tensor([[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0], [0.0, 1.0]], dtype=torch.float64) * away * cell.std
    if cell.sensor == "position":
        return Position(std)
    if cell.sensor == "bearings":
        return Bearings(off / away, stations=places[:2])
    if cell.sensor == "radar":
        return RangeBearing(torch.tensor([std, off / away], dtype=torch.float64), position=places[0])
    return Ranges(places, std)


def _away(cell: OpenCell) -> float:
    """Distance of the stations in standard deviations, which no target reaches."""
    return 1e5 if cell.motion == "acceleration" else 1e4


def _speed(cell: OpenCell) -> float:
    """Of a target, m/s: in a typical step it covers 20 standard deviations, or 4 where stations are to stay away."""
    return (20 if cell.sensor == "position" else 4) * cell.std / cell.dt


def _spread(cell: OpenCell, motion: Motion) -> Tensor:
    """Standard deviations of the prior ``(n,)``."""
    place = [cell.doubt * cell.std] * 2
    if motion.orders == 1:
        rest = [0.05, 0.05] + [0.01 / cell.dt] * (motion.size - 4)
    else:
        push = cell.index * cell.std / cell.dt**2
        rest = [0.3 * _speed(cell)] * 2 + [3 * push] * (motion.size - 4)
    return torch.tensor([*place, *rest], dtype=torch.float64)


# ---------------------------------------------------------------- the way, and measurements of it


def _inputs(cell: OpenCell, rng: np.random.Generator, seconds: Tensor) -> Tensor | None:
    """Speed and heading or turn rate ``(BLOCK, T, 2)`` that a vehicle measures; None of other targets."""
    if cell.motion not in ("odometry", "gyroscope"):
        return None
    shape = (BLOCK, len(seconds))
    speed = _speed(cell) * torch.from_numpy(rng.uniform(0.5, 1.5, shape))
    rate = torch.from_numpy(rng.standard_normal(shape)) * _TURN / cell.dt
    turned = rate if cell.motion == "gyroscope" else (rate * seconds).cumsum(-1)
    return torch.stack([speed, turned], -1)


def _jumps(cell: OpenCell, rng: np.random.Generator, steps: int) -> Tensor:
    """The step ``(BLOCK,)`` at which each target is elsewhere, in the middle third; before all steps if at none."""
    drawn = torch.from_numpy(rng.integers(steps // 3, 2 * steps // 3, BLOCK))
    return drawn if cell.kind in ("moved", "reset") else torch.full_like(drawn, -steps)


def _path(
    cell: OpenCell, rng: np.random.Generator, motions: list[Motion], seconds: Tensor, state: Tensor, u: Tensor | None,
    jump: Tensor,
) -> Tensor:  # fmt: skip
    """States ``(BLOCK, T, n)`` after each step."""
    linear, steps = motions[0].linear, len(seconds)
    moves = torch.stack([m.transition(seconds) for m in motions]) if linear else None
    pushes = torch.stack([m.process_noise(seconds) for m in motions])
    leaves = rng.random((steps, BLOCK)) >= _STAY ** (seconds / cell.dt).unsqueeze(-1).numpy()
    modes = torch.from_numpy(np.where(leaves, rng.integers(1, 3, (steps, BLOCK)), 0).cumsum(0) % len(motions))
    noise = torch.from_numpy(rng.standard_normal((steps, BLOCK, pushes.shape[-1])))
    place, speed = torch.from_numpy(rng.standard_normal((2, BLOCK, 2)))
    most = math.inf if cell.sensor == "position" else 0.1 * _away(cell)
    place, speed = min(max(cell.size, 10.0), most) * cell.std * normalize(place, dim=-1), _speed(cell) * speed
    path = []
    for t in range(steps):
        if moves is None:
            state = motions[0](state, seconds[t].expand(BLOCK), None if u is None else u[:, t])
        else:
            state = _applied(moves[:, t], modes[t], state)
        state = state + _applied(pushes[:, t], modes[t], noise[t])
        if cell.turn and steps // 3 <= t < steps // 2 and linear:
            angle = _TURN * float(seconds[t]) / cell.dt
            turn = state.new_tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
            state = torch.cat([state[:, :2], *(state[:, k : k + 2] @ turn for k in range(2, state.shape[1], 2))], 1)
        if cell.kind in ("moved", "reset"):
            velocity = speed if cell.kind == "moved" and linear else state[:, 2:4]
            elsewhere = torch.cat([state[:, :2] + place, velocity, state[:, 4:]], 1)
            state = torch.where((jump == t).unsqueeze(-1), elsewhere, state)
        path.append(state)
    return torch.stack(path, 1)


def _applied(matrices: Tensor, mode: Tensor, x: Tensor) -> Tensor:
    """Vectors ``x (BLOCK, n)`` times those of the matrices ``(K, m, n)`` that are theirs."""
    return x @ matrices[0].T if len(matrices) == 1 else apply(matrices[mode], x)


def _outliers(cell: OpenCell, rng: np.random.Generator, steps: int, size: int, follow: int) -> tuple[Tensor, Tensor]:
    """Which measurements are outliers ``(BLOCK, T, 1)``, and their offsets ``(BLOCK, T, m)`` in standard deviations."""
    length = {"pairs": 2, "bursts": cell.length}.get(cell.kind, 1)
    one_offset = length < follow
    hit = torch.from_numpy(rng.random((BLOCK, steps)) < (0.5 if cell.kind == "half" else cell.share / length))
    first = torch.from_numpy(rng.integers(0, 3, (BLOCK, 1)))
    way = normalize(torch.from_numpy(rng.standard_normal((BLOCK, steps, size))), dim=-1)
    element = one_hot(torch.from_numpy(rng.integers(0, size, (BLOCK, steps))), size)
    quanta = torch.from_numpy(rng.integers(-2, 3, (BLOCK, steps, size))).double()
    if cell.kind in ("none", "heavy", "prior", "moved", "reset"):
        hit = torch.zeros_like(hit)
    elif cell.kind == "first":
        hit = torch.arange(steps) == first
    elif cell.kind == "element":
        way = element * way[..., :1].sign()
    elif cell.kind == "quantised":
        way = torch.where(quanta.any(-1, keepdim=True), quanta, element)
    elif cell.kind == "one-sided" or (cell.kind == "half" and cell.one_sided):
        way = way.abs()
    inside, of = hit.clone(), way.clone()
    for age in range(1, length):
        inside[:, age:] |= hit[:, :-age]
        if one_offset:  # of the last burst that has begun
            of[:, age:] = torch.where((hit[:, :-age] & ~_since(hit, age)).unsqueeze(-1), way[:, :-age], of[:, age:])
    return inside.unsqueeze(-1), cell.size * inside.unsqueeze(-1) * of


def _since(hit: Tensor, age: int) -> Tensor:
    """Whether another burst begins after one that is ``age`` steps old, and up to now: ``(BLOCK, T - age)``."""
    later = torch.zeros_like(hit[:, age:])
    for k in range(age):
        later |= hit[:, age - k : hit.shape[1] - k]
    return later

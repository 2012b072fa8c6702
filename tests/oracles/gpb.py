"""Regimes of the motion and outlier modes of the measurement as hypotheses, merged after every step (GPB2).

Harrison & Stevens (1976), J. R. Statist. Soc. B 38(3):205-247; Bar-Shalom, Li & Kirubarajan (2001), section 11.6. A
hypothesis is (outlier mode before, regime, outlier mode now); in a mode with outliers every block is an inlier or
an outlier of one of several sizes. Blocks are taken one after the other, each merged at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from oracles.basics import Array, Model, Result, at, collect, difference, measurement_noise, present
from oracles.cubature import Measured, draw, moments, third_degree
from oracles.kalman import fit
from oracles.mixture import matched

Propagate = Callable[[Array, Array, int], tuple[Array, Array, Array]]  # mean, P, k -> mean, F P F^T (n,n), Q (n,n)
Belief = tuple[Array, Array]  # mean, P
Beliefs = dict[tuple[int, int], Belief]  # by outlier mode (0 without, 1 with outliers), and motion or regime

MODES = (0, 1)
READS = 2  # sensors read the position alone
BLIND, NEAR, LARGEST, PRIOR_MARGIN, PRIOR_BURST = 0.02, 0.01, 1e14, 4.0, 2.0
BENT, NEWTON, LEAST, EXPECTED = 9.0, 4, 30.0, 0.7
AGILE_AFTER, AGILE_STAYS = 0.03, 0.5  # of targets that have jumped


class Regimes(NamedTuple):
    """Levels of process noise, each of one motion; manoeuvres, jumps, and what a target does after a jump.

    A jump begins from the belief of the first motion. It has a belief of its own, the last, and so have targets that
    have jumped: they move by the first motion with its stated noise, or its home level's if it has several.
    """

    motions: list[int]  # of each level
    levels: list[Any]  # factors on Q, or matrices (n,n) by which its entries are multiplied
    jumps: list[float]  # how much wider the predicted position is, times its NIS per element, as stated
    transition: Array  # (B,B) without jumps, [i, j] = P(now j | was i), levels and manoeuvres
    unmeasured: Array  # (B,B) the same in a step without any measurement
    first: Array  # (B,) probabilities before the first step
    home: int
    manoeuvres: tuple[float, ...] = ()  # times that NIS: factors on Q, at least the home level's; after the levels
    seconds: Callable[[int], tuple[Array, Array]] | None = None  # instead: (B,) what lasts, (B,B) the transition
    burst: float = 4.0  # equal outliers in a row that are no jump
    steps: Any = 1.0  # seconds of each step, one number or a function of it
    restart: Any = None  # (B,) which regime begins when a target that has jumped is as any other
    keeps: Any = ()  # of each jump: P(it is settled still) at the next measurement but the one after it
    shares: Any = ()  # of each jump in those that begin

    def seconds_of(self, k: int) -> float:
        """Of step k."""
        return float(self.steps(k) if callable(self.steps) else self.steps)

    @property
    def settled(self) -> list[Any]:
        """The levels of targets that have jumped."""
        return [1.0, self.levels[self.home]][: self.home + 1] if self.jumps else []

    @property
    def landed(self) -> int:
        """The belief of jumps."""
        return max(self.motions) + 1

    @property
    def beliefs(self) -> list[int]:
        """Into which each regime is merged: levels, manoeuvres, jumps, settled targets."""
        after = len(self.jumps) + len(self.settled)
        return self.motions + [0] * len(self.manoeuvres) + [self.landed] * after

    @property
    def sources(self) -> list[int]:
        """From which each regime predicts."""
        return self.motions + [0] * (len(self.manoeuvres) + len(self.jumps)) + [self.landed] * len(self.settled)

    @property
    def jumping(self) -> range:
        """The jumps among the regimes."""
        begin = len(self.levels) + len(self.manoeuvres)
        return range(begin, begin + len(self.jumps))

    def with_jumps(self, transition: Array, restart: Array, measured: bool) -> Array:
        """A transition (B,B) with jumps and settled targets, (R,R): nothing becomes one of these by itself."""
        count, settled = len(transition), len(self.settled)
        keeps = [*[1.0] * len(self.jumps), *[self.keeps[-1]] * settled] if self.jumps else []
        all_of_them = np.zeros((count + len(keeps),) * 2)
        all_of_them[:count, :count] = transition
        for i, keep in enumerate(keeps if measured else [1.0] * len(keeps), count):
            all_of_them[i, :count] = (1 - keep) * restart
            agile = AGILE_STAYS if i == len(all_of_them) - 1 else AGILE_AFTER
            all_of_them[i, -settled:] = keep * np.array([1 - agile, agile] if settled == 2 else [1.0])
        return all_of_them

    def pairs(self, log_regimes: Array, measured: bool, k: int) -> Array:
        """Logs of the probabilities of the regimes before and after a step, (2,R,R)."""
        none = np.zeros(len(self.first))
        with np.errstate(divide="ignore"):
            if self.seconds is None:
                chain = self.transition if measured else self.unmeasured
                return log_regimes[:, :, None] + np.log(self.with_jumps(chain, self.restart, measured))
            lasts, after = self.seconds(k)
            stays = self.with_jumps(np.diag(lasts), none, measured)
            return np.log(switched(np.exp(log_regimes), stays, self.with_jumps(after, self.restart, measured)))


class OutlierModes(NamedTuple):
    """Of each block of elements: as stated, or an outlier whose noise covariance is larger."""

    blocks: list[list[int]]
    transition: Array  # (2,2), [i, j] = P(now j | was i)
    sizes: list[float]
    shares: list[float]
    durations: tuple[float, float] | None = None  # instead of the transition: s without outliers, s that one lasts
    offsets: list[float] | None = None  # mean of the errors of outliers of each size, in units of their noise
    inform: bool = True  # whether an outlier changes the belief
    same_offset: float = 0.0  # probability that an outlier after another has its offset; of linear sensors
    transitions: list[Callable[[int], Array]] | None = None  # beside it: F (n,n) of every motion at step k
    noise: tuple[float, float] | None = None  # what is learned of it: std of its log variance, and measurements kept
    least: float = 0.5  # factor on the stated variance below which the noise is not
    unreliable: float = 0.005  # probability of a device that measures large outliers half of the time
    line: Any = None  # the measurement as a `Line`, for beliefs whose points are far off any

    def over(self, seconds: float) -> Array:
        """The transition (2,2) between two measurements."""
        if self.durations is None:
            return self.transition
        if math.isinf(seconds):  # before the first measurement: as in the long run
            return np.tile(np.array(self.durations) / sum(self.durations), (2, 1))
        return exponential([[-1, 1], [1, -1]] / np.array(self.durations)[:, None] * seconds)


def exponential(matrix: Array) -> Array:
    """The exponential of a square matrix with distinct eigenvalues."""
    values, vectors = np.linalg.eig(matrix)
    return np.real(vectors @ np.diag(np.exp(values)) @ np.linalg.inv(vectors))


def switched(weights: Array, stays: Array, after: Array) -> Array:
    """Regimes before and after a step (2,R,R): what has lasted (R,R), else `after` (R,R) from what all that ended know.

    The regimes after the step are as likely as the transition in time says.
    """
    pairs = np.zeros((2, *after.shape))
    for q in MODES:
        ended = weights[q] * (1 - stays.sum(1))
        begun = weights[q] @ (after - stays)
        pairs[q] = weights[q][:, None] * stays + np.outer(ended / (ended.sum() or 1.0), begun)
    return pairs


def restart_transition(self_transition: list[float], restart: list[float]) -> Array:
    """The transition of regimes with these self-transition probabilities and this restart distribution."""
    count = len(self_transition)
    transition = np.zeros((count, count))
    for i in range(count):
        for j in range(count):
            transition[i, j] = (1 - self_transition[i]) * restart[j] + (self_transition[i] if i == j else 0.0)
    return transition


def unmeasured_transition(self_transition: list[float], restart: list[float], others: range) -> Array:
    """That of steps without any measurement, in which no regime begins but those of other motions."""
    return restart_transition(
        [1 - (1 - s) * sum(restart[j] for j in others) for s in self_transition],
        [restart[j] / sum(restart[i] for i in others) if j in others else 0.0 for j in range(len(restart))],
    )


def stationary(transition: Array) -> Array:
    """Probabilities (R,) of the regimes that a step of the transition does not change."""
    count = len(transition)
    equations = np.vstack([(np.eye(count) - transition).T, np.ones(count)])
    return np.linalg.lstsq(equations, np.eye(count + 1)[count], rcond=None)[0]


def linear_motion(F: Any, SQ: Any) -> Propagate:
    """A linear motion; F and SQ may be callables of k."""

    def carry(mean: Array, P: Array, k: int) -> tuple[Array, Array, Array]:
        f, root = at(F, k), at(SQ, k)
        return f @ mean, f @ P @ f.T, root @ root.T

    return carry


def interacted(beliefs: Beliefs, log_pairs: Array, motion: list[int]) -> tuple[Beliefs, Array]:
    """What every motion starts from, and the share (2, K, K) that each one has in it, [mode, was, now]."""
    count, mixed = max(motion) + 1, {}
    shares = np.zeros((2, count, count))
    for q in MODES:
        for now in range(count):
            to = [j for j, m in enumerate(motion) if m == now]
            log_from = [
                log_sum([log_pairs[q, i, j] for i, m in enumerate(motion) if m == was for j in to])
                for was in range(count)
            ]
            total = log_sum(log_from)
            # what has no weight stays as it is
            shares[q, :, now] = np.eye(count)[now] if total == -math.inf else np.exp(np.array(log_from) - total)
            mixed[q, now] = matched([(shares[q, was, now], *beliefs[q, was]) for was in range(count)])
    return mixed, shares


def predicted(mixed: Beliefs, motions: list[Propagate], regimes: Regimes, k: int) -> Beliefs:
    """The prediction of every level, and of targets that have jumped."""
    after = range(regimes.jumping.stop, len(regimes.beliefs))
    moves = [(r, m, m) for r, m in enumerate(regimes.motions)] + [(r, 0, regimes.landed) for r in after]
    predictions = {}
    for q in MODES:
        for (r, motion, belief), level in zip(moves, [*regimes.levels, *regimes.settled], strict=True):
            mean, J, Q = motions[motion](*mixed[q, belief], k)
            predictions[q, r] = mean, J + level * Q
    return predictions


def widening(prediction: Belief, z: Array, model: Model, k: int) -> float:
    """How much wider an outlying prior has to be to explain the first measurement, on its covariance."""
    R = measurement_noise(model, k, present(z))
    m = read(prediction, z, model, k)
    excess = PRIOR_MARGIN * (fit(m.e, R)[0] - len(m.e)) / np.trace(np.linalg.solve(R, m.Pzz - R))
    return float(min(max(excess, 1.0), LARGEST))


class Fit(NamedTuple):
    """How well a prediction explains a measurement, in units of its noise."""

    width: float  # log of the root of the determinant of the innovation's covariance
    square: float  # normalised innovation squared

    @staticmethod
    def of(prediction: Belief, z: Array, model: Model, k: int) -> Fit:
        if not present(z):
            return Fit(0.0, 0.0)
        m, R = read(prediction, z, model, k), measurement_noise(model, k, present(z))
        return Fit(0.5 * (np.linalg.slogdet(m.Pzz)[1] - np.linalg.slogdet(R)[1]), fit(m.e, m.Pzz)[0])


class Jumped(NamedTuple):
    """Manoeuvres and jumps, as wide as the measurement asks for, and what the measurement says of each mode."""

    predictions: Beliefs
    rarity: Array  # (2, M + J) logs of how rare they are
    factors: dict[tuple[int, int], tuple[Array, Array]]  # by what a state is multiplied (n,), and process noise (n,n)
    costs: list[float]  # how much less likely the measurement is as outliers
    expected: list[float]  # how much less likely it is expected to be than with its noise alone
    off: list[float]  # how much further off it is than the least of outliers
    least: float  # cost of outliers beside which a jump is seen


def jumped(
    mixed: Beliefs, motions: list[Propagate], regimes: Regimes, position: slice, z: Array, model: Model, k: int,
    outlying: OutlierModes, transition: Array, begins: bool, since: float,
) -> Jumped:  # fmt: skip
    """Manoeuvres and jumps, up to LARGEST."""
    found = Jumped({}, np.zeros((2, 0)), {}, [], [], [], 0.0)
    after, factors, rarity, level = found.predictions, found.factors, [], regimes.levels[regimes.home]
    for q in MODES:
        mean, J, Q = motions[0](*mixed[q, 0], k)
        P = J + Q
        m = read((mean, P), z, model, k)
        count, free = len(m.e), max(min(len(m.e), position.stop), 1)
        nis = fit(m.e, m.Pzz)[0] / max(count, 1)
        R = measurement_noise(model, k, present(z))
        seen = np.trace(np.linalg.solve(R, m.Pzz - R)) if count else 0.0
        usual = math.log(1 + seen / max(count, 1))
        rarer, beyond, least = cost(m.e, z, model, k, outlying, transition, position.stop, min(usual, EXPECTED))
        found.costs.append(rarer)
        found.expected.append(count / 2 * min(usual, EXPECTED))
        found.off.append(max(Fit.of((mean, P), z, model, k).square / 2 - least, 0.0))
        unchanged, beliefs = np.ones(len(mean)), [*regimes.motions, *[regimes.landed] * len(regimes.settled)]
        each = [*range(len(regimes.levels)), *range(regimes.jumping.stop, len(regimes.beliefs))]
        for r, belief, factor in zip(each, beliefs, [*regimes.levels, *regimes.settled], strict=True):
            motion = motions[0 if belief == regimes.landed else belief]
            factors[q, r] = unchanged, factor * motion(*mixed[q, belief], k)[2]
        for r, factor in enumerate(regimes.manoeuvres, len(regimes.levels)):
            factors[q, r] = unchanged, max(level, min(factor * nis, LARGEST)) * Q
            after[q, r] = mean, J + factors[q, r][1]
        rare = 0.0
        for r, jump in zip(regimes.jumping, regimes.jumps, strict=True):
            size = min(max(jump * nis, 1.0), LARGEST)
            offset, widen = np.zeros_like(P), np.ones(len(mean))
            offset[position, position] = (size - 1) * P[position, position]  # independent of all else
            far = math.sqrt((size - 1) * np.diag(P)[position].mean())
            for order in (1, 2):  # velocity and acceleration: three times as large as before, at least
                rates = range(order * position.stop, min((order + 1) * position.stop, len(mean)))
                if len(rates) and np.diag(P)[rates].any():
                    std = math.sqrt(np.diag(P)[rates].mean())
                    pushed = order * far / since**order if since else 0.0  # what takes it so far
                    faster = 3 * np.linalg.norm(mean[rates]) / std
                    widen[rates] = min(max(math.sqrt(size), pushed / std), max(1.0, faster))
            factors[q, r] = widen, (Q + offset) * np.outer(widen, widen)
            after[q, r] = mean, (P + offset) * np.outer(widen, widen)
            if rarer > 0:
                burst = PRIOR_BURST if begins else regimes.burst
                own = free / 2 * (math.log(1 + size * seen / free) - 1 - usual)
                first = max(math.log(transition[1, 1] / max(transition[0, 1], 1e-12)), 0.0)
                wide, most = free / 2 * (usual - min(usual, EXPECTED)), own - rarer - first
                rare = min(most + wide - (burst - 0.7) * rarer, most)
                rare += 0.0 if begins else math.log(min(max(beyond, 0.01), 1.0))
        manoeuvre = -2 * math.log(max(nis / 30.0, 1.0))
        rarity.append([manoeuvre] * len(regimes.manoeuvres) + [rare] * len(regimes.jumps))
    return found._replace(rarity=np.array(rarity), least=least)


def given(predictions: Beliefs, regimes: Regimes, jump: Jumped, chance: Array, z: Array, model: Model, k: int) -> Array:
    """Logs (2,) of what a settled target is given back, as its velocity and its acceleration are unknown."""
    if not regimes.settled or not present(z):
        return np.zeros(2)
    likelier = int(log_sum(chance[1]) > log_sum(chance[0]))
    unknown = []
    for q in MODES:
        width, square = Fit.of(predictions[q, regimes.jumping.stop], z, model, k)
        wider = width - jump.expected[likelier] - max(len(present(z)) - square, 0.0) / 2
        unknown.append(max(min(wider - max(square / 2 - jump.least, 0.0), jump.off[likelier]), 0.0))
    return np.array(unknown)


def cost(
    e: Array, z: Array, model: Model, k: int, q: OutlierModes, transition: Array, dims: int, usual: float
) -> tuple[float, float, float]:
    """Log of how much less likely a measurement is as outliers that last than as stated, how far above its least."""
    measured = present(z)
    if not measured:
        return 0.0, 0.0, 0.0
    whole = np.zeros(len(z))
    whole[measured] = np.linalg.solve(np.linalg.cholesky(measurement_noise(model, k, measured)), e)
    rare = -math.log(max(*transition[:, 1], 1e-12))
    total = least = 0.0
    for block in q.blocks:
        count, square = sum(i in measured for i in block), (whole[block] ** 2).sum()
        sizes = [*q.sizes[:-1], max(q.sizes[-1], square / max(count, 1))]
        each = [size ** (-count / 2) * math.exp(-square / size / 2) for size in sizes]
        total += min(square / 2, rare - math.log(np.dot(q.shares, each)) - count / 2 * (1 + usual))
        least += rare - math.log(q.shares[-1]) + len(block) / 2 * (math.log(LEAST) - EXPECTED)
    total, least = total * min(1.0, dims / len(measured)), least * min(1.0, dims / len(z))
    return max(total, least), max(total - least, 0.0), least


def paths(
    mixed: Beliefs, predictions: Beliefs, regimes: Regimes, factors: dict[tuple[int, int], tuple[Array, Array]],
    q: OutlierModes, k: int,
) -> Beliefs:  # fmt: skip
    """By how much a step changes the state, by every regime."""
    moved = {}
    for (before, r), (widen, Q) in factors.items():
        belief = regimes.sources[r]
        mean, P = mixed[before, belief]
        change = np.diag(widen) @ q.transitions[0 if belief == regimes.landed else belief](k) - np.eye(len(mean))
        moved[before, r] = predictions[before, r][0] - mean, change @ P @ change.T + Q
    return moved


class Line(NamedTuple):
    """A measurement as a line near the place where it was made, elements that are missing left out."""

    measured: list[int]
    point: Array
    e: Array  # what is measured beyond it
    H: Array
    rest: Array  # covariance of what a line leaves out
    bent: Array  # of each element, noises off the line of the belief's points where they place the target, by variance


def line_at_place(belief: Belief, z: Array, model: Model, k: int) -> Line:
    """The line at the place that a belief and a measurement have in common, by damped Gauss-Newton steps."""
    mean, P = belief[0][:READS], belief[1][:READS, :READS]
    points, *weights = third_degree(len(belief[0]))
    rule, measured = (points[:READS], weights[0], weights[1]), present(z)
    angles, R = np.asarray(model.angles, dtype=bool)[measured], measurement_noise(model, k, measured)

    def line(point: Array, square: Array) -> Line:
        zhat, gaps = deviations(point, np.diag(square), model, k, rule, measured)
        wc = np.diag(rule[2])
        H = gaps.T @ wc @ (draw(point, np.diag(square), rule) - point) @ np.diag(1 / square)
        rest = gaps.T @ wc @ gaps - H @ np.diag(square) @ H.T
        return Line(measured, point, difference(np.asarray(z)[measured], zhat, angles), H, rest, bent)

    seen, units = read(belief, z, model, k), np.linalg.inv(np.linalg.cholesky(R))
    gain = seen.Pxz @ np.linalg.inv(seen.Pzz)
    moved, after = gain @ seen.e, P - gain @ seen.Pzz @ gain.T
    there = read((mean + moved, NEAR**2 * after), z, model, k)
    left = seen.e - seen.H @ moved
    reached = np.abs(units @ left).max() <= math.sqrt(BENT)
    bent = reached * np.abs(units @ (there.e - left)) / np.diag(units @ seen.H @ P @ seen.H.T @ units.T)
    point, square = mean, NEAR**2 * np.diag(P)
    for _ in range(NEWTON):
        seen = line(point, square)
        left = max(1.0, fit(seen.e, R)[0] / len(z))
        weighted = np.linalg.solve(left * R, seen.H).T
        after = np.linalg.inv(np.linalg.inv(P) + weighted @ seen.H)
        point = mean + after @ weighted @ (seen.e + seen.H @ (point - mean))
    return line(point, np.diag(after))


def along(line: Line, belief: Belief, block: list[int], R: Array) -> Measured:
    """A block compared with a belief by a line."""
    chosen = [line.measured.index(i) for i in block if i in line.measured]
    mean, P = belief[0][:READS], belief[1][:READS, :READS]
    H = line.H[chosen]
    e = line.e[chosen] + H @ (line.point - mean)
    return Measured(R + line.rest[np.ix_(chosen, chosen)] + H @ P @ H.T, P @ H.T, e, H)


def updated(belief: Belief, m: Measured, R: Array, size: float, first: bool, off: float) -> tuple[float, Array, Array]:
    """The belief after one block, whose noise covariance is `size` times the stated one, and its log density.

    What the points add to the noise counts for the first block that is measured alone.
    """
    mean, P = belief
    sloped = m.H @ P[:READS, :READS] @ m.H.T
    noise = size * R + (m.Pzz - R - sloped if first else 0.0)
    e = m.e - off * np.linalg.cholesky(R).sum(1)
    W = P[:, :READS] @ m.H.T @ np.linalg.inv(sloped + noise)
    left = np.eye(len(mean))
    left[:, :READS] -= W @ m.H
    P = left @ P @ left.T + W @ noise @ W.T  # by Joseph: it may have been wide
    return fit(e, sloped + noise)[1], mean + W @ e, (P + P.T) / 2


def compared(belief: Belief, z: Array, block: list[int], model: Model, k: int, line: Line | None) -> Measured:
    """A block compared with a belief by its points, or by the line where they are far off any."""
    alone = np.full(len(z), np.nan)
    alone[block] = z[block]
    m, measured = read(belief, alone, model, k), [i for i in block if not math.isnan(z[i])]
    if line is None or not measured:
        return m
    R = measurement_noise(model, k, measured)
    whiten = np.linalg.inv(np.linalg.cholesky(R))
    sloped = m.Pxz.T @ np.linalg.solve(belief[1][:READS, :READS], m.Pxz)
    rest, seen = (np.diag(whiten @ x @ whiten.T) for x in (m.Pzz - R - sloped, sloped))
    bent = line.bent[[line.measured.index(i) for i in measured]] * seen
    return along(line, belief, block, R) if rest.max() > BENT or bent.max() > math.sqrt(BENT) else m


def read(belief: Belief, z: Array, model: Model, k: int) -> Measured:
    """A measurement predicted from the position alone, as the points of the whole state see it.

    An element of whose variance the points explain less than a fiftieth by the position is measured by points a hundred
    times as near.
    """
    points, *weights = third_degree(len(belief[0]))
    rule, (mean, P) = (points[:READS], weights[0], weights[1]), (belief[0][:READS], belief[1][:READS, :READS])
    measured = present(z)
    zhat, gaps = deviations(mean, P, model, k, rule, measured)
    wc = np.diag(rule[2])
    x = draw(mean, P, rule) - mean
    for i in range(len(zhat)):
        across = x.T @ wc @ gaps[:, i]
        if across @ np.linalg.solve(P, across) < BLIND * (gaps[:, i] @ wc @ gaps[:, i]):
            near, near_gaps = deviations(mean, P * NEAR**2, model, k, rule, measured)
            zhat[i], gaps[:, i] = near[i], near_gaps[:, i] / NEAR
    Pxz = x.T @ wc @ gaps
    angles = np.asarray(model.angles, dtype=bool)[measured]
    Pzz = measurement_noise(model, k, measured) + gaps.T @ wc @ gaps
    return Measured(Pzz, Pxz, difference(np.asarray(z)[measured], zhat, angles), Pxz.T @ np.linalg.inv(P))


def deviations(mean: Array, P: Array, model: Model, k: int, rule: Any, measured: Any) -> tuple[Array, Array]:
    """The predicted measurement, and how nis that of each point is from it."""
    angles = np.asarray(model.angles, dtype=bool)[measured]
    values = np.array([model.h(x, k)[measured] for x in draw(mean, P, rule)])
    return moments(values, model.h(mean, k)[measured], angles, rule[1])


def is_first(block: list[int], z: Array, q: OutlierModes) -> bool:
    """Whether nothing in the blocks before one is measured."""
    return all(math.isnan(z[i]) for other in q.blocks[: q.blocks.index(block)] for i in other)


def without_outliers(
    belief: Belief, z: Array, q: OutlierModes, model: Model, k: int
) -> tuple[float, Belief, list[Array]]:
    """The measurement taken as stated: its log density, the belief after it, and what it says about the noise."""
    total, noise = 0.0, []
    for block in q.blocks:
        first, m = is_first(block, z, q), compared(belief, z, block, model, k, q.line)
        R = measurement_noise(model, k, [i for i in block if not math.isnan(z[i])])
        noise.append(about_noise(belief, m, R, first, block, z))
        score, *after = updated(belief, m, R, 1.0, first, 0.0)
        belief, total = (after[0], after[1]), total + score
    return total, belief, noise


def about_noise(belief: Belief, m: Measured, R: Array, first: bool, block: list[int], z: Array) -> Array:
    """Of the elements of a block that is an inlier (3,m), in units of its noise: the residual after the update, its
    square minus what it is expected to be, and its expected square; 0 where missing."""
    measured = [i for i in block if not math.isnan(z[i])]
    P, about = belief[1][:READS, :READS], np.zeros((3, len(z)))
    Pzz = m.Pzz if first else m.Pxz.T @ np.linalg.inv(P) @ m.Pxz + R
    S, root = np.linalg.inv(Pzz), np.linalg.cholesky(R)
    square = np.diag(root.T @ S @ root)
    residual = root.T @ S @ m.e
    residual *= min(1.0, 5.0 * math.sqrt(square.sum()) / max(np.linalg.norm(residual), 1e-300))
    about[:, measured] = residual, residual**2 - square, square
    return about


def with_outliers(
    belief: Belief,
    z: Array,
    q: OutlierModes,
    model: Model,
    k: int,
    prior: Array,
    tables: list[Array],
    again: Array,
    path: Belief,
    last: Array,
) -> tuple[float, Belief, list[float], list[float], list[Array]]:
    """Each block an inlier, or an outlier with probability `prior` (B,): log density, belief, and P(outlier) of each.

    Also the probability that each device is unreliable, by `tables` of `devices`, and what inliers say about the noise.
    Of the outliers `again` (B,) have the offset that they had in the measurement before: z has changed as the `path`
    says.
    """
    total, outlier, unreliable, noise = 0.0, [], [], []
    for block, share, table, chance in zip(q.blocks, prior, tables, again, strict=True):
        offsets = [0.0] * len(q.sizes) if q.offsets is None else q.offsets
        m = compared(belief, z, block, model, k, q.line)
        R = measurement_noise(model, k, [i for i in block if not math.isnan(z[i])])
        furthest = max(q.sizes[-1], nis_per_element(m, R, offsets[-1]))
        shares, faulty = table.sum(0), [*(table[1] / table.sum(0))]
        chances = [1 - share] + [share * (1 - chance) * s / shares[1:].sum() for s in shares[1:]]
        first, sizes = is_first(block, z, q), [1.0, *q.sizes[:-1], furthest]
        parts = [updated(belief, m, R, size, first, off) for size, off in zip(sizes, [0.0, *offsets], strict=True)]
        if not q.inform:
            parts = [parts[0], *((part[0], *belief) for part in parts[1:])]
        if chance:
            parts.append((unchanged(z - last, block, path, model, k), *belief))
            chances.append(share * chance)
            faulty.append(table[1].sum())
        scores = [log(c) + part[0] for c, part in zip(chances, parts, strict=True)]
        score = log_sum(scores)
        weights = [math.exp(s - score) for s in scores]
        noise.append(weights[0] * about_noise(belief, m, R, first, block, z))
        belief = matched([(w, *part[1:]) for w, part in zip(weights, parts, strict=True)])
        outlier.append(sum(weights[1:]))
        unreliable.append(np.dot(weights, faulty))
        total += score
    return total, belief, outlier, unreliable, noise


def unchanged(change: Array, block: list[int], path: Belief, model: Model, k: int) -> float:
    """Log density of a block's change since the step before, with noise then and now, if its offset is the same."""
    measured = [i for i in block if not math.isnan(change[i])]
    H = np.array([model.h(e, k)[measured] for e in np.eye(READS)]).T
    mean, P = path[0][:READS], path[1][:READS, :READS]
    return fit(change[measured] - H @ mean, H @ P @ H.T + 2 * measurement_noise(model, k, measured))[1]


def nis_per_element(m: Measured, R: Array, off: float) -> float:
    """The square of a block's error per element, in units of its noise."""
    return fit(m.e - off * np.linalg.cholesky(R).sum(1), R)[0] / max(len(m.e), 1)


def log_sum(logs: Any) -> float:
    """Log of a sum of exponentials."""
    top = max(logs)
    return float(top) if top == -math.inf else float(top) + math.log(sum(math.exp(x - top) for x in logs))


def log(x: float) -> float:
    """Its logarithm, also of nothing."""
    return math.log(x) if x > 0 else -math.inf


def devices(q: OutlierModes, transition: Array, was: Array, unreliable: Array, before: int) -> list[Array]:
    """Of each block probabilities (2,1+C) of a reliable and an unreliable device beside no outlier and those of each
    size, after mode `before`, in which blocks were outliers with probability `was` (B,)."""
    larger, tables = np.array(q.shares), []
    larger[: len(larger) // 2] = 0
    for faulty, outlying in zip(unreliable, was if before else np.zeros(len(was)), strict=True):
        table = np.zeros((2, 1 + len(q.shares)))
        for device, chance in enumerate([1 - faulty, faulty]):
            for last, of in enumerate([1 - outlying, outlying]):
                fails, shares = transition[last, 1], np.array(q.shares)
                if device and not last:
                    fails, shares = 0.5, larger / larger.sum()
                table[device] += chance * of * np.array([1 - fails, *(fails * shares)])
        tables.append(table)
    return tables


def outlier_probabilities(tables: list[Array]) -> tuple[Array, Array]:
    """Probabilities (2,) of the modes without and with outliers, and (B,) of each block in the latter."""
    now = np.array([table[:, 1:].sum() for table in tables])
    ok = float(np.prod(1 - now))
    return np.array([ok, 1 - ok]), now / (1 - ok)


def same_offset_probabilities(
    q: OutlierModes, was: Array, transition: Array, tables: list[Array], last: Array, z: Array, before: int
) -> Array:
    """Probabilities (B,) that an outlier of each block has the offset of the one before it, after mode `before`."""
    again = np.zeros(len(q.blocks))
    for b, block in enumerate(q.blocks):
        known = not any(math.isnan(last[i]) and not math.isnan(z[i]) for i in block)
        if before and known and was[b]:
            again[b] = q.same_offset * was[b] * transition[1, 1] / tables[b][:, 1:].sum()
    return again


class State(NamedTuple):
    """What goes from step to step."""

    beliefs: Beliefs  # of every motion
    log_regimes: Array  # (2,R) logs of the probabilities of mode and regime
    outlier: Array  # (B,) of each block, in the mode with outliers
    last: Array  # (m,) the measurement
    unreliable: Array  # (2,B) probability that each device is, of every mode
    noise: Array | None = None  # (B,2) of the log of each block's noise scale: mean, variance
    waiting: Array | None = None  # (5,m) of each element: what its last residual says once the next one has come
    since: float = 0.0  # s since the last measurement, or since the prior
    count: float = 0  # of the measurements; minus the binary log of a mean of 1/2^count where these differ
    wider: float = 1.0  # than the inflated prior, at the first of them


def start(mean: Array, P: Array, regimes: Regimes, q: OutlierModes, prior_outlier: float, factor: float) -> State:
    """The prior as given, and the same widened."""
    beliefs = {(i, m): (mean, P * (factor if i else 1.0)) for i in MODES for m in set(regimes.beliefs)}
    first = np.append(regimes.first, np.zeros(len(regimes.beliefs) - len(regimes.first)))
    with np.errstate(divide="ignore"):
        log_regimes = np.log(np.array([share * first for share in (1 - prior_outlier, prior_outlier)]))
    nothing = np.full(sum(len(block) for block in q.blocks), np.nan)
    noise = None if q.noise is None else np.tile([0.0, q.noise[0] ** 2], (len(q.blocks), 1))
    waiting = np.zeros((5, len(nothing)))
    unreliable = np.full((2, len(q.blocks)), q.unreliable)
    return State(beliefs, log_regimes, np.zeros(len(q.blocks)), nothing, unreliable, noise, waiting)


class Hypothesis(NamedTuple):
    """One of a step."""

    now: int  # mode
    regime: int
    before: int  # mode
    log_weight: float
    belief: Belief
    outlier: Array  # (B,)
    unreliable: Array  # (B,)
    noise: Array  # (3,m) from `about_noise`


def hypotheses(
    predictions: Beliefs, moved: Beliefs, log_chance: Array, c: State, transition: Array, z: Array, model: Model,
    q: OutlierModes, widest: int, k: int,
) -> list[Hypothesis]:  # fmt: skip
    """All of a step, before their weights are made to sum to one."""
    found: list[Hypothesis] = []
    nothing = np.isnan(z).all()
    lines = [None if nothing else line_at_place(predictions[before, widest], z, model, k) for before in MODES]
    for before, r in predictions:
        q = q._replace(line=lines[before])
        unreliable = c.unreliable[before] + (q.unreliable - c.unreliable[before]) / 200
        tables = devices(q, transition, c.outlier, unreliable, before)
        mode, prior = outlier_probabilities(tables)
        again = same_offset_probabilities(q, c.outlier, transition, tables, c.last, z, before)
        if nothing:
            mode = np.eye(2)[before]  # until a measurement says more
        score, belief, noise = without_outliers(predictions[before, r], z, q, model, k)
        weight = log_chance[before, r]
        fine, none = np.array([table[1, 0] / table[:, 0].sum() for table in tables]), np.zeros(len(prior))
        found.append(Hypothesis(0, r, before, weight + log(mode[0]) + score, belief, none, fine, np.sum(noise, axis=0)))
        path = moved.get((before, r), predictions[before, r])
        score, belief, outlier, faulty, noise = with_outliers(
            predictions[before, r], z, q, model, k, prior, tables, again, path, c.last
        )
        weight += log(mode[1]) + score
        of_blocks = np.array(outlier), np.array(faulty)
        found.append(Hypothesis(1, r, before, weight, belief, *of_blocks, np.sum(noise, axis=0)))
    return found


def merged(every: list[Hypothesis]) -> tuple[float, Belief]:
    """Log weight and moments of some hypotheses together."""
    total = log_sum([h.log_weight for h in every])
    if total == -math.inf:  # as any other: it has no weight
        return total, every[0].belief
    return total, matched([(math.exp(h.log_weight - total), *h.belief) for h in every])


def forgotten(noise: Array, q: OutlierModes, z: Array) -> Array:
    """What is known (B,2) of the noise at a measurement: what was, and that it may have changed since."""
    doubt, memory = q.noise or (0.0, 1.0)
    rows = []
    for (mean, variance), block in zip(noise, q.blocks, strict=True):
        kept = 1.0 if np.isnan(z[block]).all() else math.exp(-1 / memory)
        rows.append([kept * mean, kept**2 * variance + (1 - kept**2) * doubt**2])
    return np.array(rows)


def judged(
    noise: Array, waiting: Array, about: Array, inlier: Array, expected: Any, z: Array, model: Model, k: int,
    blocks: list[list[int]],
) -> tuple[Array, Array]:  # fmt: skip
    """What is known (B,2) of the noise after a measurement, and what waits (5,m) for the next one.

    The residuals that wait are right about the noise if this innovation has nothing in common with them.
    """
    measured = present(z)
    R = measurement_noise(model, k, measured)
    units = np.linalg.inv(np.linalg.cholesky(R))
    std, e, variance = (np.zeros(len(z)) for _ in range(3))
    std[measured], e[measured] = np.sqrt(np.diag(R)), units @ expected.e
    variance[measured] = np.diag(units @ expected.Pzz @ units.T)
    noise, after = noise.copy(), waiting.copy()
    for b, block in enumerate(blocks):
        block = [i for i in block if i in measured]
        residual, excess, share, scale, weight = waiting[:, block]
        unit = std[block] * scale
        spread = max((unit**2 * variance[block]).sum(), (unit**2 * e[block] ** 2).sum())
        if block and share.any():
            c = (2 * share.sum() + spread) / weight.sum()
            noise[b, 1] = 1 / (1 / noise[b, 1] + inlier[b] * share.sum() / c)
            noise[b, 0] += noise[b, 1] * inlier[b] * (excess - residual * unit * e[block]).sum() / c
        now = [*about[:, block], inlier[b] / std[block], inlier[b] * np.ones(len(block))]
        after[:, block] = np.array(now) + (1 - inlier[b]) * waiting[:, block]
    return noise, after


def louder(model: Model, k: int, noise: Array, q: OutlierModes) -> Model:
    """The model with its noise as large as is known."""
    scale = np.ones(sum(len(block) for block in q.blocks))
    for (mean, _), block in zip(noise, q.blocks, strict=True):
        scale[block] = math.exp(mean)
    return model._replace(SR=np.sqrt(scale)[:, None] * at(model.SR, k))


def step(
    c: State,
    z: Array,
    motions: list[Propagate],
    model: Model,
    regimes: Regimes,
    q: OutlierModes,
    position: slice,
    k: int,
) -> tuple[State, dict[str, Any], Belief]:
    """One step: the state after it, its output, and the one-step smoothed belief of the step before."""
    beliefs, source, nothing = regimes.beliefs, regimes.sources, bool(np.isnan(z).all())
    known = c.noise
    if known is not None:
        known = forgotten(known, q, z)
        model = louder(model, k, known, q)
    since = c.since + regimes.seconds_of(k)
    log_pairs = regimes.pairs(c.log_regimes, not nothing, k)
    mixed, shares = interacted(c.beliefs, log_pairs, beliefs)
    predictions = predicted(mixed, motions, regimes, k)
    over = q.over(since if c.count else math.inf)
    begins = c.count < -math.log2(0.7)
    jump = jumped(mixed, motions, regimes, position, z, model, k, q, over, begins, since)
    predictions |= jump.predictions
    moved = paths(mixed, predictions, regimes, jump.factors, q, k) if q.same_offset else {}
    chance = np.array([[log_sum(log_pairs[q, :, r]) for r in range(len(beliefs))] for q in MODES])
    # What a settled target does not know is no evidence, from the seventh measurement on.
    unknown = np.zeros(2)
    if c.count >= -math.log2(0.02):
        unknown = given(predictions, regimes, jump, chance, z, model, k)
    jumps = regimes.jumping
    if jumps and not nothing:  # as likely as all regimes together that are not settled, but for how rare they are
        chance[:, jumps] = [[log_sum(row[: jumps.start])] * len(jumps) for row in chance] + np.log(regimes.shares)
    chance[:, len(regimes.levels) : jumps.stop] += jump.rarity
    wider, rare, begun = c.wider, [0.0, 0.0], 0.0
    if begins and not nothing:
        wider = widening(predictions[1, 0], z, model, k)
        predictions |= {
            key: (mean, P * np.outer(*[np.where(np.arange(len(mean)) < 2 * position.stop, wider**0.5, 1.0)] * 2))
            for key, (mean, P) in predictions.items()
            if key[0] and key[1] not in jumps
        }
        rare = [min(i * 3 * math.log(wider), (PRIOR_BURST + i - 1.6) * jump.costs[1]) for i in (1, 2)]
    if -math.log2(0.7) <= c.count < -math.log2(0.2) and wider > 1 and not nothing:
        # What a prior that is off does not know is no evidence.
        m = read(predictions[0, 0], z, model, k)
        R = measurement_noise(model, k, present(z))
        begun = min(0.5 * (np.linalg.slogdet(m.Pzz)[1] - np.linalg.slogdet(R)[1]), 3 * np.log(c.wider))
    every = hypotheses(predictions, moved, chance, c, over, z, model, q, jumps.stop - 1, k)
    gains = {(0, 0): begun, (1, 0): 0.0, (0, 1): -rare[0], (1, 1): -rare[1]}
    settled = [r for r, belief in enumerate(beliefs) if jumps and belief == regimes.landed]
    every = [
        h._replace(log_weight=h.log_weight + min(gains[h.now, h.before], 0.0 if h.regime in settled else math.inf))
        for h in every
    ]
    every = [
        h._replace(log_weight=h.log_weight + unknown[h.before]) if h.now == 0 and h.regime >= jumps.stop else h
        for h in every
    ]
    log_likelihood, (mean, P) = merged(every)
    every = [h._replace(log_weight=h.log_weight - log_likelihood) for h in every]
    after = {key: merged([h for h in every if (h.now, beliefs[h.regime]) == key])[1] for key in c.beliefs}
    log_regimes = np.array([
        [log_sum([h.log_weight for h in every if (h.now, h.regime) == (now, r)] or [-math.inf])
         for r in range(len(beliefs))]
        for now in MODES
    ])  # fmt: skip
    lagged = matched([
        (sum(math.exp(h.log_weight) * shares[i, was, source[h.regime]] for h in every if h.before == i), *belief)
        for (i, was), belief in c.beliefs.items()
    ])  # fmt: skip
    outlier = np.sum([h.now * math.exp(h.log_weight) * h.outlier for h in every], axis=0)
    ahead_of = np.exp(chance) / np.exp(chance).sum()
    expected = read(matched([(ahead_of[key], *predictions[key]) for key in predictions]), z, model, k)
    output = {
        "mean": mean, "P": P, "regimes": np.exp(log_regimes).sum(0), "outlier": outlier,
        "log_likelihood": log_likelihood, "nis": fit(expected.e, expected.Pzz)[0],
    }  # fmt: skip
    waiting = c.waiting
    if known is not None:
        about = np.sum([math.exp(h.log_weight) * h.noise for h in every], axis=0)
        if not nothing:
            known, waiting = judged(known, waiting, about, 1 - outlier, expected, z, model, k, q.blocks)
            known[:, 0] = known[:, 0].clip(min=math.log(q.least)) if q.least else known[:, 0]
        output["noise"] = np.exp(known[:, 0])
    now = State(after, log_regimes, c.outlier, z, c.unreliable, known, waiting, since, c.count, c.wider)
    if nothing:
        output["outlier"] = np.zeros(len(c.outlier))
        return now, output, lagged
    outlier = outlier / np.exp(log_regimes[1]).sum()
    faulty = np.array([
        np.sum([math.exp(h.log_weight - log_sum(log_regimes[i])) * h.unreliable for h in every if h.now == i], axis=0)
        for i in MODES
    ])  # fmt: skip
    now = now._replace(outlier=outlier, unreliable=faulty, since=0.0, count=c.count + 1, wider=wider)
    return now, output, lagged


def alarms(r: Result, z: Array, model: Model, blocks: list[list[int]], dt: Array, q: OutlierModes) -> Result:
    """Of the results of `gpb` for z (T,m): whether blocks are faulty, since when (s), and by how much.

    Keys: probability (T,B), duration (T,B), offset (T,m).
    """
    probability, duration = np.zeros(r["outlier"].shape), np.zeros(r["outlier"].shape)
    offset = np.zeros(z.shape)
    for b in range(len(blocks)):
        found, last, began = 0.0, -math.inf, None
        for k, now in enumerate(np.cumsum(dt)):
            if not np.isnan(z[k]).all():
                found, last = r["outlier"][k, b], now
            transition = np.eye(2) if q.durations is None else q.over(now - last)
            probability[k, b] = np.array([1 - found, found]) @ transition[:, 1]
            if probability[k, b] <= 0.5:
                began = None
            elif began is None:
                began = now
            duration[k, b] = 0.0 if began is None else now - began
    for k in range(len(z)):
        measured = present(z[k])
        angles = np.asarray(model.angles, dtype=bool)[measured]
        offset[k, measured] = difference(z[k][measured], model.h(r["mean"][k], k)[measured], angles)
    return {"probability": probability, "duration": duration, "offset": offset}


def gpb(
    z: Array, mean0: Array, P0: Array, motions: list[Propagate], model: Model, regimes: Regimes, modes: OutlierModes,
    prior_outlier: float, prior_inflation: float, position: slice = slice(0, 2),
) -> Result:  # fmt: skip
    """One track z (T,m), NaN missing; of the model only sensor and noise are used.

    Keys: mean (T,n), P (T,n,n), lagged_mean, lagged_P (of the last step as filtered), regimes (T,R), outlier (T,B),
    log_likelihood (T,) of the mixture, nis (T,) of the Gaussian with the moments of all predictions; noise (T,B), the
    learned scale of its variance.
    """
    c = start(np.array(mean0, dtype=float), np.array(P0, dtype=float), regimes, modes, prior_outlier, prior_inflation)
    steps, lagged = [], []
    for k in range(len(z)):
        c, output, before = step(c, z[k], motions, model, regimes, modes, position, k)
        steps.append(output)
        lagged.append(before)
    lagged = [*lagged[1:], (steps[-1]["mean"], steps[-1]["P"])]
    smoothed = {"lagged_mean": np.array([x for x, _ in lagged]), "lagged_P": np.array([P for _, P in lagged])}
    return collect(steps) | smoothed

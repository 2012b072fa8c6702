"""Joint probabilistic data association: several targets, scans of measurements that do not say whose they are."""

from __future__ import annotations

import copy
import math
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.adaptive.noise import NoiseMemory
from torchfra.association.clusters import Association
from torchfra.association.clutter import Clutter
from torchfra.association.events import check_exact
from torchfra.association.gates import Candidates, Gate
from torchfra.association.joint import associate
from torchfra.filters.base import Filter, Mix, Record, check_lengths, stack
from torchfra.filters.scans import column, combined, first, flat, gated, likeliest
from torchfra.filters.soft import Soft
from torchfra.filters.srckf import SRCKF, State
from torchfra.gaussian.inputs import Frame, Time, batch_rank, check, make_frames
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.model import compare, count_repaired, predict
from torchfra.gaussian.update import correct, density, innovation, repaired_root
from torchfra.hyper import Hyper, Value, hypers
from torchfra.kernel.build import CompileError
from torchfra.types import Estimate, Gaussian, Innovation, Prediction, Whitened

_SEARCH = 5.0
"""Times that the covariance of a track that seems lost quadruples."""


class JPDAState(NamedTuple):
    """What is known of the targets after a scan."""

    inner: State
    """Of the filters, ``(..., N)``."""
    missed: Tensor
    """``(..., N)`` expected number of scans since each was measured last."""
    searched: Tensor
    """``(..., N)`` how often the covariance of each has been quadrupled for that."""

    @property
    def belief(self) -> Gaussian:
        """``(..., N)``."""
        return self.inner.belief


class JPDAInfo(NamedTuple):
    """Per step and target."""

    association: Tensor
    """``(..., N, T, J + 1)`` probabilities: that the target was missed, and that each measurement is its own."""
    fading: Tensor | None
    """``(..., N, T)`` fading factors, if the inner filter has them."""
    noise: Tensor | None
    """``(..., N, T, m)`` estimated variances of the measurement noise, as multiples of the nominal ones; or None."""
    weights: Tensor | None
    """``(..., N, T, J, m)`` of a robust inner filter: how far it would trust each measurement."""
    repaired: Tensor | None
    """``(..., N, T)`` covariances that were not positive and had to be mended; of rules with negative weights."""


class JPDA(Soft, Filter):
    """Joint probabilistic data association around a Gaussian filter.

    Each target's update is the Gaussian with the moments of all that may have happened: that it was missed, or that any
    one of the measurements in its gate is its own.

    Measurements come as scans: ``z (..., T, J, m)`` of J measurements at most, in any order; a row of NaN is none.
    Targets are the last dimension of the batch: priors are ``(..., N, n)``, estimates ``(..., N, T, n)``.  A
    measurement of which only some elements are NaN is one of the others.

    Args:
        inner: an ``SRCKF``, plain, robust, with fading factors or an estimate of the noise, which learn from the
            combined innovation; copies of it, gate and clutter run here.
            Hyperparameters may differ between targets, ``(N,)``, and between scenes, ``(B, 1)`` or ``(B, N)``.
        gate: which measurements may be a target's (``torchfra.clutter``).
        clutter: how dense false ones are.
        detection: probability that a target is measured, up to 1.
        lost: a track that has been missed so often in a row that chance has at most this probability must have followed
            something false: its covariance then quadruples with every further miss, five times at most, until it is
            measured again.  0 for tracks that are never taken for lost.
        share_noise: whether all targets share their estimates of the noise, averaged by how probably each was measured.
        exact: targets and measurements of a cluster up to which all joint events are summed; see ``association``.
        temperature: 0 for gates with a hard edge; above, the width of the edge as a share of the gate, through which
            gradients reach its size.

    ``Estimate.log_likelihood`` is the log density of a scan against one of false measurements alone, shared out among
    the targets of a cluster: its sum over targets is what ``losses.innovation_nll`` makes large.  ``nis`` is that of
    the combined innovation, as ``step`` gives it.

    Raises:
        ValueError: another filter than that, a sensor that gate or clutter cannot work with, a value out of its range.

    Source: Fortmann, Bar-Shalom & Scheffe (1983); Chen, Zou & Wu, eqs. (25)-(30), and (19) with the innovations
    weighted by their probabilities, which is our reading.
    """

    def __init__(
        self,
        inner: Filter,
        *,
        gate: Gate,
        clutter: Clutter,
        detection: Value = 0.95,
        lost: float = 0.0,
        share_noise: bool = False,
        exact: tuple[int, int] = (4, 10),
        temperature: float = 0.0,
    ) -> None:
        nn.Module.__init__(self)
        if not isinstance(inner, SRCKF) or inner.motion.stacked:
            said = f"{type(inner).__name__} of {inner.motion.describe()}"
            raise ValueError(f"inner: expected an SRCKF of one motion, received {said}")
        if share_noise and inner.noise is None:
            raise ValueError(
                "share_noise: expected an inner filter that estimates the noise, received one that does not"
            )
        self._compiled = None
        self.inner, self.gate, self.clutter = copy.deepcopy((inner, gate, clutter))
        self.detection = Hyper(detection, constraints.interval(0.0, 1.0), name="detection")
        if not bool((torch.as_tensor(detection) > 0).all()):
            raise ValueError(f"detection: expected a probability above 0, received {detection}")
        check_exact(exact)
        clutter.check(inner.sensor)
        gate.check(inner.sensor)
        if not 0 <= lost < 1:
            raise ValueError(f"lost: expected a probability of 0 or more and below 1, received {lost}")
        self.share_noise, self.exact, self.lost = share_noise, exact, lost
        self.temperature = temperature
        for hyper in self.modules():
            if isinstance(hyper, Hyper):
                hyper.shared = 1  # all measurements share the values of their target

    @property
    def motion(self) -> Any:  # type: ignore[override]
        """Of the inner filter."""
        return self.inner.motion

    @property
    def sensor(self) -> Any:  # type: ignore[override]
        """Of the inner filter."""
        return self.inner.sensor

    def compile(self) -> Any:
        """There are no kernels for this.

        Raises:
            CompileError: always; see ``Filter``.
        """
        raise CompileError("JPDA: a scan has too many joint events for a kernel; it runs eagerly, in batches")

    def begin(self, belief: Gaussian) -> JPDAState:
        """See ``Filter``."""
        nothing = torch.zeros_like(belief.mean[..., 0])
        return JPDAState(self.inner.begin(belief), nothing, nothing)

    def advance(self, state: JPDAState, frame: Frame, mix: Mix | None = None) -> tuple[JPDAState, Record]:
        """See ``Filter``; frames are of measurements ``(..., 1, J)``, innovations in the measurement's own units."""
        f, memory = self.inner, state.inner.memory
        prediction = predict(f.motion, f.motion_rule, column(state.belief), frame)
        prediction, searched = self._searching(prediction, state)
        whitened = compare(f.sensor, f.sensor_rule, prediction.belief, frame)
        known, size = self._known(whitened, memory, frame)
        root, normalised = innovation(known)
        candidates = self._candidates(prediction.belief, whitened, normalised, frame)
        found = self.decide(
            candidates, density(size * root, normalised) + frame.measurement_noise.log_norm
        )  # eqs. (25)-(27)
        repaired = _repaired(prediction, whitened)
        memory = self._adapted("innovation", memory, whitened, found, frame)  # eq. (19)
        known, _ = self._known(whitened, memory, frame)
        prediction, known, memory, factor = self._faded(prediction, known, memory, candidates, found, frame)
        belief, weights = self._updated(prediction.belief, known, candidates, found, frame)  # eqs. (28)-(30)
        left = compare(f.sensor, f.sensor_rule, column(belief), frame) if self._by_residual else whitened
        memory = self._adapted("residual", memory, left, found, frame)
        noise = memory.scale if isinstance(memory, NoiseMemory) else None
        info = JPDAInfo(found.log_weights.exp(), factor, noise, weights, repaired)
        seen = combined(found.share, whitened.residual, size * root, normalised, frame.measurement_noise)
        missed = self._missed(state.missed, found, frame)
        return JPDAState(State(belief, memory), missed, searched), Record(belief, *seen, info, found.evidence)

    def decide(self, candidates: Candidates, fit: Tensor) -> Association:
        """Which measurement is whose, by log densities ``fit (..., N, J)``: eqs. (25)-(27)."""
        odds = self.detection(fit).log() - self.clutter(candidates, self.sensor)
        measured = candidates.seen.sum(-1) > 0
        inside = torch.where(measured, self.gate(candidates, self.sensor, self.temperature), -torch.inf)
        diffuse = self.clutter.rate is None
        ratio = torch.where(inside > -torch.inf, fit + odds + inside, -torch.inf)
        return associate(ratio, self._log_miss(fit), diffuse=diffuse, inside=inside, exact=self.exact)

    def _updated(
        self, predicted: Gaussian, known: Whitened, candidates: Candidates, found: Association, frame: Frame
    ) -> tuple[Gaussian, Tensor | None]:
        """The Gaussian with the moments of all that may have happened, and the weights of a robust filter."""
        robust, log_weights, weights = self.inner.robust, found.log_weights, None
        if robust is None:
            log_weights, known = gated(log_weights, known)
            each, _, _ = correct(predicted, known)
        else:
            weights = robust(known.residual, candidates.nis)
            each = robust.correct(predicted, known, weights, frame.measurement_noise).belief
        belief = moment_match(first(predicted, each), log_weights.movedim(-1, 0))
        return belief._replace(mean=self.motion.canonical(belief.mean)), weights

    def step(
        self,
        state: JPDAState,
        z: Tensor,
        *,
        dt: Time = 1.0,
        u: Tensor | None = None,
        std: Tensor | None = None,
        noise: Tensor | None = None,
    ) -> tuple[JPDAState, Innovation]:
        """One scan, for streaming.

        Args:
            state: from ``init`` or the step before; it is not changed.
            z: ``(..., J, m)``; NaN is missing, and a row of NaN is no measurement.
            dt: seconds since the last step, a number or ``(...)``.
            u: ``(..., k)`` what the models need to know.
            std: ``(..., J, m)`` standard deviations of these measurements, instead of the sensor's.
            noise: ``(..., J, m, m)`` roots of their covariances, instead of the sensor's.

        Returns:
            The next state, and the combined innovation of each target, ``(..., N, m)``: weighted by the probabilities
            of association, with the covariance of a single one.

        Raises:
            ValueError: a shape or a value that does not fit.
        """
        dt = dt.unsqueeze(-1) if isinstance(dt, Tensor) and dt.dim() else dt
        u, std, noise = (x if x is None else x.unsqueeze(e) for x, e in ((u, -2), (std, -3), (noise, -4)))
        batch, (frame,) = self._frames(z.unsqueeze(-3), state.belief, dt, u, std, noise)
        held = tuple(state.belief.mean.shape[:-2])
        if batch != held:
            raise ValueError(f"state: expected one from a prior of batch {tuple(batch)}, this is of {held}")
        state, record = self.advance(state, frame)
        nis = record.normalised.square().sum(-1)
        assert record.density is not None
        return state, Innovation(record.residual, record.root, nis, record.density)

    def forward(
        self,
        z: Tensor,
        prior: Gaussian,
        *,
        dt: Time = 1.0,
        u: Tensor | None = None,
        std: Tensor | None = None,
        noise: Tensor | None = None,
        truncate: int | None = None,
        checkpoint: int | None = None,
    ) -> Estimate:
        """Whole sequences of scans.

        Args:
            z: ``(..., T, J, m)`` measurements; NaN is missing, and a row of NaN is no measurement.
            prior: beliefs one ``dt`` before the first scan: ``mean (..., N, n)`` and any root ``(..., N, n, n)``.
            dt: see ``Filter``.
            u: ``(..., T, k)`` or ``(T, k)``.
            std: ``(..., T, J, m)`` standard deviations of the measurements, instead of the sensor's.
            noise: ``(..., T, J, m, m)`` roots of their covariances, instead of the sensor's.
            truncate: see ``Filter``.
            checkpoint: see ``Filter``.

        Returns:
            Estimates of the targets, ``(..., N, T, ...)``.

        Raises:
            ValueError: a shape or a value that does not fit.
        """
        check_lengths(truncate=truncate, checkpoint=checkpoint)
        batch, frames = self._frames(z, prior, dt, u, std, noise)
        (targets, n), rank = prior.mean.shape[-2:], len(batch) + 1
        mean, root = (x.to(z) for x in prior)
        start = Gaussian(mean.expand(*batch, targets, n), root.expand(*batch, targets, n, n))
        _, records = self._filter(self.init(start), frames, checkpoint, truncate)
        names = ("belief", "normalised", "info", "density")
        belief, normalised, info, evidence = (stack([getattr(r, name) for r in records], rank) for name in names)
        return Estimate(belief.mean, belief.scale_tril, normalised.square().sum(-1), evidence, info)

    def _rank(self) -> int:
        return max(batch_rank(self), 1)

    def _frames(
        self, z: Tensor, prior: Gaussian, dt: Time, u: Tensor | None, std: Tensor | None, noise: Tensor | None
    ) -> tuple[torch.Size, list[Frame]]:
        """The batch of scenes, and frames of measurements ``(..., 1, J)``; all is checked."""
        batch = check(self.motion, self.sensor, z, prior, dt, u, std, noise, scans=True)
        self._check_targets(prior.mean.shape[-2])
        batch = torch.Size((1,) * (self._rank() - 1 - len(batch))) + batch
        z = z.transpose(-3, -2).unsqueeze(-4)
        std = std if std is None else std.transpose(-3, -2).unsqueeze(-4)
        noise = noise if noise is None else noise.transpose(-4, -3).unsqueeze(-5)
        dt = dt.unsqueeze(-2).unsqueeze(-2) if isinstance(dt, Tensor) and dt.dim() > 1 else dt
        u = u.unsqueeze(-3).unsqueeze(-3) if u is not None and u.dim() > 2 else u
        frames, _ = make_frames(self.motion, self.sensor, z, dt, u, std, noise, len(batch) + 2)
        return batch, frames

    def _check_targets(self, count: int) -> None:
        for path, hyper in hypers(self).items():
            if hyper.batch_rank and hyper.raw.shape[-1 - hyper.event] not in (1, count):
                shape = tuple(hyper.raw.shape)
                raise ValueError(
                    f"{path}: expected a value for each of {count} targets or one for all, received {shape}"
                )

    def _known(self, whitened: Whitened, memory: Any, frame: Frame) -> tuple[Whitened, Tensor]:
        """The measurements in units of the noise as each target knows it, and those units."""
        if self.inner.noise is None:
            return whitened, whitened.residual.new_ones(())
        return self.inner.noise.known(whitened, column(memory), frame.seen)

    @property
    def _by_residual(self) -> bool:
        return self.inner.noise is not None and self.inner.noise.adapt == "residual"

    def _adapted(self, when: str, memory: Any, whitened: Whitened, found: Association, frame: Frame) -> Any:
        """What is known of the noise after innovations, if this is ``when`` it adapts."""
        side = self.inner.noise
        if side is None or side.adapt != when:
            return memory
        excess, whole = _mean(side.excess(whitened), found, frame)
        after = flat(side(column(memory), excess, whole))
        return _pooled(after, found.share.sum(-1, keepdim=True)) if self.share_noise else after

    def _faded(
        self, prediction: Prediction, whitened: Whitened, memory: Any, candidates: Candidates, found: Association,
        frame: Frame,
    ) -> tuple[Prediction, Whitened, Any, Tensor | None]:  # fmt: skip
        """Prediction and measurements with fading factors, the innovations remembered, and the factors."""
        f, fading, robust = self.inner, self.inner.adaptive, self.inner.robust
        if fading is None:
            return prediction, whitened, memory, None
        residual, whole = _mean(whitened.residual, found, frame)
        memory = fading.remember(column(memory), residual, (whole >= 0.5).to(residual))
        own = likeliest(found.share, whitened)
        nis = candidates.nis.gather(-1, found.share.argmax(-1, keepdim=True))
        weights = torch.ones_like(own.residual) if robust is None else robust(own.residual, nis)
        factor = fading(prediction, own, memory, weights)
        factor = torch.where(whole.amax(-1) >= 0.5, factor, 1.0)  # nothing was measured that could ask for it
        prediction = fading.inflate(prediction, factor)
        whitened = compare(f.sensor, f.sensor_rule, prediction.belief, frame)
        return prediction, whitened, flat(memory), factor.squeeze(-1)

    def _log_miss(self, like: Tensor) -> Tensor:
        """Log of the probability that a target has no measurement in its gate: a number or ``(..., N)``."""
        chance, inside = self.detection(like), self.gate.inside()
        chance = chance if inside is None else chance * inside.to(like)
        some = chance < 1 - 4 * torch.finfo(chance.dtype).eps
        miss = torch.where(some, torch.log1p(-torch.where(some, chance, 0.0)), -torch.inf)
        return miss.squeeze(-1) if miss.dim() else miss

    def _missed(self, before: Tensor, found: Association, frame: Frame) -> Tensor:
        """Scans since the last measurement; a scan without any says nothing."""
        some = (frame.seen.sum((-2, -1)) > 0).expand(before.shape)
        return torch.where(some, found.log_weights[..., 0].exp() * (before + 1), before)

    def _searching(self, prediction: Prediction, state: JPDAState) -> tuple[Prediction, Tensor]:
        """A prediction as wide as it must be where the track seems lost, and how often it has been widened."""
        if self.lost == 0:
            return prediction, state.searched
        patience = math.log(self.lost) / self._log_miss(state.missed)
        wanted = (state.missed - patience).clamp(0.0, _SEARCH)
        times = (2.0 ** (wanted - state.searched).clamp_min(0.0))[..., None, None, None]  # of the root
        (mean, root), spread, noise, repaired = prediction
        return Prediction(Gaussian(mean, times * root), times * spread, times * noise, repaired), wanted

    def _candidates(self, belief: Gaussian, whitened: Whitened, normalised: Tensor, frame: Frame) -> Candidates:
        seen = frame.seen > 0
        gap = frame.measurement_noise.colour(whitened.residual.unsqueeze(-1)).squeeze(-1)
        there = self.sensor(belief.mean, frame.u)
        predicted = torch.where(seen, frame.z - gap, there)
        z = torch.where(seen, frame.z, there)
        return Candidates(z, predicted, frame.seen, normalised.square().sum(-1))


def _mean(of: Tensor, found: Association, frame: Frame) -> tuple[Tensor, Tensor]:
    """Mean ``(..., N, 1, m)`` of each measurement's ``(..., N, J, m)`` by its probability, and the sum of those.

    0 where it was hardly anything: nothing is learned from it then.
    """
    weight = found.share.unsqueeze(-1) * frame.seen
    whole = weight.sum(-2, keepdim=True)
    likely = whole >= 0.5
    mean = torch.where(likely, (weight * of).sum(-2, keepdim=True), 0.0) / torch.where(likely, whole, 1.0)
    return mean, whole


def _pooled(noise: NoiseMemory, measured: Tensor) -> NoiseMemory:
    """One estimate for all targets: the mean, weighted by how probably each was ``measured (..., N, 1)``."""
    known = measured.sum(-2, keepdim=True)
    enough = known >= 0.5
    mean = (measured * noise.scale).sum(-2, keepdim=True) / torch.where(enough, known, 1.0)
    return noise._replace(scale=torch.where(enough, mean, noise.scale))


def _repaired(prediction: Prediction, whitened: Whitened) -> Tensor | None:
    """How many covariances of a target had to be mended; None for rules that never need it."""
    measured = None if whitened.lost is None else repaired_root(whitened)[1].any(-1)
    found = None if prediction.repaired is None else prediction.repaired.squeeze(-1)
    return count_repaired(found, measured)

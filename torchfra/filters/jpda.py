"""Joint probabilistic data association: several targets, scans of measurements that do not say whose they are."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.adaptive.fading import Memory
from torchfra.association.clusters import Association
from torchfra.association.clutter import Clutter
from torchfra.association.events import check_exact
from torchfra.association.gates import Candidates, Gate
from torchfra.association.joint import associate
from torchfra.filters.base import Filter, Mix
from torchfra.filters.hypotheses import (
    Scan,
    combined,
    gated,
    likeliest,
    missed_or_measured,
    target_repairs,
    weighted_mean,
)
from torchfra.filters.lost_tracks import log_miss, missed_scans, search
from torchfra.filters.records import Record
from torchfra.filters.scans import ScanFilter
from torchfra.filters.soft import Soft
from torchfra.filters.srckf import SRCKF, State
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.update import density, innovation
from torchfra.hyper import Hyper, Value, hypers
from torchfra.linalg.safe import safe_divide
from torchfra.types import Gaussian, Prediction, Whitened


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
    """``(..., N, T, J, m)`` of a robust inner filter: by which it would divide the noise of each measurement."""
    repaired: Tensor | None
    """``(..., N, T)`` covariances that were not positive definite and were repaired; of rules with negative
    weights."""


class JPDA(Soft, ScanFilter):
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
        gate: which measurements may be a target's (``torchfra.association.Gate``).
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
        super().__init__()
        if not isinstance(inner, SRCKF) or inner.motion.stacked:
            received = f"{type(inner).__name__} of {inner.motion.describe()}"
            raise ValueError(f"inner: expected an SRCKF of one motion, received {received}")
        if share_noise and inner.noise.adapt == "never":
            raise ValueError(
                "share_noise: expected an inner filter that estimates the noise, received one that does not"
            )
        check_exact(exact)
        clutter.check(inner.sensor)
        gate.check(inner.sensor)
        if not 0 <= lost < 1:
            raise ValueError(f"lost: expected a probability of 0 or more and below 1, received {lost}")
        self.inner, self.gate, self.clutter = copy.deepcopy((inner, gate, clutter))
        self.detection = Hyper(detection, constraints.interval(0.0, 1.0), name="detection")
        if not bool((torch.as_tensor(detection) > 0).all()):
            raise ValueError(f"detection: expected a probability above 0, received {detection}")
        self.share_noise, self.exact, self.lost = share_noise, exact, lost
        self.temperature = temperature
        for hyper in hypers(self).values():
            hyper.shared_dims = 1  # all measurements share the values of their target

    @property
    def motion(self) -> Any:  # type: ignore[override]
        """Of the inner filter."""
        return self.inner.motion

    @property
    def sensor(self) -> Any:  # type: ignore[override]
        """Of the inner filter."""
        return self.inner.sensor

    def begin(self, belief: Gaussian) -> JPDAState:
        """The state of beliefs: no target missed yet."""
        nothing = torch.zeros_like(belief.mean[..., 0])
        return JPDAState(self.inner.begin(belief), nothing, nothing)

    def advance(self, state: JPDAState, frame: Frame, mix: Mix | None = None) -> tuple[JPDAState, Record]:
        """One scan; equation numbers of Chen, Zou & Wu.  ``mix`` is not looked at."""
        f, (belief, fading, noise) = self.inner, tree.insert_batch_dimension(state.inner)
        miss = log_miss(self.detection, self.gate, state.missed)
        prediction, searched = search(f.predicted(belief, frame), state.missed, state.searched, miss, self.lost)
        scan = self.look(prediction.belief, noise, frame)
        association = self.associate(scan, miss)  # (25)-(27)
        noise = self.learn_noise(noise, scan.whitened, association, frame, "innovation")  # (19)
        known = f.noise.known(scan.whitened, noise, frame.seen)
        widened, known, fading, factor = self.widen(prediction, known, fading, scan, association, frame)
        belief, weights = self.update(widened.belief, known, scan, association, frame)  # (28)-(30)
        if f.noise.adapt == "residual":
            noise = self.learn_noise(
                noise, f.compare(tree.insert_batch_dimension(belief), frame), association, frame, "residual"
            )
        inner = State(belief, *tree.remove_batch_dimension((fading, noise)))
        missed, repaired = (
            missed_scans(state.missed, association, frame.seen),
            target_repairs(prediction, scan.whitened),
        )
        info = JPDAInfo(association.log_weights.exp(), factor, f.noise.scale(inner.noise), weights, repaired)
        innovation = combined(association.probabilities, scan.whitened.residual, scan.root, scan.normalised, frame)
        record = Record(belief, *innovation, info, association.evidence, past=searched)
        return JPDAState(inner, missed, searched), record

    def look(self, belief: Gaussian, noise: Any, frame: Frame) -> Scan:
        """The measurements of a scan against the prediction of each target."""
        whitened = self.inner.compare(belief, frame)
        root, normalised = innovation(self.inner.noise.known(whitened, noise, frame.seen))
        root = self.inner.noise.nominal(root, noise, frame.seen)
        seen, unit = frame.seen > 0, frame.measurement_noise
        gap = unit.colour(whitened.residual.unsqueeze(-1)).squeeze(-1)
        expected = self.sensor.at_points(belief.mean, frame.u)
        predicted = torch.where(seen, frame.z - gap, expected)
        z = torch.where(seen, frame.z, expected)
        candidates = Candidates(z, predicted, frame.seen, normalised.square().sum(-1))
        return Scan(whitened, root, normalised, candidates, density(root, normalised) + unit.log_norm)

    def associate(self, scan: Scan, miss: Tensor) -> Association:
        """Which measurement is whose: eqs. (25)-(27)."""
        candidates, fit = scan.candidates, scan.log_density
        odds = self.detection(fit).log() - self.clutter(candidates, self.sensor)
        measured = candidates.seen.sum(-1) > 0
        inside = torch.where(measured, self.gate(candidates, self.sensor, self.temperature), -torch.inf)
        ratio = torch.where(inside > -torch.inf, fit + odds + inside, -torch.inf)
        return associate(
            ratio, miss.to(fit), diffuse=self.clutter.rate is None, log_membership=inside, exact=self.exact
        )

    def learn_noise(self, memory: Any, whitened: Whitened, association: Association, frame: Frame, when: str) -> Any:
        """The memory of the measurement noise after a scan, if ``when`` is when the inner filter learns: eq. (19)."""
        side, share = self.inner.noise, association.probabilities
        if side.adapt != when:
            return memory
        memory = side(memory, *weighted_mean(side.excess(whitened), share, frame.seen))
        if not self.share_noise:
            return memory
        measured = share.sum(-1)[..., None, None]  # how probably each target was
        total = measured.sum(-3, keepdim=True)
        mean = safe_divide((measured * memory.scale).sum(-3, keepdim=True), total)
        return memory._replace(scale=torch.where(total >= 0.5, mean, memory.scale))

    def widen(
        self, prediction: Prediction, known: Whitened, memory: Memory | None, scan: Scan, association: Association,
        frame: Frame,
    ) -> tuple[Prediction, Whitened, Memory | None, Tensor | None]:  # fmt: skip
        """Prediction and measurements with fading factors, the innovations remembered, and the factors ``(..., N)``."""
        if memory is None:
            return prediction, known, None, None
        f, share = self.inner, association.probabilities
        residual, total = weighted_mean(known.residual, share, frame.seen)
        memory = f.fading.remember(memory, residual, (total >= 0.5).to(residual))
        nearest = likeliest(share, known)
        nis = scan.candidates.nis.gather(-1, share.argmax(-1, keepdim=True))
        factor = f.fading(prediction, nearest, memory, f.robust(nearest.residual, nis))
        factor = torch.where(total.amax(-1) >= 0.5, factor, 1.0)  # nothing was measured that could ask for it
        prediction = f.fading.inflate(prediction, factor)
        return prediction, f.compare(prediction.belief, frame), memory, factor.squeeze(-1)

    def update(
        self, predicted: Gaussian, known: Whitened, scan: Scan, association: Association, frame: Frame
    ) -> tuple[Gaussian, Tensor | None]:
        """The Gaussian with the moments of all that may have happened, and the weights of a robust filter."""
        robust, log_weights = self.inner.robust, association.log_weights
        if robust.plain:
            log_weights, known = gated(log_weights, known)
        weights = robust(known.residual, scan.candidates.nis)
        each = robust.correct(predicted, known, weights, frame.measurement_noise)
        belief = moment_match(missed_or_measured(predicted, each.belief), log_weights.movedim(-1, 0))
        return self.inner.canonical(belief), None if robust.plain else weights

"""Joint probabilistic data association: several targets, and scans of unassociated measurements."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.adaptive.noise import NoiseMemory, SageHusa
from torchfra.association.clusters import Association
from torchfra.association.clutter import Clutter
from torchfra.association.events import check_exact
from torchfra.association.gates import Candidates, Gate
from torchfra.association.joint import associate
from torchfra.filters.around import Around
from torchfra.filters.base import Filter
from torchfra.filters.scans.combined import combined, fade, learn_noise, update
from torchfra.filters.scans.lost_tracks import inflated, log_miss, log_unseen, lost_inflation, missed_scans
from torchfra.filters.scans.merging import check_merges
from torchfra.filters.scans.scan import (
    JPDAInfo,
    JPDAState,
    Scan,
    associate_uncertain,
    target_repairs,
)
from torchfra.filters.scans.separate import core, inflated_state, merge_hypotheses, step_measured, step_missed
from torchfra.filters.soft import Soft
from torchfra.filters.srckf import SRCKF, State
from torchfra.gaussian.inputs import BackwardStep, CompleteScans, Frame, Measurements, make_frames
from torchfra.gaussian.update import density, innovation
from torchfra.hyper import Hyper, Value
from torchfra.linalg.tracing import is_traced
from torchfra.numbers import as_number
from torchfra.sensors.base import Sensor
from torchfra.steps.records import Past, Record, Smoothed
from torchfra.steps.recursion import HasBelief, Limits, note_shared
from torchfra.types import Gaussian, Whitened

Associate = Callable[[Scan, Tensor], Association]
"""From the measurements of a scan and their log membership ``(..., N, J)`` of gates to the association."""


class ScanPast(NamedTuple):
    """The parts of a scan that the backward pass needs; ``(..., N, T, ...)`` for a whole sequence."""

    inner: Past
    """The past of the targets' filters."""
    inflations: Tensor
    """``(..., N)`` number of times that the covariance of a lost track has been quadrupled."""


class JPDA(Soft, Around[JPDAState]):
    """Joint probabilistic data association around a filter of one target.

    The update of each target is the Gaussian with the moments of its association hypotheses: that it was missed, or
    that one of the measurements in its gate is its own.  With an inner filter of several models or regimes, the
    likelihood of a measurement is that under all of them; each model then has such a Gaussian of its own, and its
    probability is summed over the hypotheses: only the merging is approximate.

    Measurements come in scans: ``z (..., T, J, m)`` of J measurements at most, in any order; a row of NaN is missing,
    and of a measurement with some NaN the other elements are used.  Targets are the last dimension of the batch: priors
    are ``(..., N, n)``, estimates ``(..., N, T, n)``.

    Args:
        inner: an ``SRCKF``, plain, robust, or with fading factors or a noise estimate, which use the combined
            innovation; an ``IMM`` of it without a noise estimate; or a ``GPB``, whose jumps and largest outliers scale
            with the measurement, so that a distant measurement has a somewhat larger likelihood than its density.
            Inner filter, gate and clutter are copied.  Hyperparameters may differ between targets, ``(N,)``, and
            between scenes, ``(B, 1)`` or ``(B, N)``.
        gate: which measurements may be a target's (``torchfra.association.Gate``), by the Gaussian with the moments of
            its prediction.
        clutter: density of false measurements.
        detection: probability of detection, up to 1.
        lost: largest probability that a track which is on its target misses so many scans in a row.  Below it a track
            is considered lost: its covariance quadruples with every further miss, five times at most, until it is
            measured again (with several models before the prediction, with one after it).  0 for never.
        exact: targets and measurements of a cluster up to which all joint events are summed; see ``association``.
        permutations: whether association counts all joint events.  False is JPDA*, for targets that stay beside one
            another, which does not compile: see ``association.associate``.
        temperature: 0 for gates with a hard edge; above, the width of the edge as a share of the gate, which gives the
            gate's size a gradient.

    ``Estimate.log_likelihood`` is the log density of a scan over that of false measurements alone, divided among the
    targets of a cluster: ``losses.innovation_nll`` maximises its sum over targets.  ``nis`` is that of the combined
    innovation, as in ``step``.

    Raises:
        ValueError: another inner filter, a sensor that gate or clutter cannot use, a value out of its range.

    Source: Fortmann, Bar-Shalom & Scheffe (1983); Chen, Zou & Wu, eqs. (25)-(30), and (19) with the innovations
    weighted by their probabilities, which is our reading; Chen & Tugnait (2001), "Tracking of Multiple Maneuvering
    Targets in Clutter Using IMM/JPDA Filtering and Fixed-Lag Smoothing", for several models; Blom & Bloem (2000),
    "Probabilistic Data Association Avoiding Track Coalescence", for JPDA*.
    """

    scans = True
    limits = Limits(other_sensors="gate and clutter are of the elements of one sensor")
    scanner: Sensor | None
    """The sensor, if it is another than that of the inner filter, as one of ``targets.Targets`` may be."""

    def __init__(
        self,
        inner: Filter,
        *,
        gate: Gate,
        clutter: Clutter,
        detection: Value = 0.95,
        lost: float = 0.0,
        exact: tuple[int, int] = (4, 10),
        permutations: bool = True,
        temperature: float = 0.0,
    ) -> None:
        check_merges(inner)
        check_exact(exact)
        clutter.check(inner.sensor)
        gate.check(inner.sensor)
        if not 0 <= as_number(lost) < 1:
            raise ValueError(f"lost: expected a probability of 0 or more and below 1, received {lost!r}")
        if lost and not getattr(inner, "redraw", True):
            raise ValueError(f"lost: expected 0 around a filter with redraw=False, received {lost!r}")
        inner, gate, clutter = copy.deepcopy((inner, gate, clutter))
        super().__init__(inner)
        self.gate, self.clutter = gate, clutter
        if not isinstance(inner, SRCKF):
            name = type(inner).__name__
            self.limits = self.limits._replace(
                smoothing=f"JPDA around {name}: the backward pass of {name} weighs its models by measurements that are "
                "known to be the target's; smooth a JPDA around an SRCKF"
            )
        self.scanner = None
        self.detection = Hyper(detection, constraints.interval(0.0, 1.0), name="detection")
        if not bool((torch.as_tensor(detection) > 0).all()):
            raise ValueError(f"detection: expected a probability above 0, received {detection}")
        if not isinstance(permutations, bool):
            raise ValueError(f"permutations: expected True or False, received {permutations!r}")
        self.exact, self.lost, self.permutations = exact, lost, permutations
        self.temperature = temperature
        note_shared(self)

    @property
    def sensor(self) -> Sensor:  # type: ignore[override]
        """What scans: the sensor of the inner filter, unless there is a ``scanner``."""
        return self.scanner or self.inner.sensor

    def begin(self, belief: Gaussian) -> JPDAState:
        """The state of beliefs: no target has been missed."""
        nothing, rank = torch.zeros_like(belief.mean[..., 0]), belief.mean.dim() - 1
        inner = self.inner.begin(tree.insert_batch_dimension(belief))
        return JPDAState(tree.map_tensors(lambda x: x.squeeze(rank), inner), nothing, nothing)

    def advance(
        self, state: JPDAState, frame: Frame, *, exists: Tensor | None = None, visible: Tensor | None = None,
        count_empty: bool = False,
    ) -> tuple[JPDAState, Record]:  # fmt: skip
        """One scan.

        Args:
            state: before the scan.
            frame: of the scan.
            exists: ``(..., N)`` probability that each target exists, before the scan; None if all do.  The next state
                and the association of each are conditional on its existence.
            visible: ``(..., N)`` probability that each target is visible to the sensor, if it exists; None if all are.
            count_empty: whether a scan without any measurement counts as missing all targets.
        """
        miss, factor, inflations = log_miss(self.detection, self.gate, state.missed), None, state.inflations
        if self.lost:
            factor, inflations = lost_inflation(state.missed, state.inflations, miss, self.lost)
        update_all = self.by_innovations if isinstance(self.inner, SRCKF) else self.by_states
        associate = partial(self.associate, miss=miss, exists=exists, visible=visible)
        inner, scan, association, info = update_all(state.inner, factor, associate, frame)
        innovation = combined(association.probabilities, scan.whitened.residual, scan.root, scan.normalised, frame)
        record = Record(inner.belief, *innovation, info, association.evidence, past=inflations)
        misses = missed_scans(state.missed, association, frame.measured, count_empty)
        return JPDAState(inner, misses, inflations), record

    def by_innovations(
        self, state: State, inflation: Tensor | None, associate: Associate, frame: Frame
    ) -> tuple[State, Scan, Association, JPDAInfo]:
        """A scan with an inner filter of one motion, by the combined innovation; equations of Chen, Zou & Wu.

        Args:
            state: of the inner filter.
            inflation: factor ``(..., N)`` on the root of the prediction; None for none.
            associate: computes the association.
            frame: of the scan.
        """
        f, (belief, fading, noise) = self.inner, tree.insert_batch_dimension(state)
        assert isinstance(f, SRCKF)
        if inflation is None:
            prediction, whitened = f.predict_and_compare(belief, frame)
        else:
            prediction = inflated(f.predicted(belief, frame), inflation)
            whitened = f.compare(prediction.belief, frame)
        scan = self.scan_of(prediction.belief, whitened, frame, f.noise, noise)
        repaired = target_repairs(prediction, scan.whitened)
        association = associate(scan, self.inside(scan))  # (25)-(27)
        learn = partial(learn_noise, f.noise, association=association, frame=frame)
        noise = learn(noise, scan.whitened, "innovation")  # (19)
        rescaled = scan.whitened if f.noise is None or noise is None else f.noise.rescale(scan.whitened, noise)
        prediction, rescaled, fading, factor = fade(f, prediction, rescaled, fading, scan, association, frame)
        belief, weights = update(f, prediction.belief, rescaled, scan, association, frame)  # (28)-(30)
        if f.noise is not None and f.noise.adapt == "residual":
            residual = f.compare(tree.insert_batch_dimension(belief), frame)
            noise = learn(noise, residual, "residual")
        inner = State(belief, *tree.remove_batch_dimension((fading, noise)))
        scale = None if f.noise is None or inner.noise is None else f.noise.scale(inner.noise)
        info = JPDAInfo(association.log_weights.exp(), factor, scale, weights, repaired)
        return inner, scan, association, info

    def by_states(
        self, state: HasBelief, inflation: Tensor | None, associate: Associate, frame: Frame
    ) -> tuple[HasBelief, Scan, Association, JPDAInfo]:
        """A scan with an inner filter of several models or regimes: a state for every measurement, then merged.

        Args:
            state: of the inner filter.
            inflation: factor ``(..., N)`` on the roots of the state; None for none.
            associate: computes the association.
            frame: of the scan.
        """
        f, state = self.inner, state if inflation is None else inflated_state(self.inner, state, inflation)
        none, record = step_missed(f, state, frame, self.sensor)
        whitened = core(f).compare(record.belief, frame)
        scan = self.scan_of(record.belief, whitened, frame)
        inside = self.inside(scan)
        each = step_measured(f, state, frame, inside > -torch.inf)
        scan = scan._replace(log_density=each.log_density)
        association = associate(scan, inside)
        inner, info = merge_hypotheses(f, none, each, association)
        return inner, scan, association, JPDAInfo(association.log_weights.exp(), inner=info)

    def scan_of(
        self, belief: Gaussian, whitened: Whitened, frame: Frame, estimate: SageHusa | None = None,
        noise: NoiseMemory | None = None,
    ) -> Scan:  # fmt: skip
        """The measurements of a scan beside the prediction ``belief (..., N, 1)`` of each target.

        Args:
            belief: predicted.
            whitened: the measurements, compared with it.
            frame: of the scan.
            estimate: of the noise; None without an estimate.
            noise: its memory.
        """
        if estimate is None or noise is None:
            root, normalised = innovation(whitened)
        else:
            root, normalised = innovation(estimate.rescale(whitened, noise))
            every = frame.measured if root.shape[-3] > 1 else torch.ones_like(frame.measured[..., :1, :])
            root = estimate.nominal(root, noise, every)
        measured, unit = frame.measured > 0, frame.measurement_noise
        gap = unit.colour(whitened.residual.unsqueeze(-1)).squeeze(-1)
        expected = self.sensor.at_points(belief.mean, frame.u)
        predicted = torch.where(measured, frame.z - gap, expected)
        z = torch.where(measured, frame.z, expected)
        candidates = Candidates(z, predicted, frame.measured, normalised.square().sum(-1))
        return Scan(whitened, root, normalised, candidates, density(root, normalised) + unit.log_norm)

    def inside(self, scan: Scan) -> Tensor:
        """Log membership ``(..., N, J)`` of measurements in gates; minus infinity outside and for missing ones."""
        candidates = scan.candidates
        measured = candidates.measured.sum(-1) > 0
        temperature = self.temperature if self.soft else 0.0
        return torch.where(measured, self.gate(candidates, self.sensor, temperature), -torch.inf)

    def associate(
        self, scan: Scan, inside: Tensor, miss: Tensor, exists: Tensor | None, visible: Tensor | None
    ) -> Association:
        """The association of targets and measurements: eqs. (25)-(27).

        Args:
            scan: the measurements.
            inside: log membership ``(..., N, J)`` of gates.
            miss: log of the probability that a visible target has no measurement in its gate.
            exists: see ``advance``.
            visible: see ``advance``.
        """
        candidates, fit = scan.candidates, scan.log_density
        if visible is not None:
            fit, miss = fit + visible.log().unsqueeze(-1), log_unseen(miss, visible)
        odds = self.detection(fit).log() - self.clutter(candidates, self.sensor)
        ratio = torch.where(inside > -torch.inf, fit + odds + inside, -torch.inf)
        solve = partial(
            associate, diffuse=self.clutter.rate is None, log_membership=inside, exact=self.exact,
            permutations=self.permutations,
        )  # fmt: skip
        miss = miss.to(fit)
        return solve(ratio, miss) if exists is None else associate_uncertain(exists, ratio, miss, solve)

    def finish(self, state: JPDAState, belief: Gaussian, info: JPDAInfo) -> tuple[Gaussian, JPDAInfo]:
        """The estimates of all scans, by ``finish`` of the inner filter."""
        if info.inner is None:
            return belief, info
        belief, inner = self.inner.finish(state.inner, belief, info.inner)
        return belief, info._replace(inner=inner)

    def past(self, belief: Gaussian, info: JPDAInfo, state: JPDAState, steps: Tensor) -> ScanPast:
        """The past of each target for the backward pass, which keeps the associations of the forward pass."""
        return ScanPast(self.inner.past(belief, info, None, None), steps)

    def last(self, past: ScanPast) -> tuple[Gaussian, Smoothed]:
        """Where the backward pass begins: the filtered beliefs after the last scan."""
        return self.inner.last(past.inner)

    def retreat(self, step: BackwardStep, after: Gaussian) -> tuple[Gaussian, Smoothed]:
        """One step of the backward pass, of each target by itself."""
        belief, factor = tree.insert_batch_dimension(step.past.inner.belief), step.next.inner.factor
        propagated = self.inner.propagate(belief, step.frame, None if factor is None else factor.unsqueeze(-1))
        times = 2 ** (step.next.inflations - step.past.inflations).clamp_min(0.0)[..., None, None, None]
        spread, noise = times * propagated.spread, times * propagated.process_noise
        subtracted = None if propagated.subtracted is None else times * propagated.subtracted
        propagated = propagated._replace(spread=spread, process_noise=noise, subtracted=subtracted)
        smoothed = self.inner.smooth_belief(belief, propagated, tree.insert_batch_dimension(after))
        repaired = None if smoothed.repaired is None else smoothed.repaired.squeeze(-1)
        smoothed = Smoothed(tree.remove_batch_dimension(smoothed.belief), repaired=repaired)
        return smoothed.belief, smoothed

    def _frames(self, measurements: Measurements, rank: int) -> tuple[list[Frame], Tensor]:
        """A frame of measurements ``(..., 1, J)`` for each step, and the log norms of the noise, time first."""
        z, dt, u, std, noise, _ = measurements
        z = z.transpose(-3, -2).unsqueeze(-4)
        std = std if std is None else std.transpose(-3, -2).unsqueeze(-4)
        noise = noise if noise is None else noise.transpose(-4, -3).unsqueeze(-5)
        dt = dt.unsqueeze(-2).unsqueeze(-2) if isinstance(dt, Tensor) and dt.dim() > 1 else dt
        u = u.unsqueeze(-3).unsqueeze(-3) if u is not None and u.dim() > 2 else u
        frames, log_norm = make_frames(Measurements(z, dt, u, std, noise), self.motion, self.sensor, rank + 1)
        if not self.complete(measurements):
            return frames, log_norm
        unit = self.sensor.measurement_noise(torch.zeros_like(frames[0].z[..., :1, :]))
        return [frame._replace(measurement_noise=unit) for frame in frames], log_norm

    def complete(self, measurements: Measurements) -> bool:
        """Whether each measurement is complete or missing and all have the same noise, so that they share one gain."""
        z, _, _, std, noise, _ = measurements
        if isinstance(measurements, CompleteScans):
            return True
        own = type(self.sensor).measurement_noise is not Sensor.measurement_noise
        if own or std is not None or noise is not None or is_traced(z):
            return False
        missing = z.isnan()
        return bool((missing == missing[..., :1]).all())

    def for_each_target(self, measurements: Measurements) -> Measurements:
        """Measurements for the backward pass, in which each target is a track: ``dt`` and ``u`` get its dimension."""
        dt, u = measurements.dt, measurements.u
        dt = dt.unsqueeze(-2) if isinstance(dt, Tensor) and dt.dim() > 1 else dt
        return measurements._replace(dt=dt, u=u.unsqueeze(-3) if u is not None and u.dim() > 2 else u)

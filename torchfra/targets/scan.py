"""All targets of all scenes against a scan: predicted, gated, split into clusters, and each cluster filtered."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchfra import tree
from torchfra.association.gates import Candidates, ChiSquare, Gate
from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.scans.lost_tracks import inflated, log_miss, lost_inflation
from torchfra.filters.scans.scan import JPDAState
from torchfra.filters.scans.separate import inflated_state, step_missed
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.inputs import Frame, Measurements
from torchfra.linalg.triangular import hstack, tria
from torchfra.sensors.base import Sensor
from torchfra.steps.engine import INTERPRETED
from torchfra.targets.assignment import chi_square
from torchfra.targets.clusters import Group, clusters
from torchfra.targets.state import rows
from torchfra.types import Gaussian

S = TypeVar("S", bound=Any)
_WIDER = 1.25
"""Factor by which the coarse gates are wider than the filter's own: they use the covariance of the predicted
measurement to first order only."""


class SceneScan(NamedTuple):
    """One scan of all scenes."""

    z: Tensor
    """``(R, J, m)``; NaN is missing."""
    dt: Tensor
    """``(R,)`` seconds since the last one."""
    u: Tensor | None
    """``(R, k)`` inputs."""
    std: Tensor | None = None
    """``(R, J, m)`` standard deviations of each measurement's noise, instead of the sensor's."""
    noise: Tensor | None = None
    """``(R, J, m, m)`` roots of its covariance, instead of the sensor's."""


def filter_scan(
    filter: JPDA,
    state: JPDAState,
    scene: Tensor,
    scan: SceneScan,
    exists: Tensor | None = None,
    visible: Tensor | None = None,
) -> tuple[JPDAState, Tensor, Tensor, Tensor, list[Group]]:
    """One step of all targets.

    Args:
        filter: of scans.
        state: its state, rows of ``(N, ...)``.
        scene: ``(N,)`` of each target.
        scan: the scan.
        exists: ``(N,)`` probability of each target, before the scan; None if all do.
        visible: ``(N,)`` probability that the sensor sees each if it exists, before the scan; None if it sees all.

    Returns:
        The next state; the log probability ``(N,)`` that each target was missed; each one's share ``(N,)`` of the log
        density of the scan against one of false measurements alone; the probability ``(N, J)`` that each measurement of
        its scene belongs to each target; and the clusters that share measurements.  For a target that may not exist all
        but the density are conditional on its existence.
    """
    count = scan.z.shape[1]
    association = scan.z.new_zeros(len(scene), count)
    if len(scene) == 0:
        return state, scan.z.new_zeros(0), scan.z.new_zeros(0), association, []
    with torch.no_grad():
        groups = clusters(_reach(filter, state, scene, scan), scene)
    tables = _tables(scan)
    everyone = UncertainTargets(state, exists, visible)
    parts, missed, density = [], [], []
    for targets, measurements in groups:
        measured = _measured(scene[targets[:, 0]], scan, *rows(tables, measurements))
        after, (chances, evidence) = step_scan(filter, update_targets, rows(everyone, targets), measured)
        target, number = targets.unsqueeze(-1), measurements.unsqueeze(-2)
        inside = (number >= 0).expand(*targets.shape, number.shape[-1])
        place = (target.expand_as(inside)[inside], number.expand_as(inside)[inside] % count)
        association = association.index_put(place, chances[..., 1:][inside])
        parts.append(tree.map_tensors(lambda x: x.flatten(0, 1), after))
        missed.append(chances[..., 0].log().flatten())
        density.append(evidence.flatten())
    order = torch.cat([group.targets.flatten() for group in groups]).argsort()
    everyone = tree.map_tensors(lambda *xs: torch.cat(xs)[order], *parts)
    return everyone.state, torch.cat(missed)[order], torch.cat(density)[order], association, groups


def _reach(filter: JPDA, state: JPDAState, scene: Tensor, scan: SceneScan) -> Tensor:
    """Measurements ``(N, J)`` of its scene that may be in the gate of each target, bool."""
    alone = tree.map_tensors(lambda x: x.unsqueeze(1), state)  # each target in a scene of its own
    anything = scan.z.new_zeros(len(scene), 1, filter.sensor.size)
    _, predicted = step_scan(
        filter, predict_measurements, alone, _measured(scene, scan, anything, _widest(scene, scan))
    )
    predicted = Gaussian(*(x.squeeze(1) for x in predicted))
    return _in_gates(filter.gate, filter.sensor, predicted, scan.z, scene, filter.temperature)


def _in_gates(gate: Gate, sensor: Sensor, predicted: Gaussian, scans: Tensor, scene: Tensor, heat: float) -> Tensor:
    """Measurements of its scene that may be in the gate of each target: ``(N, J)`` bool, False for missing ones.

    Args:
        gate: the gate of the filter.
        sensor: the sensor of the scan.
        predicted: measurements ``(N,)``, see ``predict_measurements``.
        scans: ``(R, J, m)``; NaN is missing.
        scene: ``(N,)`` number of each target's scene.
        heat: temperature of the gate.
    """
    z = scans.expand(len(scene), -1, -1) if len(scans) == 1 else scans[scene]
    measured, centre = ~scans.isnan(), predicted.mean.unsqueeze(-2)
    gap = sensor.difference(z, centre)
    kind = measured.to(torch.int64) @ (2 ** torch.arange(sensor.size, device=z.device))  # which elements, as bits
    kinds = [bits for bits in kind.unique().tolist() if bits]
    nis = torch.full_like(gap[..., 0], torch.inf)
    for bits in kinds:  # one, unless devices measure parts of it
        some = [i for i in range(sensor.size) if bits >> i & 1]
        root, part = predicted.scale_tril, gap
        if len(some) < sensor.size:
            root, part = tria(root[:, some]), gap[..., some]
        white = torch.linalg.solve_triangular(_WIDER * root, part.mT, upper=False)
        squared = torch.stack(white.unbind(-2)).square().sum(0)  # NaN, which no gate holds, where it is missing
        nis = squared if len(kinds) == 1 else torch.where((kind == bits)[scene], squared, nis)
    number = measured.sum(-1)
    if isinstance(gate, ChiSquare) and heat == 0:
        inside: Tensor = nis <= _quantiles(gate, z)[number][scene]
        return inside
    there = measured[scene]
    candidates = Candidates(torch.where(there, z, centre), centre.expand_as(z), there.to(z), nis)
    membership: Tensor = gate(candidates, sensor, heat)
    return (membership > -torch.inf) & (number > 0)[scene]


def _quantiles(gate: ChiSquare, like: Tensor) -> Tensor:
    """``(m + 1,)`` largest normalised innovation squared in the gate, by the number of measured elements."""
    probability = gate.probability(like).item()
    return like.new_tensor([-1.0, *(chi_square(probability, k) for k in range(1, like.shape[-1] + 1))])


def _measured(
    scene: Tensor, scan: SceneScan, z: Tensor, std: Tensor | None = None, noise: Tensor | None = None
) -> Measurements:
    """Measurements ``(C, J, m)`` of clusters in their scenes."""
    return Measurements(z, scan.dt[scene], None if scan.u is None else scan.u[scene], std, noise)


def _tables(scan: SceneScan) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Measurements ``(R J + 1, m)`` of all scenes, with a missing one at the end, and their noise."""
    (z, _, _, std, noise), size = scan, scan.z.shape[-1]
    std = None if std is None else torch.cat([std.flatten(0, 1), z.new_ones(1, size)])
    noise = None if noise is None else torch.cat([noise.flatten(0, 1), torch.eye(size).to(z).unsqueeze(0)])
    return torch.cat([z.flatten(0, 1), z.new_full((1, size), torch.nan)]), std, noise


def _widest(scene: Tensor, scan: SceneScan) -> Tensor | None:
    """Standard deviations ``(N, 1, m)``, each the largest among the measurements of a target's scene or above."""
    std, size = scan.std, scan.z.shape[-1]
    if scan.noise is not None:
        std = (size * scan.noise.square().sum(-1)).sqrt()  # no covariance exceeds m times its diagonal
    if std is None:
        return None
    some = torch.where(scan.z.isnan(), 0.0, std).amax(-2, keepdim=True) if scan.z.shape[-2] else std.new_zeros(())
    return torch.where(some > 0, some, 1.0).expand(len(scan.z), 1, size)[scene]


# ---------------------------------------------------------------- steps of the filter


class UncertainTargets(NamedTuple):
    """Targets that may not exist, or not be visible."""

    state: JPDAState
    """The state of targets that exist."""
    exists: Tensor | None
    """``(..., N)`` probability that each exists; None if all do."""
    visible: Tensor | None
    """``(..., N)`` probability that each is visible to the sensor, if it exists; None if all are."""

    @property
    def belief(self) -> Gaussian:
        """``(..., N)``."""
        return self.state.belief


def step_scan(
    f: JPDA, function: Callable[[JPDA, S, Frame], tuple[S, Any]], state: S, measurements: Measurements
) -> tuple[S, Any]:
    """Calls a ``function`` of this module on a checked scan ``z (C, J, m)``.

    Only an interpreted step can split a scan into clusters, so a scan that is too large to sum over all its joint
    events at once runs interpreted.
    """
    targets, count = state.belief.mean.shape[-2], measurements.z.shape[-2]
    small = targets == 1 or (targets <= f.exact[0] and count <= f.exact[1])
    return (f.engine if small else INTERPRETED).once(f, function, state, measurements)


def update_targets(f: JPDA, targets: UncertainTargets, frame: Frame) -> tuple[UncertainTargets, tuple[Tensor, Tensor]]:
    """The targets after a scan, the association ``(..., N, J + 1)`` and the log density ``(..., N)``: see ``JPDAInfo``.

    Each state and association is conditional on existence.  A scan without any measurement misses all targets.
    """
    before, exists, visible = targets
    state, record = f.advance(before, frame, exists=exists, visible=visible, count_empty=True)
    assert record.density is not None
    return targets._replace(state=state), (record.info.association, record.density)


def predict_measurements(f: JPDA, state: JPDAState, frame: Frame) -> tuple[JPDAState, Gaussian]:
    """The unchanged state, and the predicted measurement ``(..., N)`` of each target in the scan.

    Of the scan only its noise is used.
    """
    inner, learned, factor = state.inner, None, None
    if f.lost:
        miss = log_miss(f.detection, f.gate, state.missed)
        factor, _ = lost_inflation(state.missed, state.inflations, miss, f.lost)
    if isinstance(f.inner, SRCKF):
        before, _, noise = tree.insert_batch_dimension(inner)
        prediction = f.inner.predicted(before, frame)
        belief = (prediction if factor is None else inflated(prediction, factor)).belief
        learned = None if f.inner.noise is None else f.inner.noise.scale(noise)
    else:
        before = inner if factor is None else inflated_state(f.inner, inner, factor)
        belief = step_missed(f.inner, before, frame, f.sensor)[1].belief
    return state, tree.remove_batch_dimension(_measurement(f.sensor, belief, frame, learned))


def _measurement(sensor: Sensor, belief: Gaussian, frame: Frame, learned: Tensor | None) -> Gaussian:
    """The predicted measurement ``(..., m)`` of predictions ``(..., n)``, noise included, by third-degree cubature."""
    mean, root = belief
    n = mean.shape[-1]
    offsets = (n**0.5 * root).movedim(-1, 0)  # (n, ..., n)
    points = torch.cat([mean.unsqueeze(0), mean + offsets, mean - offsets])
    z = sensor.at_points(points, frame.u)
    spread = sensor.difference(z[1:], z[:1]).movedim(0, -1) / (2 * n) ** 0.5  # (..., m, 2n)
    scale = torch.ones_like(z[0]) if learned is None else learned
    return Gaussian(z[0], tria(hstack(spread, frame.measurement_noise.colour(scale.sqrt().diag_embed()))))

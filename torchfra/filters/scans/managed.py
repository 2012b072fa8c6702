"""Steps of a filter of scans for ``targets.Targets``: predicted measurements of a scan, and the update by it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.engine import INTERPRETED
from torchfra.filters.scans.jpda import JPDA
from torchfra.filters.scans.lost_tracks import inflated, log_miss, lost_inflation
from torchfra.filters.scans.scan import JPDAState
from torchfra.filters.scans.separate import inflated_state, step_missed
from torchfra.filters.srckf import SRCKF
from torchfra.gaussian.inputs import Frame, Measurements
from torchfra.linalg.triangular import hstack, tria
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian

S = TypeVar("S", bound=Any)


class UncertainTargets(NamedTuple):
    """Targets that may not exist."""

    state: JPDAState
    """The state of targets that exist."""
    exists: Tensor
    """``(..., N)`` probability that each exists."""
    visible: Tensor
    """``(..., N)`` probability that each is visible to the sensor, if it exists."""

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


def update_targets(f: JPDA, state: JPDAState, frame: Frame) -> tuple[JPDAState, tuple[Tensor, Tensor]]:
    """The state after a scan, the association ``(..., N, J + 1)`` and the log density ``(..., N)``: see ``JPDAInfo``.

    A scan without any measurement misses all targets.
    """
    return _advanced(f, state, frame, None, None)


def update_uncertain(
    f: JPDA, targets: UncertainTargets, frame: Frame
) -> tuple[UncertainTargets, tuple[Tensor, Tensor]]:
    """``update_targets`` for targets that may not exist: each state and association is conditional on existence."""
    state, result = _advanced(f, targets.state, frame, targets.exists, targets.visible)
    return targets._replace(state=state), result


def _advanced(
    f: JPDA, state: JPDAState, frame: Frame, exists: Tensor | None, visible: Tensor | None
) -> tuple[JPDAState, tuple[Tensor, Tensor]]:
    """One scan, in which a target that is not measured is missed, even if nothing is measured."""
    state, record = f.advance(state, frame, exists=exists, visible=visible, count_empty=True)
    assert record.density is not None
    return state, (record.info.association, record.density)


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
        learned = f.inner.noise.scale(noise)
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

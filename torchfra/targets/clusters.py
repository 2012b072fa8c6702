"""Targets that share measurements, in groups that a filter takes in one call."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchfra.targets.assignment import scipy

Numbers = NDArray[np.intp]


class Group(NamedTuple):
    """Clusters with the same number of targets, and about as many measurements."""

    targets: Tensor
    """``(C, k)`` rows of the targets."""
    measurements: Tensor
    """``(C, J)`` numbers of the measurements; -1 for none."""


class _Rows(NamedTuple):
    """Things in the order of their clusters."""

    number: Numbers
    start: Numbers
    """``(C,)`` where each cluster begins."""
    size: Numbers
    """``(C,)``."""


def clusters(reach: Tensor, scene: Tensor) -> list[Group]:
    """Clusters of targets that share measurements, directly or through others.

    Args:
        reach: ``(N, J)`` bool: which measurements of its scene each target may have.
        scene: ``(N,)`` of each target.

    Returns:
        Groups whose measurements are numbered ``scene * J + j``.

    Raises:
        ImportError: scipy is not installed.
    """
    target, j = (x.numpy(force=True) for x in reach.nonzero().unbind(-1))
    measurement = scene.numpy(force=True)[target] * reach.shape[-1] + j
    targets, used = _components(target, measurement, len(reach))
    # Few sizes of scans, so that there are few calls: powers of two.
    width = 2 ** np.ceil(np.log2(used.size.clip(1))).astype(np.intp)
    groups = []
    for k, J in np.unique(np.stack([targets.size, width]), axis=1).T:
        chosen = np.flatnonzero((targets.size == k) & (width == J))
        tables = (_table(x, chosen, size) for x, size in ((targets, k), (used, J)))
        groups.append(Group(*(torch.from_numpy(x).to(reach.device) for x in tables)))
    return groups


def _components(target: Numbers, measurement: Numbers, count: int) -> tuple[_Rows, _Rows]:
    """Targets and measurements in the order of the connected components of the graph of these pairs."""
    used, place = np.unique(measurement, return_inverse=True)
    sparse, size = scipy("sparse"), count + len(used)
    links = sparse.coo_matrix((np.ones(len(target)), (target, count + place)), (size, size))
    label = scipy("sparse.csgraph").connected_components(links, directed=False)[1]
    cluster, of_target = np.unique(label[:count], return_inverse=True)  # each measurement has a target
    return _ordered(np.arange(count), of_target, len(cluster)), _ordered(
        used, np.searchsorted(cluster, label[count:]), len(cluster)
    )


def _ordered(number: Numbers, cluster: Numbers, count: int) -> _Rows:
    size = np.bincount(cluster, minlength=count)
    return _Rows(number[np.argsort(cluster, kind="stable")], np.cumsum(size) - size, size)


def _table(members: _Rows, chosen: Numbers, width: int) -> Any:
    """The numbers ``(C, width)`` of these clusters; -1 where one has fewer."""
    place = np.arange(width)
    inside = place < members.size[chosen, None]
    at = np.where(inside, members.start[chosen, None] + place, 0)
    return np.where(inside, members.number[at] if len(members.number) else -1, -1)

"""From a filter and data to a loss that can be computed."""

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import Any, TypeVar

import torch

from torchfra import losses
from torchfra.filters import Filter
from torchfra.fitting.data import Batch, Source
from torchfra.fitting.objective import NEEDS_TRUTH, Objective, Own
from torchfra.fitting.vector import Vector
from torchfra.hyper import named, provide
from torchfra.scenarios.base import Scenario
from torchfra.types import CompileError

F = TypeVar("F", bound=Filter)


def copied(f: F, learn: Collection[str] | None) -> F:
    """A copy whose values of these names learn, and no others.

    Raises:
        ValueError: no filter, or names that are none.
    """
    if not isinstance(f, Filter):
        raise ValueError(f"filter: expected a filter, received {type(f).__name__}")
    if not isinstance(learn, Collection | None):
        raise ValueError(f"learn: expected names of hyperparameters, received {learn!r}")
    f = copy.deepcopy(f)
    if learn is not None:
        for parameter in f.parameters():
            parameter.requires_grad_(False)
        provide(f, learn)
        for path, hyper in named(f, learn).items():
            hyper.learn(path)
            hyper.raw.requires_grad_()
    return f


def objective_of(
    f: Filter, vector: Vector, data: Source, tracks: Batch, loss: str | Own | None, scale: float | None, skip: int
) -> Objective:
    """The loss of a fit.

    Args:
        f: the filter that learns.
        vector: of its values.
        data: that was given.
        tracks: that it came to.
        loss: by name, of one's own, or None for the robust error where there is a truth, else the likelihood.
        scale: of the robust loss; None for the median over tracks of the error at the start.
        skip: steps at the start of each track that do not count.

    Raises:
        ValueError: a loss that needs a truth where there is none, or a number out of its range.
    """
    kind = loss or ("likelihood" if tracks.truth is None else "robust")
    if isinstance(kind, str) and kind in NEEDS_TRUTH and tracks.truth is None:
        raise ValueError(f"loss: expected 'likelihood' or 'smoothed' for data without a truth, received {kind!r}")
    if not isinstance(skip, int) or not 0 <= skip < tracks.z.shape[1]:
        raise ValueError(f"skip: expected less than the {tracks.z.shape[1]} steps of the tracks, received {skip}")
    where = _coordinates(f, data)
    if kind == "robust" and scale is None:
        scale = _error(f, tracks, where)
    scale = 1.0 if scale is None else scale
    if not isinstance(scale, int | float) or not 0 < scale < float("inf"):
        raise ValueError(f"scale: expected a number above 0, received {scale!r}")
    return Objective(f, vector, kind, scale=scale, skip=skip, **where)


def _coordinates(f: Filter, data: Source) -> dict[str, Any]:
    """Which components count, and how estimates get into the coordinates of the truth."""
    if isinstance(data, Scenario):
        return {"states": data.truth_position, "convert": data.cartesian}
    return {"states": f.motion.position, "convert": None}


def _error(f: Filter, tracks: Batch, where: dict[str, Any]) -> float:
    """The median over tracks of the error at the start."""
    with torch.no_grad():
        estimate = f(tracks.z, tracks.belief(f), dt=tracks.dt, u=tracks.u)
        estimate = where["convert"](estimate) if where["convert"] else estimate
    assert tracks.truth is not None
    return float(losses.mse(estimate.mean, tracks.truth, where["states"]).nanmedian().sqrt())


def compiled(objective: Objective, tracks: Batch, wanted: bool | None) -> tuple[list[str], bool]:
    """Compiles the filter where it can be; what is to be said, and whether it runs as kernels."""
    if wanted is False or not (tracks.z.is_cpu or tracks.z.is_cuda):
        return [], False
    from torchfra.compiler.llvm import binding  # only where it is needed

    try:
        if tracks.z.is_cpu:
            binding()
        objective.compile()
        objective.gradients(objective.vector.raw()[None, None], tracks.rows(slice(1)))
    except (CompileError, NotImplementedError) as error:
        if wanted:
            raise
        objective.interpret()
        return [f"the filter runs interpreted: {' '.join(str(error).split())}"], False
    return [], True

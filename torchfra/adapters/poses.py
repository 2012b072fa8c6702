"""Poses of animals in xarray, in and out: ``position`` over time, space, keypoints and individuals, and ``confidence``.

So movement keeps what DeepLabCut, SLEAP and others have found in a video.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfra.adapters.points import noise_and_motion, smoothed
from torchfra.numbers import positive
from torchfra.running.optional import optional

xarray = optional("xarray", "torchfra.adapters.poses", "frames")


class Poses(NamedTuple):
    """The points of a data set as a filter takes them, ``B`` points of animals."""

    z: Tensor
    """``(B, T, d)``, NaN where missing or below the least confidence."""
    dt: Tensor
    """``(T,)`` s from frame to frame; of the first one the usual time."""
    factor: Tensor
    """``(B, T, 1)`` on the standard deviation of the noise: the usual confidence over that of the point."""
    order: tuple[str, ...]
    """Dimensions of ``position``: those of ``B``, then time and space."""


def measurements(dataset: Any, *, least: float = 0.6) -> Poses:
    """The points of a data set for a filter: ``f(poses.z, prior, dt=poses.dt, std=2.0 * poses.factor)``.

    Args:
        dataset: an ``xarray.Dataset`` with ``position`` over ``time``, ``space`` and any other dimensions, and perhaps
            ``confidence`` without ``space``.  Times are seconds or moments; if they are frames, so is the unit of time.
        least: confidence below which a point is missing, as movement and DeepLabCut take it.

    Raises:
        ValueError: no such data set, or fewer than two frames in order of time.
    """
    position = dataset.get("position") if isinstance(dataset, xarray.Dataset) else None
    if position is None or not {"time", "space"} <= {*position.dims}:
        expected = "an xarray.Dataset with position over time, space and perhaps others"
        received = type(dataset).__name__ if position is None else f"position over {', '.join(map(str, position.dims))}"
        raise ValueError(f"dataset: expected {expected}, received {received}")
    order = (*(name for name in position.dims if name not in ("time", "space")), "time", "space")
    time = position["time"].to_numpy()
    time = (time - time[:1]) / np.timedelta64(1, "s") if time.dtype.kind in "mM" else time
    dt = np.diff(time.astype(float))
    if len(dt) == 0 or not (dt > 0).all():
        raise ValueError(f"time: expected two frames or more in order of time, received {len(time)}")
    z = torch.from_numpy(position.transpose(*order).to_numpy().astype(float)).flatten(0, -3)
    factor = torch.ones_like(z[..., :1])
    if "confidence" in dataset:
        confidence = dataset["confidence"].broadcast_like(position.isel(space=0, drop=True)).transpose(*order[:-1])
        sure = torch.from_numpy(confidence.to_numpy().astype(float)).flatten(0, -2).unsqueeze(-1)
        z = torch.where(sure >= least, z, torch.nan)
        sure = torch.where(sure >= least, sure, torch.nan)
        factor = torch.where(sure > 0, sure.nanmedian(1, keepdim=True).values / sure, 1.0)
    return Poses(z, torch.from_numpy(np.concatenate([[np.median(dt)], dt])), factor, order)


def clean(
    dataset: Any, *, std: float | None = None, q: float | None = None, least: float = 0.6, smooth: bool = True,
    compile: bool = False,
) -> Any:  # fmt: skip
    """Cleans poses: each point of each animal is smoothed, its outliers are found, and gaps are bridged.

    Args:
        dataset: as of ``measurements``.
        std: standard deviation of the noise at the usual confidence, in units of ``position``; at others it is larger
            or smaller by the ratio.  None finds that of each point.
        q: density of the process noise, squares of these units per s^3.  None finds that of each point.
        least: confidence below which a point is missing.
        smooth: whether later frames count too.
        compile: whether to run compiled, which pays from some thousand frames on; needs the extra ``compiler``.

    Returns:
        A copy with cleaned ``position``, its standard deviation ``position_std``, ``velocity``, and the probability
        ``outlier`` that a point was one.  A point that is too rare to tell its noise is NaN throughout.

    Raises:
        ValueError: no such data set, or a value out of its range.
        CompileError: (a ``RuntimeError``) with ``compile``, if llvmlite is not installed.
    """
    poses = measurements(dataset, least=least)
    noise, motion = noise_and_motion(poses.z, float(poses.dt[0]))
    noise = noise if std is None else torch.full_like(noise, positive("std", std))
    motion = motion if q is None else torch.full_like(motion, positive("q", q))
    known = (noise.isfinite() & motion.isfinite() & poses.z.isfinite().all(-1).any(-1)).nonzero()[:, 0]
    z, each = poses.z[known], noise[known][:, None, None] * poses.factor[known]
    estimate = smoothed(z, poses.dt, each, motion[known], smooth=smooth, compile=compile)
    d = z.shape[-1]
    spread = estimate.scale_tril.square().sum(-1).sqrt()
    position = dataset["position"].transpose(*poses.order)

    def placed(values: Tensor) -> Any:
        """Values ``(B, T, d)`` of the known points as an array of the data set."""
        whole = torch.full(poses.z.shape, torch.nan, dtype=z.dtype).index_copy(0, known, values)
        return position.copy(data=whole.reshape(position.shape).numpy()).transpose(*dataset["position"].dims)

    outlier = estimate.info.outlier.amax(-1, keepdim=True).expand_as(z)
    return dataset.assign(
        position=placed(estimate.mean[..., :d]), position_std=placed(spread[..., :d]),
        velocity=placed(estimate.mean[..., d:]), outlier=placed(outlier).isel(space=0, drop=True),
    )  # fmt: skip

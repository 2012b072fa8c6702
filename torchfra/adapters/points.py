"""Smooths points that are measured at every frame, such as keypoints of animals, for xarray and scikit-learn."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra import presets
from torchfra.motion.polynomial import ConstantVelocity
from torchfra.sensors.position import Position
from torchfra.types import Estimate, Gaussian

_STRIDES = (1, 2, 4, 8, 16)
"""Frames from point to point of second differences."""
_FEWEST = 10
"""Numbers that a track has at least for each of them."""
_RATIOS = torch.logspace(-6, 6, 121, dtype=torch.float64)
"""Of the variances of motion and noise over a frame: the best of them is taken."""
_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable."""


def noise_and_motion(z: Tensor, period: float) -> tuple[Tensor, Tensor]:
    """The standard deviation of each track's noise, and the density of its process noise, by second differences.

    Over ``s`` frames these have the variance ``6 r + 2/3 q (s dt)^3``.  It is found from their median, on which
    outliers have little effect, and the two values by least squares of logarithms.

    Args:
        z: ``(..., T, d)`` points, NaN where missing.
        period: seconds from frame to frame.

    Returns:
        ``(...)`` in units of ``z``, and ``(...)`` in their squares per s^3; NaN for tracks that are too short, or
        whose points stay where they are.
    """
    logs, none = [], z.new_full((*z.shape[:-2], 1), torch.nan)
    for s in _STRIDES:
        second = (z[..., 2 * s :, :] - 2 * z[..., s:-s, :] + z[..., : -2 * s, :]).flatten(-2)
        median = torch.cat([second, none], -1).abs().nanmedian(-1).values
        enough = (second.isfinite().sum(-1) >= _FEWEST) & (median > 0)
        logs.append(torch.where(enough, 2 * (median / _NORMAL).log(), torch.nan))
    model = (6 + 2 / 3 * _RATIOS[:, None] * torch.tensor(_STRIDES) ** 3).log()
    left = torch.stack(logs, -1).unsqueeze(-2) - model  # (..., R, S)
    usual = left.nanmean(-1)
    misfit = (left - usual.unsqueeze(-1)).square().nansum(-1)
    best = misfit.argmin(-1, keepdim=True)
    variance = usual.gather(-1, best).squeeze(-1).exp()
    variance = torch.where(left[..., 0, :].isfinite().sum(-1) > 2, variance, torch.nan)  # for two values
    return variance.sqrt(), variance * _RATIOS[best.squeeze(-1)] / period**3


def smoothed(z: Tensor, dt: Tensor, std: Tensor, q: Tensor, *, smooth: bool = True, compile: bool = False) -> Estimate:
    """Estimates of positions and velocities by ``presets.gpb`` for points that never jump but may be outliers for long.

    Args:
        z: ``(B, T, d)`` points, NaN where missing.
        dt: ``(T,)`` s to each frame from the one before.
        std: ``(B, T, 1)`` of the noise.
        q: ``(B,)`` density of the process noise per second.
        smooth: whether later frames count too.
        compile: whether to run compiled.
    """
    there = z.isfinite().all(-1)
    first = there.to(torch.uint8).argmax(-1)[:, None, None]
    begin = z.take_along_dim(first.expand(-1, 1, z.shape[-1]), 1).squeeze(1)
    step = (z.diff(dim=1) / dt[1:, None]).abs().nanmedian(1).values
    speed = (step.amax(-1) / _NORMAL).unsqueeze(-1).expand_as(begin)
    prior = Gaussian.from_std(
        torch.cat([begin, torch.zeros_like(begin)], -1),
        torch.cat([std.take_along_dim(first, 1).squeeze(1).expand_as(begin), speed], -1),
    )
    motion, sensor = ConstantVelocity(q, z.shape[-1], continuous=True), Position(1.0, dims=z.shape[-1])
    f = presets.gpb(motion, sensor, manoeuvres="none")
    f = f.compile() if compile else f
    with torch.no_grad():
        return (f.smooth if smooth else f)(z, prior, dt=dt, std=std.expand_as(z))

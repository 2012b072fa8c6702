"""Lower bounds on errors: the Cramer-Rao bound of a track, and the information of a measurement with outliers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from torchfra.linalg.triangular import hstack, tria

_ROUNDING = 1e-9
"""Differences of slopes below this, relative to the largest slope, count as rounding: the slope is constant."""
_NODES = 4000
"""Number of nodes of the quadrature over the length of a measurement error."""


def cramer_rao(start: Tensor, transition: Tensor, process_noise: Tensor | None, slope: Tensor) -> Tensor:
    """Lower bound on the covariance of the errors at each step, ``(..., T, n, n)``.

    The state moves as ``x' = f(x) + G w`` and is measured as ``z = h(x) + v``; ``w`` is standard normal, and the noise
    ``v`` has been whitened: by its root where it is Gaussian, by that of its Fisher information where it is not.  All
    that depends on the state is taken at ``R`` truths.

    - For truths drawn with the process noise it is the posterior bound: the information of a step is the mean over the
      truths.
    - For ``R = 1`` and no process noise it is the parametric bound of this one path, for unbiased estimators.

    For linear motions it is the covariance of the Kalman filter.  The process noise may have any rank.  Where it is
    zero in a direction in which ``f`` is not linear, the bound counts that direction as known.

    Args:
        start: ``(..., n, p)`` root of the covariance of the error of the initial estimate, one step before the first.
        transition: ``(..., R, T, n, n)`` slope of ``f``; ``R`` may be 1 where all truths have the same.
        process_noise: ``(..., T, n, q)`` or ``(n, q)`` root ``G``; None for none.
        slope: ``(..., R, T, m, n)`` slope of ``h``, whitened; rows of what is missing are zero.

    Raises:
        ValueError: sizes that do not fit.

    Source: Tichavsky, Muravchik & Nehorai (1998), eqs. (21)-(23), in square-root form; Van Trees (1968), section 2.4.
    Differs: the prediction is ``E[F] (J + V)^-1 E[F]^T + Q`` with ``V = E[(F - E[F])^T Q^+ (F - E[F])]``, which
    is the same by the matrix inversion lemma and needs no inverse of ``Q``.
    """
    n = start.shape[-2]
    if transition.shape[-2:] != (n, n) or slope.shape[-1] != n or transition.shape[-3] != slope.shape[-3]:
        received = f"{tuple(transition.shape)} and {tuple(slope.shape)}"
        raise ValueError(
            f"transition, slope: expected (..., R, T, {n}, {n}) and (..., R, T, m, {n}), received {received}"
        )
    noise = start.new_zeros(n, 1) if process_noise is None else process_noise
    steps, roots = transition.shape[-3], []
    root = tria(start)
    for k in range(steps):
        g = noise if noise.dim() == 2 else noise[..., k, :, :]
        mean = transition[..., k, :, :].mean(-3)
        root = _informed(*_deviations(transition[..., k, :, :], mean, g), root)
        root = tria(hstack(mean @ root, g))
        root = _informed(_stacked(slope[..., k, :, :]), None, root)
        roots.append(root)
    found = torch.stack(roots, -3)
    return found @ found.mT


def _stacked(rows: Tensor) -> Tensor:
    """A root ``(..., n, n)`` of the mean over ``R`` of ``A^T A``, of ``A (..., R, m, n)``."""
    return tria(rows.flatten(-3, -2).mT / math.sqrt(rows.shape[-3]))


def _deviations(slope: Tensor, mean: Tensor, noise: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """The information on the state before a step that comes from slopes ``(..., R, n, n)`` that differ between truths.

    Returns:
        Root ``(..., n, n)`` of the information, and rows ``(..., k, n)`` of what is known exactly; None for nothing.
    """
    gap, rounding = slope - mean.unsqueeze(-3), _ROUNDING * slope.abs().amax(-3, keepdim=True)
    gap = torch.where(gap.abs() > rounding, gap, 0.0)
    if not bool(gap.any()):
        return None, None
    u, s, _ = torch.linalg.svd(noise, full_matrices=True)
    s = torch.nn.functional.pad(s, (0, u.shape[-1] - s.shape[-1]))
    has = s > _ROUNDING * s.amax(-1, keepdim=True).clamp_min(torch.finfo(s.dtype).tiny)
    rows, has = u.mT.unsqueeze(-3) @ gap, has[..., None, :, None]
    inverse = torch.where(has, 1 / torch.where(has, s[..., None, :, None], 1.0), 0.0)
    exact = torch.where(has, 0.0, rows)
    exact = torch.where(exact.abs() > _ROUNDING * gap.abs().amax(), exact, 0.0)
    return _stacked(rows * inverse), (_stacked(exact).mT if bool(exact.any()) else None)


def _informed(information: Tensor | None, exact: Tensor | None, root: Tensor) -> Tensor:
    """Root of ``(P^-1 + D)^-1``, of ``P`` and ``D`` by their roots ``(..., n, n)``, less what is known exactly."""
    if exact is not None:
        known = exact @ root
        root = root - root @ (torch.linalg.pinv(known) @ known)
    if information is None:
        return root
    scaled = information.mT @ root
    grown = torch.eye(root.shape[-1], dtype=root.dtype, device=root.device) + scaled.mT @ scaled
    informed: Tensor = torch.linalg.solve_triangular(torch.linalg.cholesky(grown).mT, root, upper=True, left=False)
    return informed


def outlier_information(weights: Sequence[float], factors: Sequence[float], size: int = 1) -> float:
    """The Fisher information of a measurement with outliers, relative to one without outliers: in ``(0, 1]``.

    All ``size`` elements of a measurement error are normal with ``factors[j]`` times their standard deviation, with
    probability ``weights[j]`` and independently of other steps.  The Fisher information of this mixture is the returned
    number times that of the error with factor 1.

    Args:
        weights: probabilities, which sum to one.
        factors: above 0.
        size: elements that have the same factor at a time.

    Raises:
        ValueError: weights that are no probabilities, or factors of 0 or below.
    """
    w, c = np.asarray(weights, dtype=float), np.asarray(factors, dtype=float)
    if w.shape != c.shape or w.ndim != 1 or (w < 0).any() or abs(w.sum() - 1) > 1e-9 or not (c > 0).all() or size < 1:
        raise ValueError(
            f"weights, factors: expected probabilities, and factors above 0, received {weights}, {factors}"
        )
    # Simpson's rule over the logarithm of the length r of the error: factors may be orders of magnitude apart.
    r = np.exp(np.linspace(math.log(1e-6 * c.min()), math.log(40 * c.max()), 2 * _NODES + 1))[:, None]
    log_density = np.log(np.maximum(w, np.finfo(float).tiny)) - size * np.log(c) - 0.5 * (r / c) ** 2
    top = log_density.max(1, keepdims=True)
    share = np.exp(log_density - top)
    score = (share / c**2).sum(1) / share.sum(1) * r[:, 0]
    shell = math.log(2) + size / 2 * math.log(math.pi) - math.lgamma(size / 2) - size / 2 * math.log(2 * math.pi)
    density = np.exp(top[:, 0] + np.log(share.sum(1)) + shell + (size - 1) * np.log(r[:, 0]))
    simpson = np.r_[1.0, np.tile([4.0, 2.0], _NODES)[:-1], 1.0] / 3 * math.log(r[1, 0] / r[0, 0])
    return float((simpson * density * r[:, 0] * score**2).sum() / size)

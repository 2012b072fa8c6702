"""Robust by a Huber regression on measurement and prediction."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra.gaussian.update import correct, repaired_root, trust
from torchfra.hyper import Hyper, Value
from torchfra.linalg.triangular import apply, hstack, tria, whiten
from torchfra.robust.base import Corrected, Robust
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Whitened


class HuberRegression(Robust):
    """The update as a linear regression on measurement and prediction, both with Huber weights, iterated.

    Of the measurement's statistical linearisation the error is left out.  The prediction is doubted too: where it is
    the less certain of the two, an outlier of the measurement is blamed on it and followed.

    Args:
        threshold: threshold of the weights, in standard deviations; infinity never doubts anything.
        max_iter: reweightings at most; 1 is a variant of its own.
        tol: relative change at which a track has settled.
        start: the first point: ``"posterior"`` of the plain update, or ``"prior"``.
        compensate: add the error of the linearisation to the noise.

    Raises:
        ValueError: an argument that is none of those.

    Source: Karlgaard & Schaub (2007); Zhang et al. (2016); Qin et al. (2018) for the comparison.
    """

    def __init__(
        self,
        threshold: Value = 1.345,
        *,
        max_iter: int = 10,
        tol: float = 1e-6,
        start: str = "posterior",
        compensate: bool = False,
    ) -> None:
        super().__init__()
        if max_iter < 1 or not tol >= 0:
            raise ValueError(f"max_iter, tol: expected 1 or more and 0 or more, received {max_iter}, {tol}")
        if start not in ("posterior", "prior"):
            raise ValueError(f"start: expected 'posterior' or 'prior', received {start!r}")
        self.threshold = Hyper(threshold, name="threshold")
        self.max_iter, self.tol, self.start, self.compensate = max_iter, tol, start, compensate

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: MeasurementNoise) -> Corrected:
        """See ``Robust``; all in units of the prediction's root, in which it is 0 with covariance 1."""
        residual, slope, d, n = whitened.residual, whitened.slope, whitened.reads, belief.mean.shape[-1]
        unit = torch.eye(n, dtype=residual.dtype, device=residual.device)
        point = torch.zeros_like(belief.mean)
        if self.start == "posterior":
            point = correct(Gaussian(point, unit), whitened)[0].mean
        if self.compensate:
            rest = torch.eye(residual.shape[-1], dtype=residual.dtype, device=residual.device)
            rest = tria(hstack(rest, whitened.rest)) if whitened.lost is None else repaired_root(whitened)[0]
            residual, slope = whiten(rest, residual), torch.linalg.solve_triangular(rest, slope, upper=False)
        linear, wide = Whitened(residual, slope, d), pad(slope, (0, n - d))
        threshold = self.threshold(residual).unsqueeze(-1)

        def reweighted(point: Tensor) -> tuple[Gaussian, Tensor]:
            seen, told = (1 / (x.abs() / threshold).clamp_min(1.0) for x in (apply(wide, point) - residual, point))
            shrunk = told.rsqrt()
            scaled = linear._replace(spread=slope * shrunk[..., None, :d])
            after, _, _ = correct(Gaussian(torch.zeros_like(point), shrunk.diag_embed()), trust(scaled, seen))
            return after, seen

        going = torch.ones_like(point[..., 0], dtype=torch.bool)
        count = torch.zeros_like(going, dtype=torch.int64)
        for _ in range(self.max_iter):
            new = reweighted(point)[0].mean
            moved = (new - point).square().sum(-1) > self.tol**2 * new.square().sum(-1)
            point, count = torch.where(going.unsqueeze(-1), new, point), count + going.to(count)
            going = going & moved
        after, seen = reweighted(point)
        mean, root = belief.mean + apply(belief.scale_tril, point), belief.scale_tril @ after.scale_tril
        return Corrected(Gaussian(mean, root), seen, iterations=count)

"""Robust update by the Huber score in the place of the innovation."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.gaussian.update import joint
from torchfra.hyper import Hyper, Value, one_of
from torchfra.linalg.safe import safe_sqrt
from torchfra.linalg.triangular import apply, hstack, tria, whiten
from torchfra.robust.base import Corrected, Robust
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Whitened


class HuberScore(Robust):
    """Limits the normalised innovation to a threshold: the Huber score in the place of the innovation.

    With ``eta`` the innovation divided by the root of its covariance and ``phi(eta) = min(1, threshold / |eta|)``,

        x = x- + P_xz L^-T (phi(eta) eta),   P = P- - factor K P_zz K^T.

    Args:
        threshold: in standard deviations of the innovation; infinity gives the plain update.
        eps: fraction of contaminated measurements in the density that the score is derived from, in [0, 1);
            ``"minimax"`` for the fraction of Huber's least favourable density, which depends on ``threshold`` alone.
        cov_mode: the factor in the covariance: ``"constant"`` for the mean slope of the score, ``(1 - eps)
            erf(threshold / sqrt(2))``, as in the paper; ``"indicator"`` for the slope itself, 1 or 0 for each element.

    Raises:
        ValueError: an argument is out of its range.

    Source: Qin et al. (2018), eqs. (10)-(59), without the scale of (35)-(36); Masreliez & Martin (1977).  Differs:
    ``eps`` is a free parameter in the paper.
    """

    def __init__(
        self,
        threshold: Value = 1.345,
        *,
        eps: Value | str = "minimax",
        cov_mode: str = "constant",
    ) -> None:
        super().__init__()
        one_of(cov_mode=(cov_mode, ("constant", "indicator")))
        if isinstance(eps, str) and eps != "minimax":
            raise ValueError(f"eps: expected a share in [0, 1) or 'minimax', received {eps!r}")
        self.threshold = Hyper(threshold, name="threshold")
        self.eps = None if isinstance(eps, str) else Hyper(eps, constraints.half_open_interval(0.0, 1.0), name="eps")
        self.cov_mode = cov_mode

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: MeasurementNoise) -> Corrected:
        """The belief after the measurement: eqs. (54)-(59); ``weights`` are not used."""
        root, cross, posterior = joint(belief, whitened)
        eta = whiten(root, whitened.residual)
        threshold, size = self.threshold(eta).unsqueeze(-1), eta.abs()
        score = 1 / (size / threshold).clamp_min(1.0)  # eqs. (54)-(56)
        mean = belief.mean + apply(cross, score * eta)  # eq. (58)
        slope = (size < threshold).to(eta) if self.cov_mode == "indicator" else self.factor().to(eta).unsqueeze(-1)
        # eq. (59): P = S_post S_post^T + cross diag(1 - slope) cross^T
        after = tria(hstack(posterior, cross * safe_sqrt(1 - slope).unsqueeze(-2)))
        limited = torch.minimum(size, threshold)
        cost = limited * (size - limited / 2)  # eq. (34)
        evidence = -cost.sum(-1) - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return Corrected(Gaussian(mean, after), score, evidence)

    def factor(self) -> Tensor:
        """Mean slope of the score, in (0, 1]: eqs. (45), (57)."""
        threshold = self.threshold()
        uncontaminated = math.sqrt(2 * math.pi) / _integral(threshold) if self.eps is None else 1 - self.eps()
        return uncontaminated * torch.erf(threshold / math.sqrt(2))


def _integral(threshold: Tensor) -> Tensor:
    """Integral of ``exp(-rho)`` over the real line, for Huber's cost ``rho``."""
    tails = 2 / threshold * (-threshold.square() / 2).exp()
    integral: Tensor = math.sqrt(2 * math.pi) * torch.erf(threshold / math.sqrt(2)) + tails
    return integral

"""Robust by the Huber score in the place of the innovation."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra.gaussian.update import joint
from torchfra.hyper import Hyper, Value, one_of
from torchfra.linalg.gram import downdate, gram_sqrt
from torchfra.linalg.triangular import apply, hstack, tria, whiten
from torchfra.robust.base import Corrected, Robust
from torchfra.sensors.base import MeasurementNoise
from torchfra.types import Gaussian, Whitened


class HuberScore(Robust):
    """Cuts the normalised innovation off at a threshold: the Huber score in the place of the innovation.

    With ``eta`` the innovation divided by the root of its covariance and ``phi(eta) = min(1, threshold / |eta|)``,

        x = x- + P_xz L^-T (phi(eta) eta),   P = P- - factor K P_zz K^T.

    Args:
        threshold: the threshold, in standard deviations of the innovation; infinity leaves the plain update.
        eps: share of contaminated measurements that the density behind the score assumes, in [0, 1); ``"minimax"`` for
            the one that makes it Huber's least favourable density, which ``threshold`` fixes.
        cov_mode: the factor of the covariance: ``"constant"`` the mean of the score's slope, ``(1 - eps)
            erf(threshold /
            sqrt(2))``, the paper's; ``"indicator"`` the slope itself, 1 or 0 for each element.
        whitening: the root of the innovation's covariance: ``"cholesky"``, or ``"symmetric"``, which does not depend on
            the order of the elements, but on their units.
        zeta_scale: scale ``eta`` so that the density has variance 1: weights then go up to 1.48 at 1.345, and
            more covariance may be taken off than there is (``info.repaired``).

    Raises:
        ValueError: an argument that is none of those.

    Source: Qin et al. (2018), eqs. (10)-(59); Masreliez & Martin (1977).  Differs: ``eps`` is free there.
    """

    def __init__(
        self,
        threshold: Value = 1.345,
        *,
        eps: Value | str = "minimax",
        cov_mode: str = "constant",
        whitening: str = "cholesky",
        zeta_scale: bool = False,
    ) -> None:
        super().__init__()
        one_of(
            cov_mode=(cov_mode, ("constant", "indicator")),
            whitening=(whitening, ("cholesky", "symmetric")),
        )
        if isinstance(eps, str) and eps != "minimax":
            raise ValueError(f"eps: expected a share in [0, 1) or 'minimax', received {eps!r}")
        self.threshold = Hyper(threshold, name="threshold")
        self.eps = None if isinstance(eps, str) else Hyper(eps, constraints.half_open_interval(0.0, 1.0), name="eps")
        self.cov_mode, self.whitening, self.zeta_scale = cov_mode, whitening, zeta_scale

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: MeasurementNoise) -> Corrected:
        """See ``Robust``."""
        root, cross, left = joint(belief, whitened)
        eta = whiten(root, whitened.residual)
        if self.whitening == "symmetric":
            full = noise.colour(root)
            turn = torch.linalg.solve_triangular(full, gram_sqrt(full), upper=False)
            eta, cross = apply(turn.mT, eta), cross @ turn
        threshold, zeta = self.threshold(eta).unsqueeze(-1), self.zeta().to(eta).unsqueeze(-1)
        size = zeta * eta.abs()
        score = zeta.square() / (size / threshold).clamp_min(1.0)  # eqs. (54)-(56)
        mean = belief.mean + apply(cross, score * eta)  # eq. (58)
        slope = (size < threshold).to(eta) if self.cov_mode == "indicator" else self.factor().to(eta).unsqueeze(-1)
        kept = 1 - zeta.square() * slope  # eq. (59): P = left left^T + cross diag(kept) cross^T
        after, repaired = tria(hstack(left, cross * _root(kept).unsqueeze(-2))), None
        if self.zeta_scale:
            after, repaired = downdate(after, cross * _root(-kept).unsqueeze(-2))
        cut = torch.minimum(size, threshold)
        inside = cut * (size - cut / 2)  # eq. (34)
        evidence = -inside.sum(-1) - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return Corrected(Gaussian(mean, after), score, evidence, repaired=repaired)

    def factor(self) -> Tensor:
        """Mean slope of the score, in (0, 1]: eqs. (45), (57)."""
        threshold = self.threshold()
        share = math.sqrt(2 * math.pi) / _mass(threshold) if self.eps is None else 1 - self.eps()
        return share * torch.erf(threshold / math.sqrt(2))

    def zeta(self) -> Tensor:
        """Scale of the normalised innovation; 1 unless ``zeta_scale``: eqs. (35)-(36)."""
        threshold = self.threshold()
        if not self.zeta_scale:
            return torch.ones_like(threshold)
        tail = (-threshold.square() / 2).exp()
        second = (
            math.sqrt(2 * math.pi) * torch.erf(threshold / math.sqrt(2)) + 4 * (1 / threshold + 1 / threshold**3) * tail
        )
        zeta: Tensor = (second / _mass(threshold)).sqrt()
        return zeta


def _mass(threshold: Tensor) -> Tensor:
    """Integral of ``exp(-rho)`` for Huber's cost."""
    tail = 2 / threshold * (-threshold.square() / 2).exp()
    mass: Tensor = math.sqrt(2 * math.pi) * torch.erf(threshold / math.sqrt(2)) + tail
    return mass


def _root(x: Tensor) -> Tensor:
    """Square root of what is positive, else 0, with a gradient that is finite."""
    return torch.where(x > 0, torch.where(x > 0, x, 1.0).sqrt(), 0.0)

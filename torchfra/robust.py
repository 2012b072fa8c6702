"""The measurement side: how a filter trusts a wild innovation less.

Two kinds.  ``Weights`` (``Huber``, ``ThreeSegment``) divide the noise of each element by a weight from 1 (trusted) down
to 0 (left out), and the update stays what it was.  ``HuberScore`` and ``HuberRegression`` make an update of their own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.hyper import Hyper, Value, one_of
from torchfra.linalg import apply, downdate, gram_sqrt, hstack, tria, whiten
from torchfra.sensors import Noise
from torchfra.types import Gaussian, Whitened
from torchfra.update import correct, joint, mended, trust, trusted_density


class Corrected(NamedTuple):
    """What a robust side makes of a measurement."""

    belief: Gaussian
    weights: Tensor
    """``(..., m)`` how far each element was trusted."""
    evidence: Tensor | None = None
    """``(...)`` log density of the innovation as it was trusted, up to a constant; None for the plain one."""
    iterations: Tensor | None = None
    """``(...)`` if it iterates."""
    repaired: Tensor | None = None
    """``(...)`` bool, if it may take off more covariance than there is."""


class Robust(nn.Module):
    """Abstract: a subclass gives ``correct``."""

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)`` by which the noise of a ``residual (..., m)``, in units of it, is to be divided.

        ``nis (...)`` is the normalised innovation squared.  Ones for a side that leaves the noise as it is.
        """
        return torch.ones_like(residual)

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: Noise) -> Corrected:
        """The belief after the measurement.

        Args:
            belief: predicted.
            whitened: the measurement against it.
            weights: what ``forward`` gave, of this innovation or of the one before the prediction was widened.
            noise: what the measurement was divided by.
        """
        raise TypeError(f"{type(self).__name__} needs a correct")


class Weights(Robust):
    """Abstract: a subclass gives ``forward``, and the update is the plain one with the noise so much larger."""

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: Noise) -> Corrected:
        """See ``Robust``; Wang et al. (2021), eq. (26)."""
        after, root, normalised = correct(belief, trust(whitened, weights))
        return Corrected(after, weights, trusted_density(root, normalised, weights))


class Huber(Weights):
    """Weight 1 up to a threshold and ``threshold / |v|`` beyond it, per element.

    The innovation counts in units of the measurement noise alone, not of the whole innovation covariance: a large
    error of the prediction is taken for an outlier too.

    Args:
        threshold: in standard deviations of the noise; infinity never doubts a measurement.
        elements: the number of elements of a measurement if each is to have a threshold of its own, in the last
            dimension of ``threshold``; a single number is then repeated.

    Raises:
        ValueError: a threshold that is not above 0, or not one for each element.

    Source: Huber (1964); Wang et al. (2021), eqs. (25)-(26).
    """

    def __init__(self, threshold: Value = 1.345, *, elements: int | None = None) -> None:
        super().__init__()
        if elements is not None:
            threshold = torch.as_tensor(threshold, dtype=torch.float64)
            threshold = threshold.expand(elements) if threshold.dim() == 0 else threshold
            if threshold.shape[-1] != elements:
                raise ValueError(f"threshold: expected (..., {elements}), received {tuple(threshold.shape)}")
        self.threshold = Hyper(threshold, event=int(elements is not None), name="threshold")

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)`` of a ``residual (..., m)`` in units of the noise; ``nis (...)`` is not looked at."""
        excess = residual.abs() / self.threshold.elements().to(residual)
        weights: Tensor = 1 / excess.clamp_min(1.0)
        return weights


class ThreeSegment(Weights):
    """One weight for all elements, from the distance of the whole innovation: full, falling, none (IGG-III).

    With ``d = sqrt(nis)``, ``a = sqrt(low)`` and ``b = sqrt(high)``: 1 up to a, ``a/d ((b - d)/(b - a))^2`` between,
    0 from b on, which leaves the measurement out.

    Args:
        low: normalised innovation squared up to which a measurement is trusted fully.
        high: from which on it is not used at all.
        squared: take ``nis, low, high`` themselves in the place of ``d, a, b``.

    Raises:
        ValueError: ``high`` not above ``low``.

    Source: Yang et al. (2001) for the weight.  Differs: Wang et al. (2021) compare with the filter of Wu et al. (2015)
    and print its thresholds only; the form of the weight is our reading.
    """

    def __init__(self, low: Value = 5.991, high: Value = 10000.0, *, squared: bool = False) -> None:
        super().__init__()
        self.low, self.high, self.squared = Hyper(low, name="low"), Hyper(high, name="high"), squared
        if not bool((self.high() > self.low()).all()):
            raise ValueError(f"high: expected a value above low, received {high} with low {low}")

    def forward(self, residual: Tensor, nis: Tensor) -> Tensor:
        """Weights ``(..., m)``, all the same, of an innovation whose normalised square is ``nis (...)``."""
        low, high = self.low().to(nis), self.high().to(nis)
        # The clamps keep the root and its gradient away from 0, inside the segment where the weight is 1 anyway.
        d = nis.clamp_min(low) if self.squared else nis.clamp_min(low).sqrt()
        a, b = (low, high) if self.squared else (low.sqrt(), high.sqrt())
        weight = a / d * ((b - d).clamp_min(0.0) / (b - a)).square()
        return torch.where(nis > low, weight, 1.0).unsqueeze(-1).expand(nis.shape + residual.shape[-1:])


class HuberScore(Robust):
    """Cuts the normalised innovation off at a threshold: the Huber score in the place of the innovation.

    With ``eta`` the innovation divided by the root of its covariance and ``phi(eta) = min(1, gamma / |eta|)``,

        x = x- + P_xz L^-T (phi(eta) eta),   P = P- - factor K P_zz K^T.

    Args:
        gamma: the threshold, in standard deviations of the innovation; infinity leaves the plain update.
        eps: share of contaminated measurements that the density behind the score assumes, in [0, 1); ``"minimax"`` for
            the one that makes it Huber's least favourable density, which ``gamma`` fixes.
        cov_mode: the factor of the covariance: ``"constant"`` the mean of the score's slope, ``(1 - eps) erf(gamma /
            sqrt(2))``, the paper's; ``"indicator"`` the slope itself, 1 or 0 for each element.
        whitening: the root of the innovation's covariance: ``"cholesky"``, or ``"symmetric"``, which does not depend on
            the order of the elements, but on their units.
        zeta_scale: scale ``eta`` so that the density has variance 1: weights then go up to 1.48 at ``gamma`` 1.345, and
            more covariance may be taken off than there is (``info.repaired``).

    Raises:
        ValueError: an argument that is none of those.

    Source: Qin et al. (2018), eqs. (10)-(59); Masreliez & Martin (1977).  Differs: ``eps`` is free there.
    """

    def __init__(
        self,
        gamma: Value = 1.345,
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
        self.gamma = Hyper(gamma, name="gamma")
        self.eps = None if isinstance(eps, str) else Hyper(eps, constraints.half_open_interval(0.0, 1.0), name="eps")
        self.cov_mode, self.whitening, self.zeta_scale = cov_mode, whitening, zeta_scale

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: Noise) -> Corrected:
        """See ``Robust``."""
        root, cross, left = joint(belief, whitened)
        eta = whiten(root, whitened.residual)
        if self.whitening == "symmetric":
            full = noise.colour(root)
            turn = torch.linalg.solve_triangular(full, gram_sqrt(full), upper=False)
            eta, cross = apply(turn.mT, eta), cross @ turn
        gamma, zeta = self.gamma().to(eta).unsqueeze(-1), self.zeta().to(eta).unsqueeze(-1)
        size = zeta * eta.abs()
        score = zeta.square() / (size / gamma).clamp_min(1.0)  # eqs. (54)-(56)
        mean = belief.mean + apply(cross, score * eta)  # eq. (58)
        slope = (size < gamma).to(eta) if self.cov_mode == "indicator" else self.factor().to(eta).unsqueeze(-1)
        kept = 1 - zeta.square() * slope  # eq. (59): P = left left^T + cross diag(kept) cross^T
        after, repaired = tria(hstack(left, cross * _root(kept).unsqueeze(-2))), None
        if self.zeta_scale:
            after, repaired = downdate(after, cross * _root(-kept).unsqueeze(-2))
        cut = torch.minimum(size, gamma)
        inside = cut * (size - cut / 2)  # eq. (34)
        evidence = -inside.sum(-1) - root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return Corrected(Gaussian(mean, after), score, evidence, repaired=repaired)

    def factor(self) -> Tensor:
        """Mean slope of the score, in (0, 1]: eqs. (45), (57)."""
        gamma = self.gamma()
        share = math.sqrt(2 * math.pi) / _mass(gamma) if self.eps is None else 1 - self.eps()
        return share * torch.erf(gamma / math.sqrt(2))

    def zeta(self) -> Tensor:
        """Scale of the normalised innovation; 1 unless ``zeta_scale``: eqs. (35)-(36)."""
        gamma = self.gamma()
        if not self.zeta_scale:
            return torch.ones_like(gamma)
        tail = (-gamma.square() / 2).exp()
        second = math.sqrt(2 * math.pi) * torch.erf(gamma / math.sqrt(2)) + 4 * (1 / gamma + 1 / gamma**3) * tail
        zeta: Tensor = (second / _mass(gamma)).sqrt()
        return zeta


class HuberRegression(Robust):
    """The update as a linear regression on measurement and prediction, both with Huber weights, iterated.

    Of the measurement's statistical linearisation the error is left out.  The prediction is doubted too: where it is
    the less certain of the two, an outlier of the measurement is blamed on it and followed.

    Args:
        gamma: threshold of the weights, in standard deviations; infinity never doubts anything.
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
        gamma: Value = 1.345,
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
        self.gamma = Hyper(gamma, name="gamma")
        self.max_iter, self.tol, self.start, self.compensate = max_iter, tol, start, compensate

    def correct(self, belief: Gaussian, whitened: Whitened, weights: Tensor, noise: Noise) -> Corrected:
        """See ``Robust``; all in units of the prediction's root, in which it is 0 with covariance 1."""
        residual, slope, d, n = whitened.residual, whitened.slope, whitened.reads, belief.mean.shape[-1]
        unit = torch.eye(n, dtype=residual.dtype, device=residual.device)
        point = torch.zeros_like(belief.mean)
        if self.start == "posterior":
            point = correct(Gaussian(point, unit), whitened)[0].mean
        if self.compensate:
            rest = torch.eye(residual.shape[-1], dtype=residual.dtype, device=residual.device)
            rest = tria(hstack(rest, whitened.rest)) if whitened.lost is None else mended(whitened)[0]
            residual, slope = whiten(rest, residual), torch.linalg.solve_triangular(rest, slope, upper=False)
        linear, wide = Whitened(residual, slope, d), pad(slope, (0, n - d))
        gamma = self.gamma().to(residual).unsqueeze(-1)

        def reweighted(point: Tensor) -> tuple[Gaussian, Tensor]:
            seen, told = (1 / (x.abs() / gamma).clamp_min(1.0) for x in (apply(wide, point) - residual, point))
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


def _mass(gamma: Tensor) -> Tensor:
    """Integral of ``exp(-rho)`` for Huber's cost."""
    tail = 2 / gamma * (-gamma.square() / 2).exp()
    mass: Tensor = math.sqrt(2 * math.pi) * torch.erf(gamma / math.sqrt(2)) + tail
    return mass


def _root(x: Tensor) -> Tensor:
    """Square root of what is positive, else 0, with a gradient that is finite."""
    return torch.where(x > 0, torch.where(x > 0, x, 1.0).sqrt(), 0.0)

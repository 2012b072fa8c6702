"""The number of births: Poisson in every scan."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchfra.hyper import Hyper, Value
from torchfra.numbers import is_integer
from torchfra.targets.state import TargetsEstimate


class PoissonBirths(nn.Module):
    """Log probability of the number of targets that begin in each scan, to learn their rate by.

    Together with the likelihood of the scans it is the negative log likelihood of a sequence, given its targets::

        loss = -(estimate.log_likelihood.sum(-2) + births(estimate)).mean()

    Args:
        rate: expected number of targets that begin per scan; a number, or what broadcasts with the scenes.
        skip: first scans that do not count: as many as it takes to confirm a target, more where targets may be there
            from the start.

    Raises:
        ValueError: a rate that is not above 0, or a number of scans below 0.

    Source: Reid (1979), "An Algorithm for Tracking Multiple Targets", whose new targets are Poisson.
    """

    def __init__(self, rate: Value = 0.1, *, skip: int = 5) -> None:
        super().__init__()
        self.rate = Hyper(rate, name="rate")
        if not is_integer(skip, 0):
            raise ValueError(f"skip: expected 0 scans or more, received {skip!r}")
        self.skip = skip

    def forward(self, estimate: TargetsEstimate) -> Tensor:
        """``(..., T)`` log probability of the number of targets confirmed for the first time; 0 in skipped scans."""
        there = estimate.confirmed
        earlier = there.cumsum(-1) - there.to(torch.int64) > 0
        begun = (there & ~earlier).sum(-2).to(estimate.mean)
        rate = self.rate(begun).unsqueeze(-1)
        log_probability = begun * rate.log() - rate - torch.lgamma(begun + 1)
        counts = torch.arange(there.shape[-1], device=there.device) >= self.skip
        return torch.where(counts, log_probability, 0.0)

    def extra_repr(self) -> str:
        """The number of skipped scans."""
        return f"skip={self.skip}"

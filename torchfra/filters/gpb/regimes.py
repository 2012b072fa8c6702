"""Regimes of a motion: calm and agile, the other motions of a bank, and jumps."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.gaussian.mixture import log_sum
from torchfra.hyper import Hyper, Values
from torchfra.linalg.batches import broadcast_shapes
from torchfra.linalg.safe import safe_divide, safe_log
from torchfra.linalg.triangular import hstack, tria
from torchfra.types import Gaussian

FURTHEST = 1e5
"""Largest factor of a jump on the covariance, however far off the measurement is."""
USUAL = 1000.0
"""Normalised innovation squared per element up to which all jumps have the same odds."""


class Regimes(nn.Module):
    """How a step may go: a Markov chain over motions, levels of their process noise, and jumps.

    The first motion comes at ``L`` levels, the others of a bank as they are, and ``J`` jumps widen the first motion's
    prediction at its last level, as far as the measurement asks for. In this order they are the ``R = L + (K - 1) + J``
    regimes. A regime stays with a probability of its own; else the next one is drawn anew, from the same odds whatever
    was before. Values are given by kind, ``(..., L + 1 + J)``: each level, any other motion, each jump; so they fit
    banks of any size.

    Args:
        motions: their number, ``K``.
        levels: ``(..., L)`` by which the variance of the first motion's process noise is multiplied, ascending.
        jumps: ``(..., J)`` times the normalised innovation squared per element: by so much, at least 1, the covariance
            of the predicted position is multiplied; its correlations stay.
        stay: self-transition probabilities by kind.
        renew: odds by kind of the regime that is drawn anew, which sum to one; other motions share theirs evenly.

    Raises:
        ValueError: shapes that do not go together, values that are out of their range or do not sum to one.
    """

    def __init__(self, motions: int, *, levels: Values, jumps: Values, stay: Values, renew: Values) -> None:
        super().__init__()
        levels, jumps, stay, renew = (torch.as_tensor(x, dtype=torch.float64) for x in (levels, jumps, stay, renew))
        for name, value in (("levels", levels), ("jumps", jumps)):
            if value.dim() == 0:
                raise ValueError(f"{name}: expected several, received {value.item():g}")
        self.motions, self.level_count, self.jump_count = motions, levels.shape[-1], jumps.shape[-1]
        kinds = levels.shape[-1] + 1 + jumps.shape[-1]
        for name, value in (("stay", stay), ("renew", renew)):
            if value.shape[-1:] != (kinds,):
                raise ValueError(f"{name}: expected (..., {kinds}), received {tuple(value.shape)}")
        self.levels = Hyper(levels, event_dim=1, name="levels")
        self.jumps = Hyper(jumps, event_dim=1, name="jumps")
        self.stay = Hyper(stay, constraints.unit_interval, event_dim=1, name="stay")
        self.renew = Hyper(renew, constraints.simplex, event_dim=1, name="renew")

    @property
    def agile(self) -> int:
        """The number of the first motion's last level, after which jumps come."""
        return self.level_count - 1

    def of_motion(self, log_weights: Tensor) -> Tensor:
        """Of logs of weights of regimes ``(..., R)`` those of each motion together, ``(..., K)``."""
        own, others = self._own_and_others(log_weights)
        return torch.cat([log_sum(own, -1).unsqueeze(-1), others], -1)

    def sums(self, weights: Tensor) -> Tensor:
        """Of weights of regimes ``(..., R)`` the sum of each motion, ``(..., K)``."""
        own, others = self._own_and_others(weights)
        return torch.cat([own.sum(-1, keepdim=True), others], -1)

    def _own_and_others(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """Of regimes ``(..., R)`` those of the first motion, and those of the others."""
        end = self.level_count + self.motions - 1
        return torch.cat([values[..., : self.level_count], values[..., end:]], -1), values[..., self.level_count : end]

    def renewed(self, like: Tensor) -> Tensor:
        """Odds ``(..., R)`` of a regime drawn anew, which sum to one."""
        kinds = self.renew(like)
        odds = self._by_regime(kinds, kinds[..., self.level_count : self.level_count + 1] / max(self.motions - 1, 1))
        return odds / odds.sum(-1, keepdim=True)  # one motion has no others

    def of_each(self, values: Tensor, dim: int) -> Tensor:
        """Of motions, along a dimension, what goes with each regime."""
        first, jumps = values.narrow(dim, 0, 1), self.jump_count
        others = values.narrow(dim, 1, self.motions - 1)
        return torch.cat([*[first] * self.level_count, others, *[first] * jumps], dim)

    def chain(self, like: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Self-transition probabilities ``(..., R)`` in a step, and odds ``(..., R)`` of what is drawn anew otherwise.

        No level and no jump begins where nothing is ``measured (...)``, or what measurements have told of them would be
        forgotten over steps without one.  Other motions do: the longer a gap is, the less is known.
        """
        stay, odds = self.staying(like), self.renewed(like)
        before, others, after = odds.split((self.level_count, self.motions - 1, self.jump_count), -1)
        share = others.sum(-1, keepdim=True)
        among_others = torch.cat([torch.zeros_like(before), safe_divide(others, share), torch.zeros_like(after)], -1)
        measured = measured.unsqueeze(-1)
        return torch.where(measured, stay, 1 - (1 - stay) * share), torch.where(measured, odds, among_others)

    def transition(self, log_weights: Tensor, measured: Tensor) -> Tensor:
        """Logs ``(..., R, R)`` of how regimes follow each other, ``[was, now]``, of tracks ``log_weights (..., R)``.

        ``measured (...)``: whether anything is in the step.
        """
        stay, odds = self.chain(log_weights, measured)
        drawn = (1 - stay).unsqueeze(-1) * odds.unsqueeze(-2)
        return safe_log(drawn + torch.diag_embed(stay))

    def staying(self, like: Tensor) -> Tensor:
        """Probabilities ``(..., R)`` that a regime stays."""
        kinds = self.stay(like)
        return self._by_regime(kinds, kinds[..., self.level_count : self.level_count + 1])

    def _by_regime(self, kinds: Tensor, others: Tensor) -> Tensor:
        """Values by kind ``(..., L + 1 + J)`` as ``(..., R)``; those of ``others`` ``(..., 1)``."""
        repeated = others.expand(*others.shape[:-1], self.motions - 1)
        return torch.cat([kinds[..., : self.level_count], repeated, kinds[..., self.level_count + 1 :]], -1)

    def predictions(self, mean: Tensor, spread: Tensor, noise: Tensor) -> Gaussian:
        """A prediction for each level and other motion, ``(L + K - 1, ..., n)``.

        Args:
            mean: ``(..., K, n)`` of each motion, from ``gaussian.model.propagate``, as what follows.
            spread: ``(..., K, n, p)`` what was uncertain before.
            noise: ``(..., K, n, q)`` process noise.
        """
        every = broadcast_shapes(mean.shape, noise.shape[:-1])  # values of motions may bring a batch
        rank = mean.dim() - 2
        means = mean.expand(every).movedim(-2, 0)
        spread, noise = (x.expand(*every, -1).movedim(-3, 0) for x in (spread, noise))
        first = in_front(self.levels(mean).sqrt(), rank)[..., None, None] * noise[:1]
        noise = torch.cat([first.expand(self.level_count, *noise.shape[1:]), noise[1:]])
        roots = tria(hstack(torch.cat([spread[:1].expand(self.level_count, *spread.shape[1:]), spread[1:]]), noise))
        return Gaussian(torch.cat([means[:1].expand(self.level_count, *means.shape[1:]), means[1:]]), roots)

    def widths(self, like: Tensor, far: Tensor) -> Tensor:
        """Factors ``(J, ...)`` of jumps on the root of the position's covariance; ``far`` as in ``jumped``."""
        return (in_front(self.jumps(like), far.dim()) * far).clamp(1.0, FURTHEST).sqrt()

    def jumped(self, belief: Gaussian, far: Tensor, position: slice) -> Gaussian:
        """A belief ``(..., n)`` after each jump, ``(J, ..., n)``.

        A jump that is wider than what is measured asks for would never be contradicted where little can be told from
        the measurement, or nothing at all, and widen the estimate without bound.

        Args:
            belief: without a jump.
            far: ``(...)`` normalised innovation squared per element of the belief.
            position: which components of a state are its position.
        """
        mean, root = belief
        widened = self.widths(mean, far).unsqueeze(-1)
        there = torch.zeros(mean.shape[-1], dtype=mean.dtype, device=mean.device)
        there[position] = 1.0
        scaled = (1 + (widened - 1) * there).unsqueeze(-1) * root  # scaled rows: still a lower root
        return Gaussian(mean.expand(scaled.shape[:-1]), scaled)

    def rarer(self, log_weights: Tensor, far: Tensor) -> Tensor:
        """Log weights ``(R, ...)`` with odds of jumps that fall with their size: what is that far off is an outlier.

        Args:
            log_weights: before it is known how far the measurement is.
            far: ``(...)`` as in ``jumped``.
        """
        jumps = self.jump_count
        rarer = (far / USUAL).clamp_min(1.0).log().expand(jumps, *far.shape)
        still = torch.zeros_like(far).expand(log_weights.shape[0] - jumps, *far.shape)
        return log_weights - torch.cat([still, rarer])


def in_front(values: Tensor, rank: int) -> Tensor:
    """Values ``(..., C)`` of tracks as ``(C, ...)``, to go before tensors of ``rank`` dimensions that end in tracks."""
    values = values.movedim(-1, 0)
    return values.reshape(values.shape[:1] + (1,) * (rank + 1 - values.dim()) + values.shape[1:])

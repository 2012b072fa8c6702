"""Regimes of a motion: levels of its process noise, the other motions of a bank, manoeuvres and jumps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.filters.gpb.hypotheses import BEFORE, MOTION, Hypotheses
from torchfra.filters.markov import mean_durations, over_seconds, rates
from torchfra.gaussian.mixture import largest, log_sum
from torchfra.gaussian.model import Carried
from torchfra.hyper import Hyper, Values, one_given
from torchfra.linalg.safe import safe_divide, safe_log
from torchfra.linalg.triangular import hstack, tria
from torchfra.types import Gaussian

FURTHEST = 1e5
"""Largest factor of a jump or a manoeuvre on the covariance, however far off the measurement is."""
USUAL_JUMP, USUAL_MANOEUVRE = 1000.0, 30.0
"""Normalised innovation squared per element up to which all jumps, and all manoeuvres, have the same odds."""


class Moves(NamedTuple):
    """Weights ``(1, R, 2, ...)`` of how regimes go over into those of the next step, all by the same factor."""

    stayed: Tensor
    """Of each regime, that it goes on."""
    left: Tensor
    """Of each regime before, that it ends."""
    restarted: Tensor
    """Of each regime, that it begins where another has ended."""
    log_weight: Tensor
    """Logs of the weights of the regimes in the step: of those that go on or begin."""


class Regimes(nn.Module):
    """How a step may go: a Markov chain over motions, levels of their process noise, manoeuvres and jumps.

    The first motion comes at ``L`` levels, the others of a bank as they are. ``M`` manoeuvres have as much more process
    noise than the first motion's last level as the measurement asks for, ``J`` jumps widen the position of its
    prediction in the same way. In this order they are the ``R = L + (K - 1) + M + J`` regimes. A regime goes on with a
    probability of its own, or for a time of its own; then the next one is drawn from the restart distribution. Before
    the first step regimes are as likely as the chain has them in the long run. Values are given by kind,
    ``(..., L + 1 + M + J)``: each level, any other motion, each manoeuvre, each jump; so they fit banks of any size.

    Tensors of regimes have the axes of ``Hypotheses``.

    Args:
        motions: their number, ``K``.
        noise_levels: ``(..., L)`` by which the variance of the first motion's process noise is multiplied, ascending.
        jump_factors: ``(..., J)`` times the normalised innovation squared per element: by so much, at least 1, the
            covariance of the predicted position is multiplied; its correlations stay.
        self_transition: self-transition probabilities by kind, of a step, whatever its ``dt``.
        durations: instead of these, mean seconds by kind until a regime ends: a Markov chain in continuous time.
        restart: restart distribution by kind, which sums to one; other motions share theirs evenly.
        manoeuvre_factors: ``(..., M)`` times the normalised innovation squared per element: by so much, at least 1, the
            variance of the last level's process noise is multiplied.  Beyond five standard deviations a manoeuvre is
            the rarer the larger it is: what is far off once is an outlier.

    Raises:
        ValueError: shapes that do not go together, values that are out of their range or do not sum to one, or not one
            of ``self_transition`` and ``durations``.
    """

    self_transition: Hyper | None
    """None if it was made with ``durations``."""
    durations: Hyper | None
    """None if it was made with ``self_transition``."""

    def __init__(
        self, motions: int, *, noise_levels: Values, jump_factors: Values, restart: Values,
        self_transition: Values | None = None, durations: Values | None = None, manoeuvre_factors: Values = (),
    ) -> None:  # fmt: skip
        super().__init__()
        ends, last = one_given(self_transition=self_transition, durations=durations)
        given = noise_levels, manoeuvre_factors, jump_factors, last, restart
        levels, manoeuvres, jumps, last, begins = (torch.as_tensor(x, dtype=torch.float64) for x in given)
        for name, value in (("noise_levels", levels), ("manoeuvre_factors", manoeuvres), ("jump_factors", jumps)):
            if value.dim() == 0:
                raise ValueError(f"{name}: expected several, received {value.item():g}")
        self.motions, self.level_count = motions, levels.shape[-1]
        self.manoeuvre_count, self.jump_count = manoeuvres.shape[-1], jumps.shape[-1]
        kinds = self.level_count + 1 + self.manoeuvre_count + self.jump_count
        for name, value in ((ends, last), ("restart", begins)):
            if value.shape[-1:] != (kinds,):
                raise ValueError(f"{name}: expected (..., {kinds}), received {tuple(value.shape)}")
        self.motion_of = (0,) * self.level_count + tuple(range(1, motions)) + (0,) * (kinds - self.level_count - 1)
        """The number of each regime's motion."""
        self.regimes_of = tuple(
            tuple(r for r, k in enumerate(self.motion_of) if k == motion) for motion in range(motions)
        )
        """The numbers of each motion's regimes."""
        self.kind_of = (
            *range(self.level_count),
            *(self.level_count,) * (motions - 1),
            *range(self.level_count + 1, kinds),
        )
        """The kind of each regime."""
        self.noise_levels = Hyper(levels, event_dim=1, name="noise_levels")
        self.manoeuvre_factors = None
        if self.manoeuvre_count:
            self.manoeuvre_factors = Hyper(manoeuvres, event_dim=1, name="manoeuvre_factors")
        self.jump_factors = Hyper(jumps, event_dim=1, name="jump_factors")
        self.self_transition = self.durations = None
        if ends == "durations":
            self.durations = mean_durations(last, 1, ends)
        else:
            self.self_transition = Hyper(last, constraints.unit_interval, event_dim=1, name=ends)
        self.restart = Hyper(begins, constraints.simplex, event_dim=1, name="restart")

    @property
    def agile(self) -> int:
        """The number of the first motion's last level, from which manoeuvres and jumps start."""
        return self.level_count - 1

    # ------------------------------------------------------------ the Markov chain

    def restart_distribution(self, like: Tensor) -> Tensor:
        """The restart distribution ``(R, ...)``, which sums to one, for ``like (R, ...)``."""
        odds = self._by_regime(self.restart(like), like.dim() - 1)
        others = torch.tensor([float(self.motions - 1) if k else 1.0 for k in self.motion_of]).to(odds)
        odds = odds / others.reshape(-1, *(1,) * (odds.dim() - 1))
        return odds / odds.sum(0)  # one motion has no others

    def initial_distribution(self, like: Tensor) -> Tensor:
        """Probabilities ``(R, ...)`` of the regimes before the first step, for ``like (R, ...)``.

        It is the stationary distribution of the chain: how often each begins, times how long it stays.  A chain that
        may begin a regime that never ends is in one from the first step on.
        """
        rank, restart = like.dim() - 1, self.restart_distribution(like)
        if self.durations is not None:
            weight = restart * self._by_regime(self.durations(like), rank)
            stationary: Tensor = weight / weight.sum(0)
            return stationary
        assert self.self_transition is not None
        ends = 1 - self._by_regime(self.self_transition(like), rank)
        for_ever = (ends == 0) & (restart > 0)
        weight = torch.where(for_ever.any(0), torch.where(for_ever, restart, 0.0), safe_divide(restart, ends))
        return weight / weight.sum(0)

    def chain(self, like: Tensor, dt: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Of a chain of steps the self-transition probabilities and the restart distribution, both ``(R, ...)``.

        No level, manoeuvre or jump begins where nothing is measured, or what measurements have told of them would be
        forgotten over steps without one.  Other motions do: the longer a gap is, the less is known.  Over 0 seconds
        every regime goes on.

        Args:
            like: ``(R, ...)``.
            dt: ``(...)`` seconds.
            measured: ``(...)`` whether anything is.
        """
        assert self.self_transition is not None
        stay, restart = self._by_regime(self.self_transition(like), like.dim() - 1), self.restart_distribution(like)
        other = torch.tensor([k > 0 for k in self.motion_of], device=like.device).reshape(-1, *(1,) * (like.dim() - 1))
        others = torch.where(other, restart, 0.0)
        share = others.sum(0)
        stay = torch.where(measured, stay, 1 - (1 - stay) * share)
        return torch.where(dt == 0, 1.0, stay), torch.where(measured, restart, safe_divide(others, share))

    def continuous(self, like: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Of a chain in continuous time: probabilities that regimes last, and that others are there at the end.

        Motions other than the first are alike, so that the chain of the kinds says all.

        Returns:
            ``(R, ...)`` that a regime does not end in a step, and ``(R now, R was, ...)`` that one has ended and
            another, or the same, is there after it; their sum is one of the chain's ``exp(G dt)``.
        """
        rank = like.dim() - 1
        durations, restart = self.durations(like), self.restart(like)  # type: ignore[misc]
        if self.motions == 1:  # which has no others
            there = torch.tensor([float(k != self.level_count) for k in range(restart.shape[-1])]).to(restart)
            restart = restart * there / (restart * there).sum(-1, keepdim=True)
        lasts = torch.exp(-dt.unsqueeze(-1) / durations)
        ended = (over_seconds(rates(durations, restart.unsqueeze(-2)), dt) - torch.diag_embed(lasts)).clamp_min(0.0)
        each = [
            ended[..., kind] / (self.motions - 1 if motion else 1)
            for kind, motion in zip(self.kind_of, self.motion_of, strict=True)
        ]
        return self._by_regime(lasts, rank), torch.stack([self._by_regime(x, rank) for x in each])

    def moves(self, log_weight: Tensor, dt: Tensor, measured: Tensor) -> Moves:
        """How regimes ``(1, R, 2, ...)`` with such weights go over into those of the next step."""
        top = largest(log_weight, MOTION, keepdim=True)
        weight = (log_weight - top).exp()
        if self.durations is not None:
            lasts, ended = self.continuous(weight[0], dt)
            stayed, restarted = lasts * weight, (ended * weight).sum(1).unsqueeze(0)
            return Moves(stayed, weight - stayed, restarted, safe_log(stayed + restarted) + top)
        stay, restart = self.chain(weight[0], dt, measured)
        stayed, left = stay * weight, (1 - stay) * weight
        restarted = left.sum(MOTION, keepdim=True) * restart
        return Moves(stayed, left, restarted, safe_log(stayed + restarted) + top)

    def transition(self, like: Tensor, dt: Tensor, measured: Tensor) -> Tensor:
        """Logs ``(R now, 2, R before, ...)`` of how regimes follow each other, for ``like (R, 2, ...)``."""
        if self.durations is None:
            stay, restart = self.chain(like, dt, measured)
            stay = stay.movedim(0, 1)
            ended = restart.unsqueeze(2) * (1 - stay)
        else:
            stay, ended = self.continuous(like, dt)
            stay, ended = stay.movedim(0, 1), ended.movedim(1, 2)
        count = stay.shape[1]
        same = torch.eye(count, dtype=stay.dtype, device=stay.device)
        return safe_log(same.reshape(count, 1, count, *(1,) * (stay.dim() - 2)) * stay + ended)

    def rarer(self, log_weight: Tensor, nis: Tensor) -> Tensor:
        """Log weights ``(..., R, 2, ...)`` with odds of jumps and manoeuvres that fall with their size.

        Args:
            log_weight: before it is known how far off the measurement is.
            nis: ``(1, 1, 2, ...)`` normalised innovation squared per element, of the agile level.
        """
        manoeuvre, jump = ((nis / usual).clamp_min(1.0).log() for usual in (USUAL_MANOEUVRE, USUAL_JUMP))
        return log_weight - self._of_kinds(0.0, 2 * manoeuvre, jump)

    # ------------------------------------------------------------ predictions

    def agile_prediction(self, ahead: Carried) -> Gaussian:
        """Of the first motion's last level, ``(1, 1, 2, ..., n)``, from each motion's ``(1, K, 2, ...)``."""
        noise = self.noise_levels(ahead.mean)[..., -1].sqrt()[..., None, None] * ahead.process_noise[:, :1]
        return Gaussian(ahead.mean[:, :1], tria(hstack(ahead.spread[:, :1], noise)))

    def predictions(self, ahead: Carried, nis: Tensor, position: slice) -> Gaussian:
        """Of every regime the prediction ``(1, R, 2, ..., n)``.

        A manoeuvre or a jump that is wider than what is measured asks for would never be contradicted where little can
        be told from the measurement, or nothing at all, and widen the estimate without bound.

        Args:
            ahead: ``(1, K, 2, ...)`` of each motion.
            nis: ``(1, 1, 2, ...)`` normalised innovation squared per element, of the agile level.
            position: which components of a state are its position.
        """
        noise = self._noise_factors(ahead.mean, nis) * self.of_motions(ahead.process_noise)
        root = tria(hstack(self.of_motions(ahead.spread), noise))
        widths = self._widths(ahead.mean, nis, position)
        return Gaussian(self.of_motions(ahead.mean), widths * root)  # scaled rows of a lower root: still one

    def carried(self, ahead: Carried, nis: Tensor, position: slice) -> Carried:
        """The parts of ``predictions``."""
        widths = self._widths(ahead.mean, nis, position)
        noise = self._noise_factors(ahead.mean, nis) * self.of_motions(ahead.process_noise)
        return Carried(self.of_motions(ahead.mean), widths * self.of_motions(ahead.spread), widths * noise, None)

    def _noise_factors(self, mean: Tensor, nis: Tensor) -> Tensor:
        """Factors ``(1, R, 2, ..., 1, 1)`` on the root of the process noise."""
        rank = nis.dim() - 2
        levels = in_front(self.noise_levels(mean), rank).unsqueeze(0)
        manoeuvres = []
        if self.manoeuvre_factors is not None:
            levels = levels.expand(1, self.level_count, *nis.shape[2:])
            asked = in_front(self.manoeuvre_factors(mean), rank).unsqueeze(0) * nis
            manoeuvres = [levels[:, -1:] * asked.clamp(1.0, FURTHEST)]
        others = [torch.ones_like(levels[:, :1])] * (self.motions - 1)
        every = torch.cat([levels, *others, *manoeuvres, *[levels[:, -1:]] * self.jump_count], MOTION)
        return every.sqrt()[..., None, None]

    def _widths(self, mean: Tensor, nis: Tensor, position: slice) -> Tensor:
        """Factors ``(1, R, 2, ..., n, 1)`` on the rows of roots."""
        jumps = in_front(self.jump_factors(mean), nis.dim() - 2).unsqueeze(0)
        widths = self._of_kinds(1.0, torch.ones_like(nis), (jumps * nis).clamp(1.0, FURTHEST).sqrt())
        there = torch.zeros(mean.shape[-1], dtype=mean.dtype, device=mean.device)
        there[position] = 1.0
        return (1 + (widths.unsqueeze(-1) - 1) * there).unsqueeze(-1)

    # ------------------------------------------------------------ regimes and their motions

    def of_motions(self, x: Tensor, axis: int = MOTION) -> Tensor:
        """Of motions along an axis what goes with each regime."""
        return torch.stack([x.select(axis, motion) for motion in self.motion_of], axis)

    def by_motion(self, weight: Tensor) -> Tensor:
        """Of weights ``(1, R, 2, ...)`` the sum of each motion, ``(1, K, 2, ...)``."""
        return torch.stack([sum(weight[:, r] for r in regimes) for regimes in self.regimes_of], MOTION)  # type: ignore[misc]

    def log_by_motion(self, log_weight: Tensor, axis: int = MOTION) -> Tensor:
        """The same of logs of weights, along an axis."""
        each = [torch.stack([log_weight.select(axis, r) for r in regimes], axis) for regimes in self.regimes_of]
        return torch.stack([log_sum(x, axis) for x in each], axis)

    def merged(self, every: Hypotheses, angles: Sequence[int]) -> Hypotheses:
        """Hypotheses ``(2, R, 2, ...)`` merged into one for each motion, whatever was before: ``(2, K, 1, ...)``."""
        motions = [every.of(regimes).merged(MOTION, BEFORE, angles=angles) for regimes in self.regimes_of]
        belief = Gaussian(*(torch.cat(x, MOTION) for x in zip(*(one.belief for one in motions), strict=True)))
        return Hypotheses(belief, torch.cat([one.log_weight for one in motions], MOTION))

    def _by_regime(self, kinds: Tensor, rank: int) -> Tensor:
        """Values by kind ``(..., L + 1 + M + J)`` as ``(R, ...)`` of so many dimensions behind the first."""
        values = in_front(kinds, rank)
        return torch.stack([values[kind] for kind in self.kind_of])

    def _of_kinds(self, others: float, manoeuvres: Tensor, jumps: Tensor) -> Tensor:
        """Values ``(1, R, 2, ...)``: of manoeuvres and jumps ``(1, 1 or M, 2, ...)``, and of all others."""
        batch = jumps.shape[2:]
        manoeuvres = manoeuvres.expand(1, self.manoeuvre_count, *batch)
        jumps = jumps.expand(1, self.jump_count, *batch)
        rest = jumps.new_full((1, self.level_count + self.motions - 1, *batch), others)
        return torch.cat([rest, manoeuvres, jumps], MOTION)


def in_front(values: Tensor, rank: int) -> Tensor:
    """Values ``(..., C)`` of tracks as ``(C, ...)``, to go before tensors of ``rank`` dimensions that end in tracks."""
    values = values.movedim(-1, 0)
    return values.reshape(values.shape[:1] + (1,) * (rank + 1 - values.dim()) + values.shape[1:])

"""Regimes of a motion: levels of its process noise, the other motions of a bank, climbs, manoeuvres and jumps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra import tree
from torchfra.filters.gpb.hypotheses import BEFORE, MOTION, Hypotheses, taken, values_first
from torchfra.filters.gpb.outliers import EXPECTED
from torchfra.filters.markov import generator, sojourn_times, transition_over
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import largest, log_sum
from torchfra.gaussian.model import Propagated
from torchfra.hyper import Hyper, Part, Value, Values, once, one_given
from torchfra.linalg.safe import safe_divide, safe_log, safe_sqrt
from torchfra.linalg.triangular import hstack, tria
from torchfra.motion.base import Motion
from torchfra.numbers import as_numbers, as_tensor
from torchfra.types import Gaussian, Whitened

LARGEST_FACTOR = 1e10
"""Largest factor of a jump, a manoeuvre or an outlying prior on a covariance, whatever the innovation."""
SOONER = 0.7
"""By how many outliers a jump is likelier than one more than the longest burst: above 1/2, as measurements after a jump
are rather less likely than expected, by noise that is stated wrongly say, than more."""
FASTER = 3.0
"""Standard deviation of the velocity after a jump, in those of the speed before, at least; of the acceleration too."""
NEVER = 1e-12
"""Probability at a restart up to which a jump hardly ever begins, however far off a measurement is."""
MANOEUVRE_NIS = 30.0
"""Normalised innovation squared beyond which the weight of a manoeuvre falls with its size."""


class Surprise(NamedTuple):
    """How far a measurement is from its prediction by the agile level, which manoeuvres and jumps scale with."""

    nis: Tensor
    """``(1, 1, 2, ...)`` normalised innovation squared per element."""
    rarity: Tensor
    """``(1, 1, 2, ...)`` log of the factor on the weight of a jump: see ``Regimes.rarity``."""
    cost: Tensor
    """``(1, 1, 2, ...)`` log of how much less likely it is as outliers than as stated: see ``Outliers.cost``."""


class Jumped(NamedTuple):
    """What a jump costs by itself, as logs of how much less likely measurements are: ``(1, 1, 2, ...)``."""

    expected: Tensor
    """Twice that of an element as stated, beside its noise alone."""
    own: Tensor
    """Of the measurement with which it comes, as a place that is as far off, beside that as stated."""
    lost: Tensor
    """Of the measurements of the longest burst and the next one, as it knows less of the velocity and of the
    acceleration than was stated, or than they themselves tell."""


class Switching(NamedTuple):
    """How probability moves between regimes from one step to the next: weights ``(1, R, 2, ...)`` up to one factor."""

    stayed: Tensor
    """Weight of each regime that continues."""
    ended: Tensor
    """Weight of each regime that ends."""
    restarted: Tensor
    """Weight with which each regime begins after another has ended."""
    log_weight: Tensor
    """Logs of the weights of the regimes in the next step, ``stayed + restarted``, without the common factor."""


class Regimes(Part):
    """The Markov chain of a step's regime: levels of process noise, motions of a bank, climbs, manoeuvres and jumps.

    There are ``R = L + (K - 1) + C + M + J`` regimes, in this order.  The first motion has ``L`` levels of process
    noise, the last of which is called the agile level.  Each other motion of a bank is one regime, and so is each of
    ``C`` climbs (below).  In each of ``M`` manoeuvres the process noise of the agile level is multiplied in proportion
    to the normalised innovation squared; so is the covariance of the predicted position in each of ``J`` jumps.  A
    regime continues with its self-transition probability, or a mean sojourn time; then the next one is drawn from the
    restart distribution.  The chain starts from its stationary distribution.  Self-transition probabilities or sojourn
    times and the restart distribution are given by kind, ``(..., L + 1 + M + J)``: each level, any other motion, each
    manoeuvre, each jump; so they fit banks of any size.  For three or more motions they may be by regime instead,
    ``(..., R - C)``, as for a bank of one motion at several ``q``, which are levels with separate beliefs.

    The levels of a motion share a belief, except for ``separate_levels``, which keep beliefs of their own: while a
    target moves as calmly as such a level states, the covariance of its belief shrinks accordingly, and while it is as
    agile, its mean follows.  So there are ``S = K + (separate levels) + C`` beliefs: of each motion, of these levels,
    then of climbs.

    If ``vertical`` components are given, each separate level that is lower than all others has a climb beside it; else
    ``C`` is 0.  In a climb the vertical process noise is the stated one and all other noise that of the level: a sensor
    with precise ranges or range rates and a coarse elevation shows a turn at once and a climb late.  A climb has a
    belief of its own, and the level's self-transition probability; the two share its entry of the restart distribution.

    Tensors of regimes have the axes of ``Hypotheses``.

    Args:
        motions: number of motions, ``K``.
        noise_levels: ``(..., L)`` factors on the variance of the first motion's process noise, ascending.
        jump_factors: ``(..., J)`` factors on the covariance of the predicted position per unit of the normalised
            innovation squared per element; the product is 1 at least.  Correlations of the position stay.
        self_transition: self-transition probabilities by kind or regime, of a step, whatever its ``dt``.
        durations: instead of these, mean sojourn times, s, by kind or regime: a Markov chain in continuous time.
        restart: restart distribution, by kind or regime as these are, which sums to one; by kind, other motions share
            theirs evenly, and a level with its climb.
        manoeuvre_factors: ``(..., M)`` factors on the variance of the last level's process noise per unit of the
            normalised innovation squared per element; the product is 1 at least.  Beyond five standard deviations its
            weight falls with its size, as a single large innovation is rather an outlier.
        burst: how many equal outliers in a row are taken for outliers; measurements that stay where they are for longer
            are taken for a jump.
        separate_levels: the levels with beliefs of their own, fewer than all: the number of the lowest, or the indices
            of any.
        vertical: components of a state that are vertical, such as ``Motion.vertical``; none if there are no climbs.

    Raises:
        ValueError: shapes that do not go together, values that are out of their range or do not sum to one, or not one
            of ``self_transition`` and ``durations``.
    """

    self_transition: Hyper | None
    """None if ``durations`` were given."""
    durations: Hyper | None
    """None if ``self_transition`` was given."""

    def __init__(
        self, motions: int, *, noise_levels: Values, jump_factors: Values, restart: Values,
        self_transition: Values | None = None, durations: Values | None = None, manoeuvre_factors: Values = (),
        burst: Value = 4.0, separate_levels: int | Sequence[int] = 0, vertical: Sequence[int] = (),
    ) -> None:  # fmt: skip
        super().__init__()
        sojourn, stay = one_given(self_transition=self_transition, durations=durations)
        arguments = {
            "noise_levels": noise_levels, "manoeuvre_factors": manoeuvre_factors, "jump_factors": jump_factors,
            sojourn: stay, "restart": restart,
        }  # fmt: skip
        levels, manoeuvres, jumps, stay, begin = (as_numbers(x, name).double() for name, x in arguments.items())
        for name, value in (("noise_levels", levels), ("manoeuvre_factors", manoeuvres), ("jump_factors", jumps)):
            if value.dim() == 0:
                raise ValueError(f"{name}: expected a sequence of numbers, received {value.item():g}")
        self.motions, self.level_count = motions, levels.shape[-1]
        self.manoeuvre_count, self.jump_count = manoeuvres.shape[-1], jumps.shape[-1]
        own = _levels(separate_levels, self.level_count)
        kinds = self.level_count + 1 + self.manoeuvre_count + self.jump_count
        count = kinds + motions - 2  # of regimes
        self.by_kind = motions < 3 or stay.shape[-1:] != (count,)
        expected = f"(..., {kinds})" if motions < 3 else f"(..., {kinds}), or of each regime (..., {count})"
        for name, value in ((sojourn, stay), ("restart", begin)):
            if value.shape[-1:] != (kinds if self.by_kind else count,):
                raise ValueError(f"{name}: expected {expected}, received {tuple(value.shape)}")
        calm = sum(level == i for i, level in enumerate(own))  # lower than all others
        self.vertical, self.climb_count = tuple(vertical), calm if vertical else 0
        scaled = self.manoeuvre_count + self.jump_count  # regimes whose covariance scales with the innovation
        self.motion_of = (0,) * self.level_count + tuple(range(1, motions)) + (0,) * (self.climb_count + scaled)
        """The index of each regime's motion."""
        self.beliefs = motions + len(own) + self.climb_count
        """The number of beliefs, ``S``."""
        levels_own = (motions + own.index(i) if i in own else 0 for i in range(self.level_count))
        climbs = range(motions + len(own), self.beliefs)
        self.belief_of = (*levels_own, *range(1, motions), *climbs, *(0,) * scaled)
        """The index of each regime's belief."""
        self.of_first = tuple(r for r, k in enumerate(self.belief_of) if k == 0)
        """The indices of the first belief's regimes."""
        self.of_others = tuple(self.belief_of.index(belief) for belief in range(1, self.beliefs))
        """The index of the only regime of each other belief."""
        others = [self.level_count] * (motions - 1) if self.by_kind else range(self.level_count, count - scaled)
        last = (kinds if self.by_kind else count) - scaled
        self.kind_of = (*range(self.level_count), *others, *range(self.climb_count), *range(last, last + scaled))
        """The index of each regime's values."""
        self.sharing = tuple(float(self.kind_of.count(kind)) for kind in self.kind_of)
        """The number of regimes that share each regime's entry of the restart distribution."""
        self.noise_levels = Hyper(levels, event_dim=1, finite=True, name="noise_levels")
        self.manoeuvre_factors = None
        if self.manoeuvre_count:
            self.manoeuvre_factors = Hyper(manoeuvres, event_dim=1, name="manoeuvre_factors")
        self.jump_factors = Hyper(jumps, event_dim=1, name="jump_factors")
        self.burst = Hyper(burst, constraints.greater_than_eq(SOONER), name="burst")
        self.self_transition = self.durations = None
        if sojourn == "durations":
            self.durations = sojourn_times(stay, 1, sojourn)
        else:
            self.self_transition = Hyper(stay, constraints.unit_interval, event_dim=1, name=sojourn)
        self.restart = Hyper(begin, constraints.simplex, event_dim=1, name="restart")

    # ------------------------------------------------------------ the Markov chain

    @once
    def restart_distribution(self, like: Tensor) -> Tensor:
        """The restart distribution ``(R, ...)``, which sums to one, for ``like (R, ...)``."""
        odds = self._by_regime(self.restart(like), like.dim() - 1)
        odds = odds / as_tensor(self.sharing, odds).reshape(-1, *(1,) * (odds.dim() - 1))
        return odds / odds.sum(0)  # of a single motion the kind "any other motion" has no regime

    def initial_distribution(self, like: Tensor) -> Tensor:
        """Probabilities ``(R, ...)`` of the regimes before the first step, for ``like (R, ...)``.

        It is the stationary distribution of the chain: restart probability times mean sojourn time, normalised.  If a
        regime that may begin is absorbing, the chain is in an absorbing regime from the first step on.
        """
        restart = self.restart_distribution(like)
        if self.durations is not None:
            weight = restart * self._by_regime(self.durations(like), like.dim() - 1)
            stationary: Tensor = weight / weight.sum(0)
            return stationary
        end = 1 - self._stay(like)
        absorbing = (end == 0) & (restart > 0)
        weight = torch.where(absorbing.any(0), torch.where(absorbing, restart, 0.0), safe_divide(restart, end))
        return weight / weight.sum(0)

    def discrete(self, like: Tensor, dt: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Self-transition probabilities and restart distribution, both ``(R, ...)``, of a chain that counts steps.

        No level, climb, manoeuvre or jump begins in a step without a measurement; otherwise their posterior
        probabilities would decay over a gap.  Other motions may begin: the uncertainty of the motion grows with a gap.
        Over 0 seconds every regime continues.

        Args:
            like: ``(R, ...)``.
            dt: ``(...)`` seconds.
            measured: ``(...)`` bool, whether the step has a measurement.
        """
        stay, restart = self._stay(like), self.restart_distribution(like)
        others, share = self._other_motions(like)
        stay = torch.where(measured, stay, 1 - (1 - stay) * share)
        return torch.where(dt == 0, 1.0, stay), torch.where(measured, restart, safe_divide(others, share))

    @once
    def _stay(self, like: Tensor) -> Tensor:
        """Self-transition probabilities ``(R, ...)`` of a step, for ``like (R, ...)``."""
        return self._by_regime(self.self_transition(like), like.dim() - 1)  # type: ignore[misc]  # there is one

    @once
    def _other_motions(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """The restart distribution without the first motion's regimes, ``(R, ...)``, and its sum ``(...)``."""
        other = torch.tensor([k > 0 for k in self.motion_of], device=like.device).reshape(-1, *(1,) * (like.dim() - 1))
        others = torch.where(other, self.restart_distribution(like), 0.0)
        return others, others.sum(0)

    def continuous(self, like: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Transition probabilities over ``dt (...)`` seconds of a chain in continuous time, for ``like (R, ...)``.

        Regimes of one kind have the same rates, so the chain over kinds is enough.

        Returns:
            ``(R, ...)`` probability that a regime does not end within the step, and ``(R now, R was, ...)`` probability
            that it ends and the regime at the end of the step is this one.  Together they are ``exp(G dt)``.
        """
        rank = like.dim() - 1
        durations, restart = self.durations(like), self.restart(like)  # type: ignore[misc]
        if self.motions == 1:  # the kind "any other motion" has no regime
            present = as_tensor([float(k != self.level_count) for k in range(restart.shape[-1])], restart)
            restart = restart * present / (restart * present).sum(-1, keepdim=True)
        lasts = torch.exp(-dt.unsqueeze(-1) / durations)
        ended = (transition_over(generator(durations, restart.unsqueeze(-2)), dt) - torch.diag_embed(lasts)).clamp_min(
            0.0
        )
        each = [ended[..., kind] / sharing for kind, sharing in zip(self.kind_of, self.sharing, strict=True)]
        return self._by_regime(lasts, rank), torch.stack([self._by_regime(x, rank) for x in each])

    def switch(self, log_weight: Tensor, dt: Tensor, measured: Tensor) -> Switching:
        """How regimes with log weights ``(1, R, 2, ...)`` switch between two steps ``dt (...)`` seconds apart.

        Args:
            log_weight: of the regimes before.
            dt: seconds.
            measured: ``(...)`` bool, whether the next step has a measurement.
        """
        top = largest(log_weight, MOTION, keepdim=True)
        weight = (log_weight - top).exp()
        if self.durations is not None:
            lasts, ended = self.continuous(weight[0], dt)
            stayed, restarted = lasts * weight, (ended * weight).sum(1).unsqueeze(0)
            return Switching(stayed, weight - stayed, restarted, safe_log(stayed + restarted) + top)
        stay, restart = self.discrete(weight[0], dt, measured)
        stayed, ended = stay * weight, (1 - stay) * weight
        restarted = ended.sum(MOTION, keepdim=True) * restart
        return Switching(stayed, ended, restarted, safe_log(stayed + restarted) + top)

    def transition(self, like: Tensor, dt: Tensor, measured: Tensor) -> Tensor:
        """Logs ``(R now, 2, R before, ...)`` of the transition probabilities, for ``like (R, 2, ...)``."""
        if self.durations is None:
            stay, restart = self.discrete(like, dt, measured)
            stay = stay.movedim(0, 1)
            ended = restart.unsqueeze(2) * (1 - stay)
        else:
            stay, ended = self.continuous(like, dt)
            stay, ended = stay.movedim(0, 1), ended.movedim(1, 2)
        count = stay.shape[1]
        same = torch.eye(count, dtype=stay.dtype, device=stay.device)
        return safe_log(same.reshape(count, 1, count, *(1,) * (stay.dim() - 2)) * stay + ended)

    def jumped(
        self, propagated: Propagated, agile: Gaussian, compared: Whitened, nis: Tensor, frame: Frame, motion: Motion
    ) -> Jumped:
        """What a jump costs by itself, in the step in which it comes and after it.

        Args:
            propagated: ``(1, S, 2, ...)``, each belief by its motion.
            agile: ``(1, 1, 2, ..., n)`` prediction by the agile level.
            compared: the measurement compared with it.
            nis: ``(1, 1, 2, ...)`` normalised innovation squared per element, by that prediction.
            frame: of the step.
            motion: as in ``predictions``.
        """
        position = range(motion.size)[motion.position]
        stated = hstack(propagated.spread[:, :1], propagated.process_noise[:, :1]).square().sum(-1)
        here = self._chosen(position, stated)
        place, before = ((here * x).sum(-1) for x in (agile.scale_tril.square().sum(-1), stated))
        seen, count = compared.spread.square().sum((-2, -1)), frame.measured.sum(-1)
        expected = safe_divide(seen * safe_divide(before, place), count).log1p().clamp(max=EXPECTED)
        if not self.jump_count:
            return Jumped(expected, torch.zeros_like(seen), torch.zeros_like(seen))
        widths = self._widths(propagated, nis, motion)[:, -1:]
        # The diagonal of the root: what a component varies by where those before it are known, as after a measurement.
        variances = (widths * agile.scale_tril).diagonal(dim1=-2, dim2=-1).square()
        told, lost = safe_divide(place, seen), torch.zeros_like(seen)
        for order, components in enumerate(_derivatives(motion), 1):
            enough = told * safe_divide(_told(order, self.burst(seen) + 1), frame.dt ** (2 * order))
            known = torch.where((seen > 0).unsqueeze(-1), torch.maximum(stated, enough.unsqueeze(-1)), variances)
            less = 0.5 * safe_divide(variances, known).clamp_min(1.0).log()
            lost = lost + (self._chosen(components, less) * less).sum(-1)
        free = count.clamp(1.0, motion.dims)
        wider = widths[..., position.start, 0].square() * seen / free
        return Jumped(expected, 0.5 * free * (wider.log1p() - 1 - expected), lost)

    def rarity(self, cost: Tensor, beyond: Tensor, first: Tensor, jumped: Jumped) -> Tensor:
        """Log ``(1, 1, 2, ...)`` of the factor on the weight of a jump, so that it is as rare as a burst of outliers.

        A jump and a burst of equal outliers are the same until the burst ends.  With its own density it is as rare as
        ``burst + 1 - SOONER`` outliers: it is less likely than outliers at the last measurement of the longest burst,
        and more likely at the next one, unless the tail of the agile level is likelier than both.  What it will have
        lost by then is given before, where a measurement is beyond the least of outliers (nearer by, the target need
        not have jumped).

        Args:
            cost: ``(1, 1, 2, ...)`` log of how much less likely the measurement is as an outlier than as stated: see
                ``Outliers.cost``.  It is 0 without a measurement.
            beyond: by how much that is above its least, as of the smallest outliers beside which a jump is seen.
            first: ``(...)`` log of how much rarer the first outlier is: see ``Outliers.first_rarer``.
            jumped: what the jump costs by itself.
        """
        if not self.jump_count:
            return -cost
        held = cost < torch.inf  # else it is an outlier, and nothing else has a gradient
        cost, beyond = torch.where(held, cost, 0.0), torch.where(held, beyond, 0.0)
        burst, given = self.burst(cost) - SOONER, jumped.own - cost + jumped.lost - first
        rarity = torch.where(cost > 0, beyond.clamp(0.0, 1.0) * given - cost * burst, 0.0)
        return torch.where(held, rarity, -torch.inf)

    def penalised(self, log_weight: Tensor, surprise: Surprise) -> Tensor:
        """Log weights ``(..., R, 2, ...)`` in which large jumps and manoeuvres are less likely.

        Their covariances scale with the innovation, so they would explain one of any size equally well.  The weight of
        a manoeuvre falls as ``1 / nis^2`` beyond its limit.  A jump may come with any measurement, whatever the time
        since the last one, as outliers may: its weight is that of all regimes, times its ``rarity``, and its share of
        the jumps that begin.

        Args:
            log_weight: of the regimes by the Markov chain alone.
            surprise: of the measurement.
        """
        manoeuvre = -2 * (surprise.nis / MANOEUVRE_NIS).clamp_min(1.0).log()
        others = log_weight + self._of_kinds(0.0, manoeuvre, torch.zeros_like(manoeuvre))
        if not self.jump_count:
            return others
        chain = log_weight.narrow(MOTION, -self.jump_count, self.jump_count)
        restart = self.restart_distribution(log_weight[0])[-self.jump_count :]
        share = safe_log(restart / (restart.sum(0) + NEVER)).unsqueeze(0)
        jumps = log_sum(log_weight, MOTION).unsqueeze(MOTION) + share + surprise.rarity
        jumps = torch.where(surprise.rarity == 0, chain, jumps)  # without a measurement the chain goes on as it is
        return torch.cat([others.narrow(MOTION, 0, len(self.motion_of) - self.jump_count), jumps], MOTION)

    # ------------------------------------------------------------ predictions

    def agile_prediction(self, propagated: Propagated) -> Gaussian:
        """The prediction ``(1, 1, 2, ..., n)`` by the agile level, the last level of the first motion.

        Args:
            propagated: ``(1, S, 2, ...)``, each belief by its motion.
        """
        return Gaussian(propagated.mean[:, :1], tria(self.agile_root(propagated)))

    def agile_root(self, propagated: Propagated) -> Tensor:
        """A root ``(1, 1, 2, ..., n, p)`` of that prediction's covariance."""
        noise = self.noise_levels(propagated.mean)[..., -1].sqrt()[..., None, None] * propagated.process_noise[:, :1]
        return hstack(propagated.spread[:, :1], noise)

    def predictions(self, propagated: Propagated, nis: Tensor, motion: Motion) -> Gaussian:
        """The prediction ``(1, R, 2, ..., n)`` of every regime.

        Manoeuvres and jumps scale with the innovation: if they were wider than the innovation, a measurement with
        little information on the state, or a missing one, could not rule them out, and they would widen the estimate
        without bound.

        Args:
            propagated: ``(1, S, 2, ...)``, each belief by its motion.
            nis: ``(1, 1, 2, ...)`` normalised innovation squared per element, by the agile level.
            motion: says which components of a state are its position and its velocity.
        """
        # Columns may be of any scale; beside a triangle the noise leaves them so.
        root = self.per_regime(tria(propagated.spread))
        root = tria(hstack(root, self._noise(propagated, nis)), graded=False)
        widths = self._widths(propagated, nis, motion)
        return Gaussian(self.per_regime(propagated.mean), widths * root)  # with scaled rows a lower root stays one

    def predicted_parts(self, propagated: Propagated, nis: Tensor, motion: Motion) -> Propagated:
        """The parts ``(1, R, 2, ...)`` of which ``predictions`` are made, of the same arguments."""
        widths = self._widths(propagated, nis, motion)
        spread, noise = self.per_regime(propagated.spread), self._noise(propagated, nis)
        return Propagated(self.per_regime(propagated.mean), widths * spread, widths * noise, None)

    def _noise(self, propagated: Propagated, nis: Tensor) -> Tensor:
        """Roots ``(1, R, 2, ..., n, r)`` of the process noise of every regime."""
        return self._noise_factors(propagated.mean, nis) * self.per_regime(propagated.process_noise)

    def _noise_factors(self, mean: Tensor, nis: Tensor) -> Tensor:
        """Factors ``(1, R, 2, ..., n or 1, 1)`` on the root of the process noise of each regime's motion."""
        rank = nis.dim() - 2
        levels = values_first(self.noise_levels(mean), rank).unsqueeze(0)
        manoeuvres = []
        if self.manoeuvre_factors is not None:
            levels = levels.expand(1, self.level_count, *nis.shape[2:])
            factors = values_first(self.manoeuvre_factors(mean), rank).unsqueeze(0) * nis
            manoeuvres = [levels[:, -1:] * factors.clamp(1.0, LARGEST_FACTOR)]
        others = [torch.ones_like(levels[:, :1])] * (self.motions - 1)
        climbs = [levels[:, : self.climb_count]]
        every = torch.cat([levels, *others, *climbs, *manoeuvres, *[levels[:, -1:]] * self.jump_count], MOTION)
        factors = every.sqrt()[..., None, None]
        if not self.climb_count:
            return factors
        first = self.level_count + self.motions - 1
        climbing = range(first, first + self.climb_count)
        stated = torch.tensor(
            [[r in climbing and i in self.vertical for i in range(mean.shape[-1])] for r in range(len(self.motion_of))],
            device=mean.device,
        )
        return torch.where(stated.reshape(len(stated), *(1,) * (every.dim() - 2), -1, 1), 1.0, factors)

    def _widths(self, propagated: Propagated, nis: Tensor, motion: Motion) -> Tensor:
        """Factors ``(1, R, 2, ..., n, 1)`` on the rows of predicted roots: of position and its derivatives in a jump.

        A receiver that was reset moves as before, a target that was carried elsewhere in any direction, and faster: a
        standard deviation of the velocity is at least ``FASTER`` times the speed, if it is not multiplied by more than
        the position's; and so is one of the acceleration of its size.
        """
        mean, rank = propagated.mean, nis.dim() - 2
        jumps = values_first(self.jump_factors(mean), rank).unsqueeze(0)
        widths = self._of_kinds(1.0, torch.ones_like(nis), (jumps * nis).clamp(1.0, LARGEST_FACTOR).sqrt())
        widths = widths.unsqueeze(-1)
        std = safe_sqrt(self.agile_root(propagated).square().sum(-1))
        rows = 1 + (widths - 1) * self._chosen(range(motion.size)[motion.position], mean)
        for part in _derivatives(motion):
            those = self._chosen(part, mean)
            size = safe_sqrt((those * mean[:, :1]).square().sum(-1, keepdim=True))
            larger = safe_divide(FASTER * size, std).clamp_min(1.0)
            rows = rows + (torch.minimum(widths, larger) - 1) * those
        return rows.unsqueeze(-1)

    @staticmethod
    def _chosen(components: Sequence[int], like: Tensor) -> Tensor:
        """``(n,)`` 1 at these components, else 0."""
        return as_tensor([float(i in components) for i in range(like.shape[-1])], like)

    # ------------------------------------------------------------ regimes and their beliefs

    def per_regime(self, x: Tensor, axis: int = MOTION) -> Tensor:
        """Values of the ``S`` beliefs along an axis, repeated for each regime of a belief: ``R`` along that axis."""
        return taken(x, self.belief_of, axis)

    def by_belief(self, weight: Tensor) -> Tensor:
        """Weights ``(1, R, 2, ...)`` of regimes summed for each belief, ``(1, S, 2, ...)``."""
        return self._per_belief(weight, MOTION, lambda x: x.sum(MOTION, keepdim=True))

    def log_by_belief(self, log_weight: Tensor, axis: int = MOTION) -> Tensor:
        """Logs of weights of ``R`` regimes along an axis, summed for each of the ``S`` beliefs."""
        return self._per_belief(log_weight, axis, lambda x: log_sum(x, axis).unsqueeze(axis))

    def merged(self, every: Hypotheses, angles: Sequence[int], *, triangular: bool = True) -> Hypotheses:
        """Hypotheses ``(2, R, 2, ...)`` merged over regimes of a belief and the outlier before: ``(2, S, 1, ...)``.

        If not ``triangular``, their roots are ``(..., n, p)``, as in ``gaussian.mixture.matched``.
        """
        first = every.of(self.of_first).merged(MOTION, BEFORE, angles=angles, triangular=triangular)
        if not self.of_others:
            return first
        others = every.of(self.of_others).merged(BEFORE, angles=angles, triangular=triangular)
        wider = first.belief.scale_tril.shape[-1] - others.belief.scale_tril.shape[-1]
        if wider:
            others = others._replace(
                belief=others.belief._replace(scale_tril=pad(others.belief.scale_tril, (0, wider)))
            )
        both: Hypotheses = tree.map_tensors(lambda *parts: torch.cat(parts, MOTION), first, others)
        return both

    def _per_belief(self, x: Tensor, axis: int, combine: Callable[[Tensor], Tensor]) -> Tensor:
        """Values of regimes along an axis as those of beliefs: all regimes of the first belief are combined."""
        first = combine(taken(x, self.of_first, axis))
        return torch.cat([first, taken(x, self.of_others, axis)], axis) if self.of_others else first

    def _by_regime(self, kinds: Tensor, rank: int) -> Tensor:
        """Values by kind or regime as ``(R, ...)`` with ``rank`` dimensions behind the first."""
        return taken(values_first(kinds, rank), self.kind_of, 0)

    def _of_kinds(self, others: float, manoeuvres: Tensor, jumps: Tensor) -> Tensor:
        """Values ``(1, R, 2, ...)`` from those ``(1, 1 or more, 2, ...)`` of manoeuvres and jumps, and all others."""
        batch = jumps.shape[2:]
        manoeuvres = manoeuvres.expand(1, self.manoeuvre_count, *batch)
        jumps = jumps.expand(1, self.jump_count, *batch)
        rest = jumps.new_full((1, self.level_count + self.motions - 1 + self.climb_count, *batch), others)
        return torch.cat([rest, manoeuvres, jumps], MOTION)


def _derivatives(motion: Motion) -> tuple[Sequence[int], Sequence[int]]:
    """The components of a state that are velocities, and those that are accelerations."""
    components = range(motion.size)
    return components[motion.velocity], [i for i in components if motion.kinds[i] == "acceleration"]


def _told(order: int, count: Tensor) -> Tensor:
    """What positions at so many steps, each with a variance of 1, tell of a derivative: its variance, in steps.

    It is that of the coefficient of an orthogonal polynomial of this order, 1 or 2.
    """
    of = 12 / (count * (count.square() - 1))
    return of if order == 1 else 60 * of / (count.square() - 4).clamp_min(NEVER)


def _levels(separate: int | Sequence[int], count: int) -> tuple[int, ...]:
    """The indices of the separate levels, ascending.

    Raises:
        ValueError: not fewer than all ``count`` levels, or one that is none of them.
    """
    if isinstance(separate, Sequence):
        if all(i in range(count) for i in separate) and len(set(separate)) == len(separate) < max(count, 1):
            return tuple(sorted(separate))
    elif separate in range(max(count, 1)):
        return tuple(range(separate))
    raise ValueError(
        f"separate_levels: expected a number from 0 to {count - 1}, or so many different indices of {count} levels, "
        f"received {separate!r}"
    )

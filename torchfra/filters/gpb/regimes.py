"""Regimes of a motion: levels of its process noise, the other motions of a bank, climbs, manoeuvres and jumps."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import pad

from torchfra.filters.gpb.hypotheses import BEFORE, MOTION, Hypotheses, merge, taken, values_first
from torchfra.filters.gpb.outliers import EXPECTED
from torchfra.filters.markov import generator, sojourn_times, transition_over
from torchfra.gaussian.mixture import largest, log_sum, without_failed
from torchfra.gaussian.model import Propagated
from torchfra.gaussian.update import innovation
from torchfra.hyper import Hyper, Part, Value, Values, once, one_given
from torchfra.linalg.safe import safe_divide, safe_log, safe_sqrt
from torchfra.linalg.triangular import hstack, tria
from torchfra.motion.base import Motion
from torchfra.numbers import as_numbers, as_tensor
from torchfra.types import Gaussian, Whitened

LARGEST_FACTORS = {torch.float64: 1e14, torch.float32: 1e10}
"""Largest factor of a jump, a manoeuvre or an outlying prior on a covariance, whatever the innovation: gradients
of single precision hold no larger one."""
SOONER = 0.7
"""By how many outliers a jump is likelier than one more than the longest burst: above 1/2, as measurements after a jump
are rather less likely than expected, by noise that is stated wrongly say, than more."""
PRIOR_BURST = 2.0
"""How many equal outliers in a row at the beginning are taken for outliers: with one more the prior is off."""
AGILE_AFTER, AGILE_STAYS = 0.03, 0.5
"""Probabilities that a target that has jumped becomes as agile as the agile level, and that it is so in the next step
too: it may be too far off for a straight line of the sensor, much faster than before, or in a turn that goes on."""
NEARER = 0.01
"""How much rarer a jump is with a measurement that is nearer than the least of outliers: the target need not have
jumped."""
FASTER = 3.0
"""Standard deviation of the velocity after a jump, in those of the speed before, at least; of the acceleration too."""
LASTS = 2.0
"""Measurements that a level of a single motion lasts for at least, or some more: a chain in seconds moves on by no more
of the shortest sojourn time between two measurements.  If it went on, levels would be drawn anew with every measurement
where steps are long, and process noise that is stated wrongly would never be noticed."""
HEADING = 4.0
"""Log of how much wider a prediction may be, without any evidence against it, by a heading that is unknown, of a motion
without a velocity: if it were without bound, outliers that follow each other would be a path."""
NEVER = 1e-12
"""Probability at a restart up to which a jump hardly ever begins, however far off a measurement is."""
LANDED = ("jump", "settled")
"""Kinds of regimes of a target that has jumped, in the step of the jump and after it."""
MANOEUVRE_NIS = 30.0
"""Normalised innovation squared beyond which the weight of a manoeuvre falls with its size."""


class Regime(NamedTuple):
    """What a regime is; all but the first are indices, and regimes may share any of them."""

    kind: str
    """``"level"``, ``"motion"`` (another of the bank), ``"climb"``, ``"manoeuvre"``, ``"jump"`` or ``"settled"``."""
    belief: int
    """Into which it is merged after the step, and from which it predicts unless there is a ``source``."""
    level: int
    """Of the process noise; as many as there are levels for noise as the motion states it."""
    entry: int
    """Of self-transition probabilities or sojourn times, and of the restart distribution."""
    source: int | None = None
    """The belief from which it predicts, if it is another one: of a jump."""


class Surprise(NamedTuple):
    """How far a measurement is from its prediction as stated, which manoeuvres and jumps scale with."""

    nis: Tensor
    """``(1, 1, 2, ...)`` normalised innovation squared per element."""
    rarity: Tensor
    """``(1, 1, 2, ...)`` log of the factor on the weight of a jump: see ``Regimes.rarity``."""
    cost: Tensor
    """``(1, 1, 2, ...)`` log of how much less likely it is as outliers than as stated: see ``Outliers.cost``."""
    given: Tensor
    """``(1, 1, 2, ...)`` log of what a settled target is given back: see ``Regimes.unknown``."""


class Fit(NamedTuple):
    """How well a prediction explains a measurement, both in units of its noise."""

    width: Tensor
    """``(...)`` log of the root of the determinant of the innovation's covariance."""
    squares: Tensor
    """``(...)`` sum of squares of the normalised innovation."""

    @staticmethod
    def of(compared: Whitened) -> Fit:
        """By the measurement compared with the prediction."""
        root, normalised = innovation(compared)
        return Fit(root.diagonal(dim1=-2, dim2=-1).log().sum(-1), normalised.square().sum(-1))


class Jumped(NamedTuple):
    """What a jump costs by itself, as logs of how much less likely measurements are: ``(1, 1, 2, ...)``."""

    expected: Tensor
    """Twice that of an element as stated, beside its noise alone."""
    own: Tensor
    """Of the measurement with which it comes, as a place that is as far off, beside that as stated."""
    wide: Tensor
    """Of the measurement as stated, beyond ``expected``: the prediction is as wide as a prior may be."""
    burst: Tensor
    """How many measurements the longest burst has."""


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

    There are ``R = L + (K - 1) + C + M + J + D`` regimes, in this order.  The first motion has ``L`` levels of process
    noise, the last of which is called the agile level.  Each other motion of a bank is one regime, and so is each of
    ``C`` climbs (below).  In each of ``M`` manoeuvres the process noise is multiplied in proportion to the normalised
    innovation squared; so is the covariance of the predicted position in each of ``J`` jumps.  A regime
    continues with its self-transition probability, or a mean sojourn time; then the next one is drawn from the restart
    distribution.  The chain starts from its stationary distribution.  Self-transition probabilities or sojourn
    times and the restart distribution are given by kind, ``(..., L + 1 + M + J)``: each level, any other motion, each
    manoeuvre, each jump; so they fit banks of any size.  For three or more motions they may be by regime instead,
    ``(..., R - C - D)``, as for a bank of one motion at several ``q``, which are levels with separate beliefs.

    The levels of a motion share a belief, except for ``separate_levels``, which keep beliefs of their own: while a
    target moves as calmly as such a level states, the covariance of its belief shrinks accordingly, and while it is as
    agile, its mean follows.  Jumps have one of their own as well: a jump is rarer than a few outliers until the
    measurements that follow agree with it, and in a belief that it shares with agile levels their tails would hide it.
    It adds to the position an offset that is independent of all else, so the velocity and the heading stay what they
    were.  After it a target is settled: it goes on from that belief, by the stated motion or by the agile level (``D``
    regimes: 2, 1 of a single level, 0 without jumps), for some measurements; then another regime begins.  So there are
    ``S = K + (separate levels) + C + (1 if J)`` beliefs: of each motion, of these levels, of climbs, and of jumps.

    If ``vertical`` components are given, each separate level that is lower than all others has a climb beside it; else
    ``C`` is 0.  In a climb the vertical process noise is the stated one and all other noise that of the level: a sensor
    with precise ranges or range rates and a coarse elevation shows a turn at once and a climb late.  A climb has a
    belief of its own, and the level's self-transition probability; the two share its entry of the restart distribution.

    Tensors of regimes have the axes of ``Hypotheses``.

    Args:
        motions: number of motions, ``K``.
        noise_levels: ``(..., L)`` factors on the variance of the first motion's process noise, ascending.
        jump_factors: ``(..., J)`` factors on the covariance of the predicted position per unit of the normalised
            innovation squared per element; the product is 1 at least.
        self_transition: self-transition probabilities by kind or regime, of a step, whatever its ``dt``; that of a jump
            is of a settled target, and of a step with a measurement.
        durations: instead of these, mean sojourn times, s, by kind or regime: a Markov chain in continuous time.  That
            of a jump is of a settled target, and in measurements.  However long a step, levels of a single motion
            last for some two measurements at least: see ``counted``.
        restart: restart distribution, by kind or regime as these are, which sums to one; by kind, other motions share
            theirs evenly, and a level with its climb.  Of jumps it says only how they share what is theirs.
        manoeuvre_factors: ``(..., M)`` factors on the variance of the stated process noise per unit of the normalised
            innovation squared per element; the product is that of the agile level at least.  Beyond five
            standard deviations its weight falls with its size, as a single large innovation is rather an outlier.
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
        self.motions, agile, jump_count = motions, levels.shape[-1] - 1, jumps.shape[-1]
        scaled = manoeuvres.shape[-1] + jump_count  # regimes whose covariance scales with the innovation
        kinds = agile + 2 + scaled
        count = kinds + motions - 2  # of regimes
        by_kind = motions < 3 or stay.shape[-1:] != (count,)
        expected = f"(..., {kinds})" if motions < 3 else f"(..., {kinds}), or of each regime (..., {count})"
        for name, value in ((sojourn, stay), ("restart", begin)):
            if value.shape[-1:] != (kinds if by_kind else count,):
                raise ValueError(f"{name}: expected {expected}, received {tuple(value.shape)}")
        own = {level: motions + i for i, level in enumerate(_levels(separate_levels, agile + 1))}  # beliefs
        # Of the separate levels those that are lower than all others.
        climbs = [level for i, level in enumerate(own) if level == i] if vertical else []
        self.vertical, landed = tuple(vertical), motions + len(own) + len(climbs)  # the belief of jumps
        first = (kinds if by_kind else count) - scaled  # entry of manoeuvres and jumps
        settled = [agile + 1, agile][: min(agile + 1, 2)] if jump_count else []  # levels
        self.each = (
            *(Regime("level", own.get(i, 0), i, i) for i in range(agile + 1)),
            *(Regime("motion", k, agile + 1, agile + (1 if by_kind else k)) for k in range(1, motions)),
            *(Regime("climb", motions + len(own) + i, level, level) for i, level in enumerate(climbs)),
            *(Regime("manoeuvre", 0, agile, first + i) for i in range(scaled - jump_count)),
            *(Regime("jump", landed, agile + 1, first + i, source=0) for i in range(scaled - jump_count, scaled)),
            *(Regime("settled", landed, level, first + scaled - 1) for level in settled),
        )
        """The regimes."""
        self.kinds = [regime.kind for regime in self.each]
        self.widest = max(r for r, kind in enumerate(self.kinds) if kind != "settled")
        """The regime with the widest prediction: a jump, if there is one."""
        self.entries = [regime.entry for regime in self.each]
        self.belief_of = [regime.belief for regime in self.each]
        self.source_of = [regime.belief if regime.source is None else regime.source for regime in self.each]
        self.beliefs = max(self.belief_of) + 1
        """The number of beliefs, ``S``."""
        self.merged_from, self.predicting = _by_belief(self.belief_of), _by_belief(self.source_of)
        """The regimes that are merged into each belief, and those that predict from it."""
        self.begins = sorted({regime.entry for regime in self.each if regime.kind not in LANDED})
        """The entries of the restart distribution of which a regime may begin, unlike of jumps; of a single motion the
        kind "any other motion" has no regime."""
        self.noise_levels = Hyper(levels, event_dim=1, finite=True, name="noise_levels")
        self.manoeuvre_factors = None
        if "manoeuvre" in self.kinds:
            self.manoeuvre_factors = Hyper(manoeuvres, event_dim=1, name="manoeuvre_factors")
        self.jump_factors = Hyper(jumps, event_dim=1, name="jump_factors")
        self.burst = Hyper(burst, constraints.greater_than_eq(SOONER), name="burst")
        self.self_transition = self.durations = None
        if sojourn == "durations":
            self.durations = sojourn_times(stay, 1, sojourn)
        else:
            self.self_transition = Hyper(stay, constraints.unit_interval, event_dim=1, name=sojourn)
        self.restart = Hyper(begin, constraints.simplex, event_dim=1, name="restart")
        if bool((begin[..., self.begins] == 0).all(-1).any()):
            raise ValueError(
                f"restart: expected a probability above 0 at one of indices {self.begins}, received {begin.tolist()}"
            )

    # ------------------------------------------------------------ the Markov chain

    @once
    def restart_distribution(self, like: Tensor) -> Tensor:
        """The restart distribution ``(R, ...)`` but for jumps, which sums to one, for ``like (R, ...)``."""
        odds = self._by_regime(self.restart(like), like.dim() - 1) / self._sharing(like)
        odds = torch.where(self._landed(like), 0.0, odds)
        return odds / odds.sum(0)  # of a single motion the kind "any other motion" has no regime

    @once
    def _landed(self, like: Tensor) -> Tensor:
        """Whether a regime is of a target that has jumped, ``(R, ...)`` bool for ``like (R, ...)``."""
        return self._of_kinds(like, *LANDED)

    def _of_kinds(self, like: Tensor, *kinds: str) -> Tensor:
        """Whether a regime is of one of these kinds, ``(R, ...)`` bool for ``like (R, ...)``."""
        found = torch.tensor([kind in kinds for kind in self.kinds], device=like.device)
        return found.reshape(-1, *(1,) * (like.dim() - 1))

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
    def _sharing(self, like: Tensor) -> Tensor:
        """The number ``(R, ...)`` of regimes that share each regime's entry of the restart distribution."""
        sharing = as_tensor([float(self.entries.count(entry)) for entry in self.entries], like)
        return sharing.reshape(-1, *(1,) * (like.dim() - 1))

    @once
    def _stay(self, like: Tensor) -> Tensor:
        """Self-transition probabilities ``(R, ...)`` of a step, for ``like (R, ...)``."""
        return self._by_regime(self.self_transition(like), like.dim() - 1)  # type: ignore[misc]  # there is one

    @once
    def _other_motions(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """The restart distribution without the first motion's regimes, ``(R, ...)``, and its sum ``(...)``."""
        others = torch.where(self._of_kinds(like, "motion"), self.restart_distribution(like), 0.0)
        return others, others.sum(0)

    def continuous(self, like: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
        """Transition probabilities over ``dt (...)`` seconds of a chain in continuous time, for ``like (R, ...)``.

        Regimes of one kind have the same rates, so the chain over kinds is enough.

        Returns:
            ``(R, ...)`` probability that a regime does not end within the step, and ``(R now, R was, ...)`` probability
            that it ends and the regime at the end of the step is this one.  Together they are ``exp(G dt)``.
        """
        rank = like.dim() - 1
        durations, rates = self._rates(like)
        lasts = torch.exp(-dt.unsqueeze(-1) / durations)
        of_kinds = transition_over(rates, dt) - torch.diag_embed(lasts)
        ended = values_first(of_kinds.clamp_min(0.0).mT, rank, 2)  # [now, was, ...]
        ended = taken(taken(ended, self.entries, 0), self.entries, 1) / self._sharing(like).unsqueeze(1)
        return self._by_regime(lasts, rank), ended

    @once
    def _rates(self, like: Tensor) -> tuple[Tensor, Tensor]:
        """Mean sojourn times ``(..., kinds)`` and the generator of the chain over kinds."""
        durations, restart = self.durations(like), self.restart(like)  # type: ignore[misc]
        if len(self.begins) < restart.shape[-1]:
            present = as_tensor([float(k in self.begins) for k in range(restart.shape[-1])], restart)
            restart = restart * present / (restart * present).sum(-1, keepdim=True)
        return durations, generator(durations, restart.unsqueeze(-2))

    def counted(self, unmeasured: Tensor, dt: Tensor) -> Tensor:
        """The seconds ``(...)`` by which the chain moves on in a step, of a single motion as many as ``LASTS`` says.

        Motions of a bank begin and end as time passes, measured or not.

        Args:
            unmeasured: ``(...)`` seconds from the last measurement to the beginning of the step.
            dt: ``(...)`` seconds.
        """
        if self.durations is None or self.motions > 1:
            return dt
        longest = self._longest(dt)
        return torch.minimum(unmeasured + dt, longest) - torch.minimum(unmeasured, longest)

    @once
    def _longest(self, like: Tensor) -> Tensor:
        """The most ``(...)`` seconds between two measurements that count, for ``like (...)``."""
        levels = sorted({regime.entry for regime in self.each if regime.kind == "level"})
        return taken(self.durations(like), levels, -1).amin(-1) / LASTS  # type: ignore[misc]  # there are some

    def switch(self, log_weight: Tensor, dt: Tensor, measured: Tensor) -> Switching:
        """How regimes with log weights ``(1, R, 2, ...)`` switch between two steps ``dt (...)`` seconds apart.

        Args:
            log_weight: of the regimes before.
            dt: seconds.
            measured: ``(...)`` bool, whether the next step has a measurement.
        """
        top = largest(log_weight, MOTION, keepdim=True)
        weight = (log_weight - top).exp()
        stay, ended = self.chain(weight[0], dt, measured)
        stayed, restarted = stay * weight, (ended * weight).sum(1).unsqueeze(0)
        goes_on = self._settled(stayed, MOTION)
        return Switching(goes_on, weight - stayed, restarted, safe_log(goes_on + restarted) + top)

    def transition(self, like: Tensor, dt: Tensor, measured: Tensor) -> Tensor:
        """Logs ``(R now, 2, R before, ...)`` of the transition probabilities, for ``like (R, 2, ...)``."""
        stay, ended = self.chain(like, dt, measured)
        stay, ended = stay.movedim(0, 1), ended.movedim(1, 2)
        count = stay.shape[1]
        same = self._settled(torch.eye(count, dtype=stay.dtype, device=stay.device), 0)
        return safe_log(same.reshape(count, 1, count, *(1,) * (stay.dim() - 2)) * stay + ended)

    def chain(self, like: Tensor, dt: Tensor, measured: Tensor) -> tuple[Tensor, Tensor]:
        """Transition probabilities over a step of ``dt (...)`` seconds, for ``like (R, ...)``.

        Returns:
            ``(R, ...)`` probability that a regime goes on, and ``(R now, R was, ...)`` that it ends and this one
            begins.  A jump goes on as a settled target, whatever comes next: else it would be mixed into the beliefs of
            other regimes before a measurement has confirmed it.
        """
        if self.durations is None:
            stay, restart = self.discrete(like, dt, measured)
            ended = restart.unsqueeze(1) * (1 - stay)
        else:
            stay, ended = self.continuous(like, dt)
        if "jump" not in self.kinds:
            return stay, ended
        landed, keeps = self._landed(like), torch.where(measured, self._keeps(like), 1.0)
        begins = self.restart_distribution(like).unsqueeze(1) * (1 - keeps)
        return torch.where(landed, keeps, stay), torch.where(landed, begins, ended)

    @once
    def _keeps(self, like: Tensor) -> Tensor:
        """Probabilities ``(R, ...)`` that a target is settled after a measurement too; 1 of all other regimes."""
        if self.durations is None:
            keeps = self._stay(like)
        else:
            keeps = self._by_regime((-1 / self.durations(like)).exp(), like.dim() - 1)
        return torch.where(self._of_kinds(like, "settled"), keeps, 1.0)

    def _settled(self, x: Tensor, axis: int) -> Tensor:
        """Weights of regimes that go on, along an axis: jumps and settled targets are settled in the next step."""
        jumps, settled = self.kinds.count("jump"), self.kinds.count("settled")
        if not jumps:
            return x
        others, landed = x.split([len(self.each) - jumps - settled, jumps + settled], axis)
        as_stated, *agile = landed.split([jumps + 1, *[1] * (settled - 1)], axis)
        shares = [as_stated.sum(axis, keepdim=True)]
        if agile:
            becomes = AGILE_AFTER * shares[0] + AGILE_STAYS * agile[0]
            shares = [(1 - AGILE_AFTER) * shares[0] + (1 - AGILE_STAYS) * agile[0], becomes]
        return torch.cat([others, torch.zeros_like(landed.narrow(axis, 0, jumps)), *shares], axis)

    def jumped(self, compared: Whitened, nis: Tensor, count: Tensor, dims: int, first: Tensor) -> Jumped:
        """What a jump costs by itself, in the step in which it comes.

        Args:
            compared: the measurement compared with the prediction as stated.
            nis: ``(1, 1, 2, ...)`` normalised innovation squared per element.
            count: ``(...)`` measured elements.
            dims: of space.
            first: ``(...)`` whether the measurement is the first, and a jump a prior that is off.
        """
        seen = compared.spread.square().sum((-2, -1))
        usual = safe_divide(seen, count).log1p()
        expected = usual.clamp(max=EXPECTED)
        if "jump" not in self.kinds:
            return Jumped(expected, *[torch.zeros_like(seen)] * 3)
        free = count.clamp(1.0, dims)
        wider = self._jumps(nis)[:, -1:] * seen / free
        own = 0.5 * free * (wider.log1p() - 1 - usual)
        longest = torch.where(first, PRIOR_BURST, self.burst(seen))
        return Jumped(expected, own, 0.5 * free * (usual - expected), longest)

    def rarity(self, cost: Tensor, beyond: Tensor, rarer: Tensor, jumped: Jumped, first: Tensor) -> Tensor:
        """Log ``(1, 1, 2, ...)`` of the factor on the weight of a jump, so that it is as rare as a burst of outliers.

        A jump and a burst of equal outliers are the same until the burst ends.  With its own density it is as rare as
        ``burst + 1 - SOONER`` outliers: it is less likely than outliers at the last measurement of the longest burst,
        and more likely at the next one, unless the tail of the agile level is likelier than both.  Where a measurement
        is nearer than the least of outliers, it is rarer still.  However wide the prediction is, a jump is at least as
        rare as a first outlier.

        Args:
            cost: ``(1, 1, 2, ...)`` log of how much less likely the measurement is as an outlier than as stated: see
                ``Outliers.cost``.  It is 0 without a measurement.
            beyond: by how much that is above its least, as of the smallest outliers beside which a jump is seen.
            rarer: ``(...)`` log of how much rarer the first outlier is: see ``Outliers.first_rarer``.
            jumped: what the jump costs by itself.
            first: as in ``jumped``.
        """
        if "jump" not in self.kinds:
            return -cost
        held = cost < torch.inf  # else it is an outlier, and nothing else has a gradient
        cost, beyond = torch.where(held, cost, 0.0), torch.where(held, beyond, 0.0)
        most = jumped.own - cost - rarer
        nearer = torch.where(first, 1.0, beyond.clamp(NEARER, 1.0)).log()
        rarity = torch.minimum(most + jumped.wide - cost * (jumped.burst - SOONER), most) + nearer
        rarity = torch.where(cost > 0, rarity, 0.0)
        return torch.where(held, rarity, -torch.inf)

    def unknown(
        self, settled: Fit, stated: Fit, expected: Tensor, least: Tensor, log_weight: Tensor, count: Tensor
    ) -> Tensor:
        """Log ``(1, 1, 2, ...)`` of what a settled target is given back of the density of a measurement.

        After a jump its velocity and its acceleration, if it has any, are unknown, so its predictions are wide, the
        more the longer the steps are.  That is no evidence against the jump, so the density is given back by how much
        they are wider than is expected of a measurement: only while it is an outlier to the prediction as stated, and
        no more than by how much it is.  A small residual of so wide a prediction is no evidence for the jump either,
        and what is an outlier to it too is not given back: the agile level of a target that has jumped is not to
        explain it.

        Args:
            settled: the measurement and a settled target, by the stated motion.
            stated: the measurement and the prediction as stated.
            expected: as in ``Jumped``.
            least: log of how much less likely than as stated the smallest outliers are: see ``Outliers.cost``.
            log_weight: ``(1, R, 2, ...)`` of the regimes by their Markov chain.
            count: ``(...)`` measured elements.
        """
        off, settled_off = [(0.5 * fit.squares - least).clamp_min(0.0) for fit in (stated, settled)]
        # By whichever is likelier, no outlier in the step before or some: the other may know of nothing but the jump.
        of_modes = log_sum(log_weight, MOTION).unsqueeze(MOTION)
        without = of_modes.narrow(BEFORE, 0, 1) >= of_modes.narrow(BEFORE, -1, 1)
        expected, off = (torch.where(without, x.narrow(BEFORE, 0, 1), x.narrow(BEFORE, -1, 1)) for x in (expected, off))
        given = settled.width - 0.5 * expected * count - 0.5 * (count - settled.squares).clamp_min(0.0) - settled_off
        given = torch.minimum(given, off)
        return torch.where(given > 0, given, 0.0)  # a belief without weight may have failed

    def given_back(self, rarity: Tensor, given: Tensor) -> Tensor:
        """Logs ``(2, R, 2, ...)`` of factors on modes for each regime.

        What a prior that is off is given back, a settled target is not: it is given back what it does not know itself,
        as of an inlier.

        Args:
            rarity: ``(2, 1, 2, ...)`` from ``GPB.outlying_rarity``.
            given: ``(1, 1, 2, ...)`` from ``unknown``.
        """
        factors = torch.where(self._landed(rarity[0]), rarity.clamp_max(0.0), rarity)
        return factors + self.among("settled", torch.cat([given, torch.zeros_like(given)]), 0.0)

    def penalised(self, log_weight: Tensor, surprise: Surprise) -> Tensor:
        """Log weights ``(..., R, 2, ...)`` in which large jumps and manoeuvres are less likely.

        Their covariances scale with the innovation, so they would explain one of any size equally well.  The weight of
        a manoeuvre falls as ``1 / nis^2`` beyond its limit.  A jump may come with any measurement, whatever the time
        since the last one, as outliers may: its weight is that of all regimes but of settled targets, times its
        ``rarity``, and its share of the jumps that begin.

        Args:
            log_weight: of the regimes by the Markov chain alone.
            surprise: of the measurement.
        """
        manoeuvre = -2 * (surprise.nis / MANOEUVRE_NIS).clamp_min(1.0).log()
        # Of a belief without weight that has failed both are NaN.
        others = without_failed(log_weight + self.among("manoeuvre", manoeuvre, 0.0))
        if "jump" not in self.kinds:
            return others
        unsettled = log_weight.narrow(MOTION, 0, self.kinds.index("jump"))
        jumps = log_sum(unsettled, MOTION).unsqueeze(MOTION) + self._log_shares(log_weight) + surprise.rarity
        jumps = torch.where(surprise.rarity == 0, -torch.inf, jumps)  # none without a measurement
        return self.among("jump", without_failed(jumps), others)

    @once
    def _log_shares(self, like: Tensor) -> Tensor:
        """Logs ``(1, J, ...)`` of the shares of jumps in those that begin, for ``like (1, R, ...)``."""
        restart = self._by_regime(self.restart(like[0]), like.dim() - 2)
        first = self.kinds.index("jump")
        restart = restart[first : first + self.kinds.count("jump")]
        return safe_log(restart / (restart.sum(0) + NEVER)).unsqueeze(0)

    # ------------------------------------------------------------ predictions

    def as_stated(self, propagated: Propagated) -> Gaussian:
        """The prediction ``(1, 1, 2, ..., n)``, with any root, by the first motion as it is stated.

        Args:
            propagated: ``(1, S, 2, ...)``, each belief by its motion.
        """
        return Gaussian(propagated.mean[:, :1], hstack(propagated.spread[:, :1], propagated.process_noise[:, :1]))

    def jump_roots(self, stated: Gaussian, nis: Tensor, motion: Motion, since: Tensor) -> Tensor:
        """Roots ``(1, J, 2, ..., n, n)`` of predictions by jumps, from that as stated with a lower root."""
        if "jump" not in self.kinds:
            return stated.scale_tril[:, :0]
        factors = self._jumps(nis)
        offsets = self._offsets(stated, factors, motion)
        roots: Tensor = self.widths(stated, factors, motion, since) * tria(hstack(stated.scale_tril, offsets))
        return roots

    def predictions(self, propagated: Propagated, nis: Tensor, jumps: Tensor) -> Gaussian:
        """The prediction ``(1, R, 2, ..., n)`` of every regime.

        Manoeuvres and jumps scale with the innovation: if they were wider than the innovation, a measurement with
        little information on the state, or a missing one, could not rule them out, and they would widen the estimate
        without bound.

        Args:
            propagated: ``(1, S, 2, ...)``, each belief by its motion, with a lower root as spread.
            nis: ``(1, 1, 2, ...)`` normalised innovation squared per element, as stated.
            jumps: from ``jump_roots``.
        """
        root = tria(hstack(self.per_regime(propagated.spread), self._noise(propagated, nis)), graded=False)
        return Gaussian(self.per_regime(propagated.mean), self.among("jump", jumps, root))

    def predicted_parts(self, propagated: Propagated, nis: Tensor, motion: Motion, since: Tensor) -> Propagated:
        """The parts ``(1, R, 2, ...)`` of which ``predictions`` are made."""
        mean, spread = self.per_regime(propagated.mean), self.per_regime(propagated.spread)
        noise = self._noise(propagated, nis)
        if "jump" not in self.kinds:
            return Propagated(mean, spread, noise, None)
        stated, factors = self.as_stated(propagated), self._jumps(nis)
        widths = self.among("jump", self.widths(stated, factors, motion, since), 1.0)
        offsets = self.among("jump", self._offsets(stated, factors, motion), 0.0)
        return Propagated(mean, widths * spread, widths * hstack(noise, offsets), None)

    def _noise(self, propagated: Propagated, nis: Tensor) -> Tensor:
        """Roots ``(1, R, 2, ..., n, r)`` of the process noise of every regime."""
        variances = self._levels(nis[0])
        if self.manoeuvre_factors is not None:
            factors = values_first(self.manoeuvre_factors(nis), nis.dim() - 2) * nis
            factors = factors.clamp(max=LARGEST_FACTORS[nis.dtype])
            variances = torch.maximum(variances, self.among("manoeuvre", factors, 0.0))
        factors = variances.sqrt()[..., None, None]
        if "climb" in self.kinds:
            vertical = torch.tensor([i in self.vertical for i in range(propagated.mean.shape[-1])], device=nis.device)
            stated = self._of_kinds(nis[0], "climb")[..., None, None] & vertical.unsqueeze(-1)
            factors = torch.where(stated, 1.0, factors)
        return factors * self.per_regime(propagated.process_noise)

    @once
    def _levels(self, like: Tensor) -> Tensor:
        """Factors ``(1, R, ...)`` on the variance of process noise by each regime's level, for ``like (R, ...)``."""
        levels = values_first(self.noise_levels(like), like.dim() - 1)
        levels = torch.cat([levels, torch.ones_like(levels[:1])])
        return taken(levels, [regime.level for regime in self.each], 0).unsqueeze(0)

    def widths(self, stated: Gaussian, factors: Tensor, motion: Motion, since: Tensor) -> Tensor:
        """Factors ``(1, J, 2, ..., n, 1)`` on the rows of predicted roots: of velocity and acceleration in a jump.

        A receiver that was reset moves as before, a target that was carried elsewhere in any direction, and faster: a
        standard deviation of the velocity is at least ``FASTER`` times the speed, and so is one of the acceleration of
        its size.  But it is multiplied by no more than that of an element or, if that is more, than what takes the
        target as far as it is off since the last measurement: one that turns beyond all noise is first seen a little
        off its way.

        Args:
            stated: ``(1, 1, 2, ..., n)`` prediction as stated, any root.
            factors: ``(1, J, 2, ...)`` on the covariance of the position, from ``_jumps``.
            motion: says which components of a state are its position and its velocity.
            since: ``(...)`` seconds since the last measurement.
        """
        mean, variances = stated.mean, stated.scale_tril.square().sum(-1)
        jump, rows = factors.sqrt(), dict[int, Tensor]()
        far = safe_sqrt((factors - 1) * variances[..., motion.position].sum(-1) / motion.dims)
        for order, part in enumerate(_derivatives(motion), 1):
            if part:
                size = safe_sqrt(taken(mean, part, -1).square().sum(-1))
                std = safe_sqrt(taken(variances, part, -1).mean(-1))
                most = torch.maximum(jump, safe_divide(order * far, std * since**order))
                rows |= dict.fromkeys(part, torch.minimum(most, safe_divide(FASTER * size, std).clamp_min(1.0)))
        each = [rows.get(i, torch.ones_like(jump)) for i in range(motion.size)]
        return torch.stack(torch.broadcast_tensors(*each), -1).unsqueeze(-1)

    def _jumps(self, nis: Tensor) -> Tensor:
        """Factors ``(1, J, 2, ...)`` on the covariance of the position by jumps."""
        return (values_first(self.jump_factors(nis), nis.dim() - 2) * nis).clamp(1.0, LARGEST_FACTORS[nis.dtype])

    def _offsets(self, stated: Gaussian, factors: Tensor, motion: Motion) -> Tensor:
        """Roots ``(1, J, 2, ..., n, p)`` of what jumps add to the covariance of the position, by any root of it."""
        place = as_tensor([float(i in range(motion.size)[motion.position]) for i in range(motion.size)], factors)
        return safe_sqrt(factors - 1)[..., None, None] * place.unsqueeze(-1) * stated.scale_tril

    # ------------------------------------------------------------ regimes and their beliefs

    def per_regime(self, x: Tensor, axis: int = MOTION) -> Tensor:
        """Values of the ``S`` beliefs along an axis for each regime that predicts from one: ``R`` along that axis."""
        return taken(x, self.source_of, axis)

    def per_merged(self, x: Tensor, axis: int = MOTION) -> Tensor:
        """Values of the ``S`` beliefs along an axis for each regime that is merged into one: ``R`` along that axis."""
        return taken(x, self.belief_of, axis)

    def by_source(self, weight: Tensor) -> Tensor:
        """Weights ``(1, R, 2, ...)`` of regimes, summed for each belief from which they predict, ``(1, S, 2, ...)``."""
        return _each_group(weight, self.predicting, MOTION, partial(torch.sum, dim=MOTION, keepdim=True))

    def by_belief(self, weight: Tensor, axis: int = MOTION) -> Tensor:
        """Weights of ``R`` regimes along an axis, summed for each of the ``S`` beliefs."""
        return _each_group(weight, self.merged_from, axis, partial(torch.sum, dim=axis, keepdim=True))

    def log_by_belief(self, log_weight: Tensor, axis: int = MOTION) -> Tensor:
        """Logs of weights of ``R`` regimes along an axis, summed for each of the ``S`` beliefs."""
        return _each_group(log_weight, self.merged_from, axis, lambda x: log_sum(x, axis).unsqueeze(axis))

    def merged(self, every: Hypotheses, angles: Sequence[int]) -> tuple[Hypotheses, Tensor]:
        """Hypotheses ``(2, R, 2, ...)`` merged over regimes of a belief and the outlier before: ``(2, S, 1, ...)``.

        And square roots ``(2, R, 2, ...)`` of the shares that hypotheses have in their belief.
        """
        beliefs: list[Gaussian] = []
        shares: list[tuple[Tensor, Tensor]] = []
        for regimes, share in self.merged_from:
            part, axes = every.of(regimes), [*[MOTION] * share, BEFORE]
            shares.append(part.share_roots(*axes))
            beliefs.append(merge(part.belief, shares[-1][0], axes, angles))
        parts = *zip(*beliefs, strict=True), *zip(*shares, strict=True)
        mean, root, of_hypotheses, log_weight = [torch.cat(part, MOTION) for part in parts]
        order = [r for regimes, _ in self.merged_from for r in regimes]
        of_hypotheses = taken(of_hypotheses, [order.index(r) for r in range(len(order))], MOTION)
        return Hypotheses(Gaussian(mean, root), log_weight), of_hypotheses

    def merged_parts(self, parts: Propagated, log_weight: Tensor, angles: Sequence[int]) -> Gaussian:
        """Predictions ``(2, S, 1, ..., n)``, any root, of ``parts (1, R, 2, ...)``, merged as beliefs are after a step.

        Levels that share a belief differ in their process noise alone.  What they have in common counts once: repeated,
        with weights whose sum is rounded, it would hide what is known well beside a wide prior.

        Args:
            parts: from ``predicted_parts``.
            log_weight: ``(2, R, 2, ...)`` of the hypotheses after the step.
            angles: as in ``Hypotheses.merged``.
        """
        every = Hypotheses(Gaussian(parts.mean, hstack(parts.spread, parts.process_noise)), log_weight)
        merged: list[Gaussian] = []
        mean, spread, noise, _ = parts
        for regimes, share in self.merged_from:
            hypotheses, first = every.of(regimes), regimes[0]
            if share and self.belief_of[first] == 0:
                roots, total = hypotheses.share_roots(MOTION)
                noises = (roots[..., None, None] * taken(noise, regimes, MOTION)).movedim(MOTION, -2).flatten(-2)
                root = hstack(spread[:, first : first + 1], noises.unsqueeze(MOTION))
                hypotheses, share = Hypotheses(Gaussian(mean[:, first : first + 1], root), total), False
            merged.append(hypotheses.merged(*[MOTION] * share, BEFORE, angles=angles, triangular=False).belief)
        columns = max(root.shape[-1] for _, root in merged)
        padded = [pad(root, (0, columns - root.shape[-1])) for _, root in merged]
        return Gaussian(torch.cat([mean for mean, _ in merged], MOTION), torch.cat(padded, MOTION))

    def _by_regime(self, kinds: Tensor, rank: int) -> Tensor:
        """Values by kind or regime as ``(R, ...)`` with ``rank`` dimensions behind the first."""
        return taken(values_first(kinds, rank), self.entries, 0)

    def among(self, kind: str, values: Tensor, others: Tensor | float) -> Tensor:
        """Values ``(J, R, 2, ...)`` of regimes: those ``(J, 1 or more, 2, ...)`` of a kind, and of all ``others``."""
        count = self.kinds.count(kind)
        if isinstance(others, float):
            others = values.new_full((len(values), len(self.each), *values.shape[2:]), others)
        if not count:
            return others
        first, rest = self.kinds.index(kind), values.shape[2:]
        before, _, after = others.split([first, count, len(self.each) - first - count], MOTION)
        return torch.cat([before, values.expand(-1, count, *rest), after], MOTION)


def most_given(motion: Motion) -> float:
    """Log of how much a target that has jumped, or whose prior is off, is given back at most: see ``HEADING``."""
    return math.inf if any(_derivatives(motion)) else HEADING


def _by_belief(beliefs: Sequence[int]) -> list[tuple[list[int], bool]]:
    """The regimes of each belief in turn, and whether they share it; those that have one alone are together.

    Args:
        beliefs: of each regime.
    """
    groups: list[tuple[list[int], bool]] = []
    for belief in range(max(beliefs) + 1):
        regimes = [r for r, of in enumerate(beliefs) if of == belief]
        if len(regimes) == 1 and groups and not groups[-1][1]:
            groups[-1][0].extend(regimes)
        else:
            groups.append((regimes, len(regimes) > 1))
    return groups


def _each_group(
    x: Tensor, groups: list[tuple[list[int], bool]], axis: int, combine: Callable[[Tensor], Tensor]
) -> Tensor:
    """Values of ``R`` regimes along an axis as those of ``S`` beliefs: those that share one are combined."""
    parts = [taken(x, regimes, axis) for regimes, _ in groups]
    parts = [combine(part) if share else part for part, (_, share) in zip(parts, groups, strict=True)]
    return torch.cat(parts, axis) if len(parts) > 1 else parts[0]


def _derivatives(motion: Motion) -> tuple[Sequence[int], Sequence[int]]:
    """The components of a state that are velocities, and those that are accelerations."""
    components = range(motion.size)
    return components[motion.velocity], [i for i in components if motion.kinds[i] == "acceleration"]


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

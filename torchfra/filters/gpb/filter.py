"""GPB: every step as a mixture of hypotheses, merged by generalised pseudo-Bayes."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.distributions import constraints

from torchfra import tree
from torchfra.filters.base import Mix
from torchfra.filters.checks import check_models
from torchfra.filters.gpb.hindsight import GPBPast
from torchfra.filters.gpb.merging import lifted, merged, shares, together
from torchfra.filters.gpb.qualities import Qualities, entry
from torchfra.filters.gpb.regimes import Regimes
from torchfra.filters.gpb.sensing import Sensing
from torchfra.filters.gpb.states import GPBInfo, GPBState, Shares, Step
from torchfra.filters.interaction import for_each_model
from torchfra.filters.records import Record
from torchfra.gaussian.cubature import third_degree
from torchfra.gaussian.inputs import Frame
from torchfra.gaussian.mixture import largest, matched, models_first, repeated, shared
from torchfra.gaussian.model import propagate
from torchfra.gaussian.rules import Rule
from torchfra.gaussian.update import innovation
from torchfra.hyper import Hyper, Value
from torchfra.linalg.safe import safe_divide, safe_log, safe_sqrt
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Whitened


class GPB(Sensing):
    """Generalised pseudo-Bayes over regimes of the motion and qualities of the measurement.

    A step's regime is a Markov chain: calm, agile or a jump of a motion, and the other motions of a bank.  The quality
    of what each block of the sensor's elements measures is a Markov chain too: clean, or an outlier of one of some
    sizes.  Every combination is a hypothesis with a prediction, a correction and a likelihood.  After a step they
    are merged into one Gaussian for each motion and for clean and dirty (a step with an outlier in any block); these
    two are kept apart until the next measurement has said which of them was right.  So nothing is decided by a gate,
    and all is smooth: the next measurement weighs an outlier against a manoeuvre.  Over steps without any measurement,
    however many, both are carried on, the first motion keeps its regime, and what was settled is as filtered.

    Merging, in square-root form, happens where hypotheses differ: outlier sizes in the space of the measurement,
    regimes and qualities in that of states.  Motions interact as in ``IMM``.

    Before the first step there are two beliefs too: the prior as given, and the same widened, should it be poor.

    ``Estimate.nis`` and the innovation are those of the Gaussian with the moments of all predictions, with the noise as
    the sensor states it; ``log_likelihood`` is that of the mixture.

    Args:
        motion: how targets move; a ``Bank`` of several.
        sensor: what is measured; ``Sensor.blocks`` says which elements come from the same device.
        regimes: the Markov chain of the motion, of as many motions as the bank has.
        qualities: the Markov chain of outliers, of the sensor's blocks.
        poor: probability that the prior is worth little.
        start: factor on the prior's covariance then, but for parameters (``kinds`` of the motion).
        lag: 0 for the filtered estimate, 1 for the one that the next measurement has settled; the other is in ``info``.
        rule: from a number of states to the rule that carries a Gaussian through a function.

    Raises:
        ValueError: regimes of other motions, blocks that do not cover the measurement once, correlated noise between
            blocks, or a rule with negative weights.

    Source: Harrison & Stevens (1976), Kirkendall (1992) for regimes and outliers as hypotheses; Bar-Shalom, Li &
    Kirubarajan (2001), section 11.6, for GPB2 and IMM; Daeipour & Bar-Shalom (1995) for modes of the noise.
    """

    def __init__(
        self,
        motion: Motion,
        sensor: Sensor,
        *,
        regimes: Regimes,
        qualities: Qualities,
        poor: Value = 0.25,
        start: Value = 340.0,
        lag: int = 0,
        rule: Callable[[int], Rule] = third_degree,
    ) -> None:
        check_models(motion, sensor)
        super().__init__(motion if isinstance(motion, Bank) else Bank([motion]), sensor, rule)
        if lag not in (0, 1):
            raise ValueError(f"lag: expected 0 or 1 steps, received {lag!r}")
        if self.signed:
            raise ValueError("rule: expected one without negative weights, received one with some")
        if regimes.motions != len(self.bank):
            raise ValueError(f"regimes: expected those of {len(self.bank)} motions, received of {regimes.motions}")
        qualities.check(sensor)
        self.regimes, self.qualities, self.lag = regimes, qualities, lag
        self.poor = Hyper(poor, constraints.unit_interval, name="poor")
        self.start = Hyper(start, constraints.greater_than_eq(1.0), name="start")

    @property
    def slow_to_compile(self) -> bool:  # type: ignore[override]  # of this bank, not of the class
        """Whether its kernel takes some ten seconds or more: that of a bank of more than three motions."""
        return len(self.bank) > 3

    @property
    def bank(self) -> Bank:
        """The motions."""
        return self.motion  # type: ignore[return-value]

    def begin(self, belief: Gaussian) -> GPBState:
        """The state of a belief: as it is, and widened, for every motion; what is known of parameters stays."""
        mean, poor = belief.mean, self.poor(belief.mean)
        log_start = torch.stack([torch.log1p(-poor), poor.log()], -1)
        log_weights = log_start.unsqueeze(-1) + self.regimes.renewed(mean).log().unsqueeze(-2)
        log_weights = log_weights.expand(*mean.shape[:-1], *log_weights.shape[-2:])
        every = repeated(belief, len(self.bank))
        told = torch.tensor([kind != "parameter" for kind in self.motion.kinds], device=mean.device)
        factor = torch.where(told, self.start(mean).sqrt().unsqueeze(-1), 1.0)[..., None, :, None]
        widened = every._replace(scale_tril=factor * every.scale_tril)
        outlier = mean.new_zeros(*mean.shape[:-1], len(self.qualities.blocks))
        return GPBState(belief, belief, every, widened, log_weights, outlier)

    def advance(self, state: GPBState, frame: Frame, mix: Mix | None = None) -> tuple[GPBState, Record]:
        """One step; ``mix`` is not looked at, as this filter mixes itself."""
        before = tree.stack([state.clean, state.dirty], 0)  # (2, ..., K)
        measured, log_weights = frame.seen.sum(-1) > 0, state.log_weights.movedim(-2, 0)
        predicted, log_ahead, made_of, agile, far = self.look_ahead(before, log_weights, frame, measured)
        seen = self.read(predicted)
        whitened, expected = self.compare_all(seen, agile, log_ahead, frame)
        log_quality, prior = self.qualities.ahead(state.outlier, measured)
        corrected = self.qualities(seen, whitened, lambda x: self.compare(x, frame), prior, 1 - frame.seen)
        joint = log_quality.unsqueeze(1) + log_ahead + corrected.log_density  # (2, R, 2, ...): now, regime, before
        joint = torch.where(joint.isnan(), -torch.inf, joint)  # nothing speaks for a hypothesis that failed

        after, log_after, roots = merged(self.regimes, lifted(predicted, corrected.belief), joint, self.motion.angles)
        of_motion, log_now = shares(log_after.movedim(-1, 0))  # (K, 2, ...), (2, ...)
        now, log_likelihood = shared(log_now)
        share = roots.square() * self.regimes.of_each(of_motion.square(), 0).unsqueeze(1)  # (R, before, now, ...)
        weights = share * now.square()
        settling = safe_sqrt(self.hindsight(weights.sum(2), made_of))
        ends = tree.stack([after, before], 1), torch.stack([(of_motion * now).movedim(0, -1), settling], 1)
        belief, settled = tree.unbind(together(*ends, self.motion), 2)
        if_dirty = torch.where(
            measured.unsqueeze(-1), (share[:, :, 1].unsqueeze(-1) * corrected.outlier).sum((0, 1)), state.outlier
        )
        outlier = torch.where(measured, now[1].square(), 0.0).unsqueeze(-1) * if_dirty
        info = Step(tree.Late(settled), weights.sum((1, 2)).movedim(0, -1), outlier)
        log_regimes = self.regimes.of_each(log_after, -1) + safe_log(roots.square().sum(1)).movedim(0, -1)
        log_regimes = log_regimes - log_likelihood.unsqueeze(-1)  # (2, ..., R)
        clean, dirty = tree.unbind(after, 2)
        carried = clean, dirty, log_regimes.movedim(0, -2), if_dirty
        record = Record(
            belief,
            expected.residual,
            *innovation(expected),
            info,
            log_likelihood,
            past=GPBPast(*carried, far.movedim(0, -1), measured.to(far).expand(far.shape[1:])),
        )
        return GPBState(belief, settled, *carried), record

    def compare_all(
        self, seen: Gaussian, agile: Whitened, log_ahead: Tensor, frame: Frame
    ) -> tuple[Whitened, Whitened]:
        """The measurement against all predictions, ``(1, R, 2, ...)``, and against the Gaussian with their moments.

        Against the agile ones it is ``agile (2, ...)``.
        """
        flat, at = tree.map_tensors(lambda x: x.flatten(0, 1), seen), 2 * self.regimes.agile
        expected = matched(flat, shared(log_ahead.flatten(0, 1))[0], self.motion.angles)
        others = [torch.cat([x[:at], x[at + 2 :], y.unsqueeze(0)]) for x, y in zip(flat, expected, strict=True)]
        whitened = self.compare(Gaussian(*others), frame)
        each = tree.map_tensors(
            lambda x, y: torch.cat([x[:at], y, x[at:-1]]).unflatten(0, (1, *log_ahead.shape[:2])), whitened, agile
        )
        return each, tree.map_tensors(lambda x: x[-1], whitened)

    def look_ahead(
        self, before: Gaussian, log_weights: Tensor, frame: Frame, measured: Tensor
    ) -> tuple[Gaussian, Tensor, Shares | None, Whitened, Tensor]:
        """Predictions ``(R, 2, ..., n)`` of all regimes, their log weights, and who contributed to which motion.

        Also ``(2, ...)`` the measurement against the agile ones, and its normalised innovation squared per element.
        """
        mixed, log_ahead, made_of = self.interact(before, log_weights, frame.dt, measured)
        mean, spread, noise, _ = propagate(self.motion, self.motion_rule, mixed, for_each_model(frame))
        predicted, agile, far = self.with_jumps(self.regimes.predictions(mean, spread, noise), frame)
        return predicted, self.regimes.rarer(log_ahead.movedim(-1, 0), far), made_of, agile, far

    def with_jumps(self, predicted: Gaussian, frame: Frame) -> tuple[Gaussian, Whitened, Tensor]:
        """Predictions of levels and motions, and of jumps after them; the measurement against agile ones, how far."""
        agile = entry(predicted, self.regimes.agile)
        whitened = self.compare(self.read(agile), frame)
        far = innovation(whitened)[1].square().sum(-1) / frame.seen.sum(-1).clamp_min(1.0)
        far = torch.where(frame.dt == 0, 0.0, far)  # over no time nothing jumps
        jumped = self.regimes.jumped(agile, far, self.motion.position)
        return Gaussian(*map(torch.cat, zip(predicted, jumped, strict=True))), whitened, far

    def predict_hypotheses(self, state: GPBState, frame: Frame) -> tuple[Gaussian, Tensor]:
        """Hypotheses ``(2 R, ..., n)`` of the state after a step, and logs of their weights."""
        before = tree.stack([state.clean, state.dirty], 0)
        log_weights, measured = state.log_weights.movedim(-2, 0), torch.ones_like(frame.dt, dtype=torch.bool)
        predicted, log_ahead, _, _, _ = self.look_ahead(before, log_weights, frame, measured)
        flat: Gaussian = tree.map_tensors(lambda x: x.flatten(0, 1), predicted)
        log_weights = log_ahead.flatten(0, 1)
        return flat, log_weights - log_weights.logsumexp(0)

    def interact(
        self, before: Gaussian, log_weights: Tensor, dt: Tensor, measured: Tensor
    ) -> tuple[Gaussian, Tensor, Shares | None]:
        """The motions ``(2, ..., K)`` mixed, log weights ``(2, ..., R)`` of the regimes ahead, and who contributed.

        As regimes that do not stay are drawn anew, a motion's belief is a mixture of its own and of one that all share.
        Over ``dt (...)`` of 0 seconds every regime stays; where nothing is ``measured (...)``: see ``Regimes.chain``.
        """
        regimes, top = self.regimes, largest(log_weights, -1, keepdim=True)
        weights = (log_weights - top).exp()
        stay, odds = regimes.chain(weights, measured)
        stay = torch.where((dt == 0).unsqueeze(-1), 1.0, stay)
        stayed, left = stay * weights, (1 - stay) * weights
        all_left = left.sum(-1, keepdim=True)
        drawn = all_left * odds
        log_ahead = safe_log(stayed + drawn) + top
        if len(self.bank) == 1:
            return before, log_ahead, None
        ahead = regimes.sums(stayed + drawn)
        own, common = (safe_divide(regimes.sums(x), ahead) for x in (stayed, drawn))
        made_of = Shares(own, common, safe_divide(regimes.sums(left), all_left))
        anew = matched(models_first(before), safe_sqrt(made_of.origin).movedim(-1, 0), self.motion.angles)
        pair = tree.stack([before, repeated(anew, len(self.bank))], 0)
        mixed = matched(pair, safe_sqrt(torch.stack([own, common])), self.motion.angles)
        return mixed, log_ahead, made_of

    def hindsight(self, weights: Tensor, made_of: Shares | None) -> Tensor:
        """Weights ``(2, ..., K)`` of the beliefs before a step, from those of what they became, ``(R, 2, ...)``."""
        now = self.regimes.sums(weights.movedim(0, -1))
        if made_of is None:
            return now
        return now * made_of.own + (now * made_of.common).sum(-1, keepdim=True) * made_of.origin

    def finish(self, state: GPBState, belief: Gaussian, info: Step) -> tuple[Gaussian, GPBInfo]:
        """Each step's settled estimate comes with the next."""
        time = info.regimes.dim() - 2
        settled = tree.one_earlier(info.settled, state.belief, time, info.regimes.shape[time])
        return settled if self.lag else belief, GPBInfo(belief, settled, info.regimes, info.outlier)

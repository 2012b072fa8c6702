"""Rules for the confirmation and the deletion of targets."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchfra.motion.base import Motion
from torchfra.numbers import as_number, fraction, is_integer, positive
from torchfra.targets.places import positions, velocities
from torchfra.targets.state import Track
from torchfra.types import Gaussian


class Confirmation(nn.Module):
    """A rule that confirms targets.  Abstract: a subclass defines ``forward``."""

    window = 1
    """Number of the latest scans that it uses."""
    scored = False
    """Whether it uses the score."""
    deletes = False
    """Whether it deletes confirmed targets as well as tentative ones."""

    def first(self, new: Tensor) -> Tensor:
        """Initial scores ``(K,)``; ``new`` is the probability that nothing else explains a target's measurements."""
        return torch.zeros_like(new)

    def predicted(self, score: Tensor, dt: Tensor) -> Tensor:
        """Scores ``(N,)`` after ``dt (N,)`` seconds, before the scan."""
        return score

    def exists(self, score: Tensor) -> Tensor | None:
        """Probability that targets of these scores ``(N,)`` exist; None if association takes it as 1."""
        return None

    def forward(self, track: Track) -> tuple[Tensor, Tensor]:
        """Two ``(N,)`` bool: which targets are confirmed, now or before, and which are deleted."""
        raise TypeError(f"{type(self).__name__} must define forward")


class MOfN(Confirmation):
    """M of N: confirmed once measured in M of the last N scans, deleted once that is impossible in the first N.

    Args:
        m: scans in which a target must be measured, including those of its birth.
        n: number of scans in the window.

    Raises:
        ValueError: not ``1 <= m <= n``.

    Source: Blackman & Popoli (1999), "Design and Analysis of Modern Tracking Systems", chapter 6.
    """

    def __init__(self, m: int = 3, n: int = 5) -> None:
        super().__init__()
        if not (is_integer(m, 1) and is_integer(n, m)):
            raise ValueError(f"m, n: expected whole numbers with 1 <= m <= n, received {m}, {n}")
        self.m, self.window = m, n

    def forward(self, track: Track) -> tuple[Tensor, Tensor]:
        """Confirms and deletes by the numbers of detections and misses in the last N scans."""
        measured = track.hits[:, : self.window].sum(-1)
        missed = track.age.clamp_max(self.window) - measured
        return track.confirmed | (measured >= self.m), ~track.confirmed & (missed > self.window - self.m)

    def extra_repr(self) -> str:
        """M and N."""
        return f"{self.m} of {self.window}"


class SPRT(Confirmation):
    """Sequential probability ratio test of the score: whether the target exists, or its measurements are false ones.

    The score of a scan is ``log(1 - P_D P_G) - log P(missed | scan)``: the density of the scan with the target over
    that without it, given the existence of all other targets; false measurements are Poisson.  Tentative targets
    are associated as if they certainly existed: where many begin, a true target is deleted more often than with
    probability ``missed``; use ``Existence`` there.

    Args:
        false: probability that a track of false measurements is confirmed.
        missed: probability that a true target is deleted before it is confirmed.

    Raises:
        ValueError: probabilities that are not above 0, or that sum to 1 or more.

    Source: Wald (1945), "Sequential Tests of Statistical Hypotheses"; Sittler (1964), "An Optimal Data Association
    Problem in Surveillance Theory"; Blackman & Popoli (1999), chapter 6; Musicki, Evans & Stankovic (1994),
    "Integrated Probabilistic Data Association", for the ratio of a scan.
    """

    scored = True

    def __init__(self, false: float = 1e-4, missed: float = 1e-2) -> None:
        super().__init__()
        if not (as_number(false) > 0 and as_number(missed) > 0 and as_number(false) + as_number(missed) < 1):
            raise ValueError(f"false, missed: expected probabilities above 0 with a sum below 1, received "
                             f"{false}, {missed}")  # fmt: skip
        self.upper, self.lower = math.log((1 - missed) / false), math.log(missed / (1 - false))

    def forward(self, track: Track) -> tuple[Tensor, Tensor]:
        """By the bounds that the score has passed."""
        return track.confirmed | (track.score >= self.upper), ~track.confirmed & (track.score <= self.lower)

    def extra_repr(self) -> str:
        """Both bounds of the score."""
        return f"lower={self.lower:.4g}, upper={self.upper:.4g}"


class Existence(Confirmation):
    """Confirmation by the probability of existence, which a scan updates and a finite lifetime lowers.

    A target claims measurements only as probably as it exists, so that tentative ones in dense clutter take little from
    those that exist.  A new one exists with the probability ``birth``, times that nothing else explains its
    measurements: no target that is there already, nor the map of clutter.  ``Track.score`` is the log of the
    probability over its complement.

    Args:
        lifetime: mean of the time that a target exists, s; it is exponential, so that before a scan ``dt`` after the
            last no target exists with more than ``1 - dt / lifetime``.
        birth: probability that a new tentative target exists.
        confirmed: probability of existence at which a target is confirmed; far above ``1 - dt / lifetime`` it is hardly
            ever reached.
        deleted: probability of existence at which a target is deleted, confirmed or not.

    Raises:
        ValueError: a lifetime that is not finite and above 0, or not ``0 < deleted < birth < confirmed < 1``.

    Source: Musicki & Evans (2004), "Joint Integrated Probabilistic Data Association: JIPDA".  Differs: births
    are less probable where something else explains their measurements.
    """

    scored = deletes = True

    def __init__(
        self, lifetime: float = 300.0, birth: float = 0.1, *, confirmed: float = 0.99, deleted: float = 1e-3
    ) -> None:
        super().__init__()
        if not 0 < as_number(deleted) < as_number(birth) < as_number(confirmed) < 1:
            raise ValueError("deleted, birth, confirmed: expected probabilities above 0 and below 1 in that order, "
                             f"received {deleted}, {birth}, {confirmed}")  # fmt: skip
        self.lifetime, self.birth = positive("lifetime", lifetime, "finite seconds"), float(birth)
        self.upper, self.lower = (math.log(x / (1 - x)) for x in (confirmed, deleted))

    def first(self, new: Tensor) -> Tensor:
        """Log odds of existence of a new target."""
        return torch.logit(self.birth * new)

    def predicted(self, score: Tensor, dt: Tensor) -> Tensor:
        """Log odds after ``dt`` seconds, in which a target may have ceased to exist."""
        past = dt / self.lifetime
        return -past - torch.logaddexp(-score, torch.log(-torch.expm1(-past)))

    def exists(self, score: Tensor) -> Tensor:
        """The probability of existence, whose log odds are the score."""
        return score.sigmoid()

    def forward(self, track: Track) -> tuple[Tensor, Tensor]:
        """Compares the score with both bounds; a confirmed target stays confirmed until it is deleted."""
        return track.confirmed | (track.score >= self.upper), track.score <= self.lower

    def extra_repr(self) -> str:
        """Lifetime, probability of a birth, and both bounds of the score."""
        bounds = f"lower={self.lower:.4g}, upper={self.upper:.4g}"
        return f"lifetime={self.lifetime:g}, birth={self.birth:g}, {bounds}"


class Deletion(nn.Module):
    """Deletion of targets, tentative or confirmed, by any of four criteria; None for one that is not used.

    Args:
        misses: successive misses by the filter's own sensor.  A miss by another sensor counts as many as have the same
            probability: ``log(1 - P)`` of the other sensor over that of the own, where ``P`` is the probability of a
            detection within the gate times that of being visible to the sensor.
        score_drop: probability such that the score has fallen by more than its log below the highest so far.
        spread: largest standard deviation of the position in any direction, m.
        speed: highest speed, m/s: a target that was led away by false measurements soon exceeds it.

    Raises:
        ValueError: a number of scans below 1, a probability that is not in (0, 1), a length or a speed that is not
            above 0, or nothing at all, so that no target would ever end.

    Source: Blackman & Popoli (1999), chapter 6, for the drop of the score.
    """

    def __init__(
        self, misses: int | None = 5, *, score_drop: float | None = None, spread: float | None = None,
        speed: float | None = None,
    ) -> None:  # fmt: skip
        super().__init__()
        if misses is None and score_drop is None and spread is None and speed is None:
            raise ValueError("misses, score_drop, spread, speed: expected at least one of them, received none")
        if misses is not None and not is_integer(misses, 1):
            raise ValueError(f"misses: expected 1 scan or more, received {misses!r}")
        self.misses = misses
        self.score_drop = None if score_drop is None else fraction("score_drop", score_drop)
        self.spread = None if spread is None else positive("spread", spread, "finite metres")
        self.speed = None if speed is None else positive("speed", speed)

    def forward(self, track: Track, motion: Motion, belief: Gaussian) -> Tensor:
        """Which targets ``(N,)`` are deleted.

        Args:
            track: of the targets.
            motion: of them.
            belief: ``(N,)`` in its coordinates.
        """
        deleted = torch.zeros_like(track.confirmed)
        if self.misses is not None:
            deleted = deleted | (track.misses >= self.misses)
        if self.score_drop is not None:
            deleted = deleted | (track.score - track.best < math.log(self.score_drop))
        if self.spread is not None:
            deleted = deleted | (torch.linalg.matrix_norm(positions(motion, belief).scale_tril, 2) > self.spread)
        if self.speed is not None:
            deleted = deleted | (velocities(motion, belief).norm(dim=-1) > self.speed)
        return deleted

    def extra_repr(self) -> str:
        """Values of the four criteria."""
        return f"misses={self.misses}, score_drop={self.score_drop}, spread={self.spread}, speed={self.speed}"

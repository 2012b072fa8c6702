"""Checks of a motion and a sensor by themselves and on a short track, with a report in words."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from torchfra.filters.base import Filter
from torchfra.filters.imm import IMM
from torchfra.filters.srckf import SRCKF
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.numbers import as_numbers
from torchfra.sensors.base import Sensor
from torchfra.steps.models import check_models
from torchfra.testing.battery import Outcome, tried
from torchfra.testing.case import CHECKS, STEPS, TRACKS, drawn, make_case
from torchfra.testing.expectations import as_large_as, line_of_error, unexpected, with_line
from torchfra.testing.parts import Part, checks_of, parts_of
from torchfra.testing.results import where_its_models_hold_it_is_no_worse_than_a_kalman_filter as compared
from torchfra.types import CompileError, Gaussian

TYPICAL = {
    "position": (100.0, 10.0), "velocity": (3.0, 1.0), "angle": (0.1, 0.05), "rate": (0.1, 0.05),
    "range rate / range": (0.02, 0.01), "inverse range": (0.01, 0.001), "steering": (0.05, 0.02),
}  # fmt: skip
"""Typical value and standard deviation of a component, by its name or kind, in its unit; 1 and 1 by default."""
WORDS = {"passed": "right", "skipped": "skipped"}


@dataclass(frozen=True)
class ModelReport:
    """The result of checking a motion and a sensor; as text, the problems with their places, and the checks passed."""

    models: str
    found: tuple[Outcome, ...]

    @property
    def ok(self) -> bool:
        """True if no check has failed."""
        return not self.problems

    @property
    def problems(self) -> tuple[str, ...]:
        """A sentence for each problem."""
        return tuple(self._grouped("failed"))

    def __str__(self) -> str:
        count = len(self.problems)
        lines = [f"{self.models}: {count or 'no'} problem{'s' * (count != 1)}"]
        lines += [f"  {i}. {problem}" for i, problem in enumerate(self.problems, 1)]
        lines += [f"  {word}: {line}" for verdict, word in WORDS.items() for line in self._grouped(verdict)]
        return "\n".join(lines)

    def _grouped(self, verdict: str) -> Iterator[str]:
        """A line for each reason of a verdict: the method, the checks, the reason."""
        those = [x for x in self.found if x.verdict == verdict]
        for way, reason in dict.fromkeys((x.way, x.reason) for x in those):
            checks = ", ".join(x.check for x in those if (x.way, x.reason) == (way, reason))
            yield f"{way}: {checks}{f': {reason}' if reason else ''}"


def check_model(
    motion: Motion,
    sensor: Sensor,
    *,
    state: object = None,
    dt: float = 1.0,
    u: object = None,
    compiled: bool = False,
    seed: int = 0,
) -> ModelReport:
    """Checks a motion and a sensor of your own on everything that filters require, and reports problems in words.

    Each is tried by itself first: shapes, batches, a ``dt`` for each state, precision, gradients, ``vmap``, process
    noise, angles that are not declared; then both in a filter on short tracks: see ``check_filter``.  Copies of them
    are tried, in float64.

    Args:
        motion: how targets move; of a ``Bank`` all its motions.
        sensor: what is measured.
        state: ``(n,)`` a state near which both should work; by default one that fits ``motion.kinds``.
        dt: seconds of a step; as short as yours are where a motion bends strongly.
        u: ``(k,)`` inputs that the models need at a step.
        compiled: whether to try the compiled filter too, which takes some seconds to compile.
        seed: of the tracks.

    Returns:
        A report: ``ok``, ``problems``, and as text all of it, with the lines of yours that are to blame.

    Raises:
        ValueError: what is neither a motion nor a sensor, two that do not go together, a state or ``u`` of another
            shape or not finite, or a ``dt`` that is not above 0.
    """
    check_models(motion, sensor)
    if not (isinstance(dt, int | float) and 0 < dt < math.inf):
        raise ValueError(f"dt: expected a finite number of seconds above 0, received {dt!r}")
    state = None if state is None else as_numbers(state, "state")
    if state is not None and not (state.shape == (motion.size,) and bool(state.isfinite().all())):
        expected = f"finite numbers ({motion.size},) of [{', '.join(motion.components)}]"
        received = state.tolist() if state.shape == (motion.size,) else tuple(state.shape)
        raise ValueError(f"state: expected {expected}, received {received}")
    u = None if u is None else as_numbers(u, "u")
    if u is not None and not (u.dim() == 1 and bool(u.isfinite().all())):
        raise ValueError(f"u: expected finite numbers (k,), received {u.tolist() if u.dim() == 1 else tuple(u.shape)}")
    motion, sensor = copy.deepcopy(motion).double(), copy.deepcopy(sensor).double()
    belief = _typical(motion, state)
    names = f"{type(motion).__name__} and {type(sensor).__name__}"
    found = [x for part in parts_of(motion, sensor, belief, dt, u, seed) for x in _by_itself(part)]
    if any(x.verdict == "failed" for x in found):
        found.append(Outcome("all", "in a filter", "skipped", "until they are right by themselves"))
        return ModelReport(names, tuple(found))
    return ModelReport(names, (*found, *_in_a_filter(motion, sensor, belief, dt, u, compiled, seed)))


def _typical(motion: Motion, state: Tensor | None) -> Gaussian:
    """A belief around a state."""
    named = zip(motion.components, motion.kinds, strict=True)
    each = [TYPICAL.get(name, TYPICAL.get(kind, (1.0, 1.0))) for name, kind in named]
    mean, std = torch.tensor(each, dtype=torch.float64).unbind(-1)
    return Gaussian(mean if state is None else state.double(), std.diag())


def _by_itself(part: Part) -> Iterator[Outcome]:
    """The outcome of each check on one motion or sensor, up to the first that fails."""
    for check, tried_on in checks_of(part):
        name = check.__name__.replace("_", " ")
        try:
            check(tried_on)
        except AssertionError as error:
            line = line_of_error(error) or tried_on.line
            yield Outcome(name, tried_on.name, "failed", with_line(str(error), line))
            return
        except Exception as error:
            without = part.u is None and ("NoneType" in str(error) or "received None" in str(error))
            hint = " (if it needs a u, hand one in: u=)" if without else ""
            yield Outcome(name, tried_on.name, "failed", unexpected(error, tried_on.line, hint))
            return
        yield Outcome(name, part.name, "passed")


def _in_a_filter(
    motion: Motion, sensor: Sensor, belief: Gaussian, dt: float, u: Tensor | None, compiled: bool, seed: int
) -> tuple[Outcome, ...]:
    """Outcomes of checks of ``check_filter`` on an ``SRCKF`` with both models.

    Not of the comparison with an ``SRCKF``, which it is.
    """
    try:
        z, prior = _simulated(motion, sensor, belief, dt, u, seed)
        known = None if u is None else u.double().expand(STEPS, -1)
        case = make_case(_filter(motion, sensor), z, prior, dt, known, seed, thorough=False)
    except Exception as error:
        return (Outcome("a simulated track", "in a filter", "failed", unexpected(error)),)
    names = [name for name, check in CHECKS.items() if check.function is not compared]
    way = {"eager": "in a filter", "compiled": "in a compiled filter"}
    without: tuple[Outcome, ...] = ()
    if compiled:
        from torchfra.compiler.llvm import binding  # only here: without it nothing of the compiler is loaded

        try:
            binding()
        except CompileError as error:
            compiled, without = False, (Outcome("all", way["compiled"], "skipped", str(error)),)
    with as_large_as(case.z, case.std):
        outcomes = tried(case, names, compiled=compiled).outcomes
    return *(o._replace(check=o.check.replace("_", " "), way=way[o.way]) for o in outcomes), *without


def _filter(motion: Motion, sensor: Sensor) -> Filter:
    """An ``SRCKF`` with both models; for a bank of motions, an ``IMM`` of it."""
    inner = SRCKF(motion, sensor)
    if not isinstance(motion, Bank):
        return inner
    count = len(motion)
    return IMM(inner, transition=0.9 * torch.eye(count) + 0.1 / count)


def _simulated(
    motion: Motion, sensor: Sensor, belief: Gaussian, dt: float, u: Tensor | None, seed: int
) -> tuple[Tensor, Gaussian]:
    """Noisy measurements of motion from the mean of a belief without process noise, and the belief as prior."""
    one = motion[0] if isinstance(motion, Bank) else motion
    prior = Gaussian(belief.mean.expand(TRACKS, -1), belief.scale_tril)
    known = None if u is None else u.double().expand(TRACKS, -1)
    generator, seconds = torch.Generator().manual_seed(seed), torch.tensor(dt, dtype=torch.float64)
    return drawn(one, sensor, prior.mean, seconds, known, STEPS, generator)[1], prior

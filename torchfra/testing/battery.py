"""The battery: every check on a filter, eager and compiled, and a report of the results."""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from torchfra.filters.base import Filter
from torchfra.gaussian.arguments import LostDigits
from torchfra.tables import text_table
from torchfra.testing import derivatives, results  # noqa: F401  they hold the checks
from torchfra.testing.case import CHECKS, Case, SkipCheck, make_case, registered
from torchfra.testing.expectations import unexpected
from torchfra.types import Gaussian


class Outcome(NamedTuple):
    """The result of one check."""

    check: str
    way: str
    """``"eager"`` or ``"compiled"``; for a motion or a sensor by itself, the method that was tried."""
    verdict: str
    """``"passed"``, ``"skipped"`` or ``"failed"``."""
    reason: str = ""
    """Why it was skipped, or what was expected and received, and the line of the user's code at fault."""


@dataclass(frozen=True)
class Report:
    """The results of all checks; as text, a table."""

    filter: str
    outcomes: tuple[Outcome, ...]

    def of(self, verdict: str) -> tuple[Outcome, ...]:
        """The outcomes with this verdict: ``"passed"``, ``"skipped"`` or ``"failed"``."""
        return tuple(outcome for outcome in self.outcomes if outcome.verdict == verdict)

    def __str__(self) -> str:
        return f"{self.filter}\n" + text_table(Outcome._fields, self.outcomes, align="<")


def check_filter(
    filter: Filter | str,
    z: Tensor | None = None,
    prior: Gaussian | None = None,
    *,
    dt: float = 1.0,
    u: Tensor | None = None,
    only: Collection[str] = (),
    skip: Collection[str] = (),
    compiled: bool = True,
    thorough: bool = False,
    seed: int = 0,
) -> Report:
    """Checks a filter, or your own motion, sensor or weight inside one, for every property that filters have.

    The filter is copied.  Checks run in float64 and float32, eager and compiled.

    Args:
        filter: any, or the name of one that is registered (``torchfra.register``), around usual models.
        z: ``(B, T, m)`` measurements to try it on, of scans ``(B, T, J, m)``; 3 tracks and 6 steps of them are used.
            By default they are simulated by the filter's own motion and sensor.
        prior: the belief before them.
        dt: seconds between steps.
        u: ``(T, k)`` or ``(B, T, k)`` inputs of the models at each step.
        only: names of checks; by default all of ``testing.CHECKS``.
        skip: names of checks to leave out, such as those of gradients for a hard decision.
        compiled: whether to try the compiled filter, which takes some seconds to compile.
        thorough: whether to try all combinations of options; compiled this takes several times as long.
        seed: of the simulated tracks.

    Returns:
        The checks that passed, and those that were skipped, with the reasons.

    Raises:
        AssertionError: names the filter and every check that fails, with expected and received values.
        ValueError: an unknown check or name, or tracks that do not suffice.
    """
    filter = registered(filter) if isinstance(filter, str) else filter
    unknown = {*only, *skip} - CHECKS.keys()
    if unknown:
        raise ValueError(f"only, skip: expected names of testing.CHECKS, received {', '.join(sorted(unknown))}")
    names = [name for name in CHECKS if (not only or name in only) and name not in skip]
    report = tried(make_case(filter, z, prior, dt, u, seed, thorough), names, compiled=compiled)
    failed = report.of("failed")
    if failed:
        reasons = "\n".join(f"{name}, {way}: {reason}" for name, way, _, reason in failed)
        raise AssertionError(f"{report.filter}: {len(failed)} of {len(report.outcomes)} checks failed\n{reasons}")
    return report


def tried(case: Case, names: Collection[str], *, compiled: bool) -> Report:
    """Runs the checks of these names."""
    ways = [(name, way) for name in names for way in CHECKS[name].ways if compiled or way == "eager"]
    return Report(type(case.filter).__name__, tuple(_outcome(case, name, way) for name, way in ways))


def _outcome(case: Case, name: str, way: str) -> Outcome:
    """Runs one check."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", LostDigits)  # whatever the data, single precision is tried
            CHECKS[name].function(case.as_compiled if way == "compiled" else case)
    except SkipCheck as reason:
        return Outcome(name, way, "skipped", str(reason))
    except AssertionError as error:
        return Outcome(name, way, "failed", str(error))
    except Exception as error:
        return Outcome(name, way, "failed", unexpected(error))
    return Outcome(name, way, "passed")

"""Times systems in turn, keeps the results as rows, and prints them as a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch

from benchmarks.clock import PASS, WARM, first_call, one_pass
from torchfra.running.progress import progress_bar
from torchfra.tables import significant, text_table

Row = dict[str, Any]
_MEASURED: dict[str, tuple[str, Callable[[float], str]]] = {
    "median": ("median us", significant), "q1": ("q1 us", significant), "q3": ("q3 us", significant),
    "ratio": ("ratio", "{:.2f}".format), "ratio_q1": ("q1", "{:.2f}".format), "ratio_q3": ("q3", "{:.2f}".format),
    "error": ("error", "{:.6g}".format), "first_call_s": ("first call s", "{:.1f}".format),
    "peak_mib": ("peak MiB", "{:.0f}".format),
}  # fmt: skip
"""Keys of rows that are not labels: their titles in a table, and what writes them."""


class System(Protocol):
    """A system that can be timed."""

    def first_call(self) -> float:
        """Seconds of the first call, which compiles what the system compiles."""

    def one_pass(self) -> float:
        """Seconds per call, in one pass."""


class Here:
    """A call in this process.

    Args:
        call: what is timed.
        device: ``"cuda"`` waits for the GPU after each call.
        warming: calls after the first until all is warm, and their seconds: at most so many.
        seconds: that a pass lasts at least.
    """

    def __init__(
        self,
        call: Callable[[], Any],
        device: str = "cpu",
        warming: tuple[int, float] = (10, WARM),
        seconds: float = PASS,
    ) -> None:
        self.call, self.device, self.warming, self.seconds = call, device, warming, seconds

    def __call__(self) -> None:
        """Makes the call and waits for its end."""
        self.call()
        if self.device == "cuda":
            torch.cuda.synchronize()

    def first_call(self) -> float:
        """Seconds of the first call, after which a few more make all warm."""
        return first_call(self, *self.warming)

    def one_pass(self) -> float:
        """Seconds per call, in one pass."""
        return one_pass(self, self.seconds)


def timed(
    systems: Mapping[str, System], passes: int, count: int, beside: str | None = None, **labels: Any
) -> list[Row]:
    """Rows of the systems, with one pass of each in turn, so that a machine whose speed drifts treats all alike.

    Args:
        systems: by name.
        passes: how many of each.
        count: track steps in a call.
        beside: system by whose time in the same pass those of all are divided too.
        labels: keys and values that every row has.

    Returns:
        ``system``, the labels, ``median``, ``q1`` and ``q3`` in microseconds per track and step, ``first_call_s``;
        ``ratio``, ``ratio_q1`` and ``ratio_q3`` beside one.
    """
    first = {name: system.first_call() for name, system in systems.items()}
    seconds: dict[str, list[float]] = {name: [] for name in systems}
    for _ in progress_bar(range(passes), "pass", True):
        for name, system in systems.items():
            seconds[name].append(system.one_pass())
    rows = []
    for name, values in seconds.items():
        q1, median, q3 = (float(x) for x in np.percentile(values, [25, 50, 75]) / count * 1e6)
        rows.append({"system": name, **labels, "median": median, "q1": q1, "q3": q3, "first_call_s": first[name]})
        if beside is not None:
            ratios = np.percentile(np.divide(values, seconds[beside]), [50, 25, 75])
            rows[-1] |= dict(zip(("ratio", "ratio_q1", "ratio_q3"), map(float, ratios), strict=True))
    return rows


def table(rows: Sequence[Row]) -> str:
    """Rows as text: system, labels, and times in microseconds per track and step; a cell is empty where a row has none.

    Args:
        rows: from ``timed``, at least one; also with ``peak_mib``.
    """
    present = dict.fromkeys(key for row in rows for key, value in row.items() if value is not None)
    measured = [key for key in _MEASURED if key in present]
    labels = [key for key in present if key not in ("system", *_MEASURED)]
    titles = [_MEASURED[key][0] for key in measured]
    forms = dict.fromkeys(("system", *labels), str) | {key: _MEASURED[key][1] for key in measured}
    cells = [["" if row.get(key) is None else form(row[key]) for key, form in forms.items()] for row in rows]
    return text_table(["system", *labels, *titles], cells)


def learners(steps: Mapping[str, Callable[[], Any]]) -> dict[str, System]:
    """Steps of learning as systems; compiled ones get ready over many calls."""
    warming = {name: (300, 20.0) if name.endswith("compiled") else (3, 5.0) for name in steps}
    return {name: Here(step, warming=warming[name], seconds=0.2) for name, step in steps.items()}


def calls(systems: Mapping[str, Callable[[], Any]], device: str = "cpu") -> dict[str, System]:
    """Calls of this process as systems."""
    return {name: Here(call, device) for name, call in systems.items()}

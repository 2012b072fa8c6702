"""Times systems in turn, and prints and keeps the results as rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import torch

from benchmarks.clock import once, one_pass
from torchfra.app.progress import progress_bar

Row = dict[str, Any]


class System(Protocol):
    """What can be timed."""

    def first_call(self) -> float:
        """Seconds of the first call, which compiles what the system compiles."""

    def one_pass(self) -> float:
        """Seconds per call, in one pass."""


class Here:
    """A call in this process.

    Args:
        call: what is timed.
        device: ``"cuda"`` waits for the GPU after each call.
    """

    def __init__(self, call: Callable[[], Any], device: str = "cpu") -> None:
        self.call, self.device = call, device

    def __call__(self) -> None:
        """The call, finished."""
        self.call()
        if self.device == "cuda":
            torch.cuda.synchronize()

    def first_call(self) -> float:
        """Seconds of the first call; a second one follows, after which memory and caches are warm."""
        seconds = once(self)
        self()
        return seconds

    def one_pass(self) -> float:
        """Seconds per call, in one pass."""
        return one_pass(self)


def timed(systems: Mapping[str, System], passes: int, count: int, **labels: Any) -> list[Row]:
    """Rows of the systems, with one pass of each in turn, so that a machine whose speed drifts treats all alike.

    Args:
        systems: by name.
        passes: how many of each.
        count: track steps in a call.
        labels: keys and values that every row has.

    Returns:
        ``system``, the labels, ``median``, ``q1`` and ``q3`` in microseconds per track and step, ``first_call_s``.
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
        where = ", ".join(f"{key} {value}" for key, value in labels.items())
        print(f"{name:<28} {where}: {median:9.3f} us [{q1:.3f}, {q3:.3f}], first call {first[name]:.1f} s", flush=True)
    return rows


def calls(systems: Mapping[str, Callable[[], Any]], device: str = "cpu") -> dict[str, System]:
    """Calls of this process as systems."""
    return {name: Here(call, device) for name, call in systems.items()}

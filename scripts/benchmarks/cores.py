"""Threads of one process, and processes of one thread each: how many times faster they are than one thread."""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch

from benchmarks.clock import first_call, one_pass
from benchmarks.timing import Row, System, timed
from torchfra import keep_memory
from torchfra.catalogue import make_scenario, scenario_filter
from torchfra.evaluation import run


def cores(options: argparse.Namespace) -> list[Row]:
    """A compiled call of each filter and batch size on 1, 2, 4, ... threads, and shared out among as many processes.

    Rows have ``times``: how many times faster than one thread.
    """
    rows: list[Row] = []
    steps = make_scenario(options.scenario).steps
    for batch in map(int, (options.batch or "1000,10000,100000").split(",")):
        for name in options.filters.split(","):
            job = (options.scenario, options.initial, name)
            with teams(job, batch, counts(torch.get_num_threads())[1:]) as processes:
                threads = {f"{name}, {count} threads": Threads(job, batch, count) for count in counts()}
                systems: dict[str, System] = {**threads, **processes}
                measured = timed(systems, options.passes, batch * steps, batch=batch)
            rows += [{**row, "times": f"{measured[0]['median'] / row['median']:.2f}"} for row in measured]
    return rows


def long_pass(call: Callable[[], Any]) -> float:
    """Seconds per call, in a pass of a fifth of a second: those that have slept wake up."""
    return one_pass(call, 0.2)


def counts(most: int | None = None) -> list[int]:
    """Numbers of threads: 1, 2, 4, ... and all cores."""
    most = torch.get_num_threads() if most is None else most
    return [count for count in (1 << k for k in range(16)) if count < most] + [most]


def call_of(job: Sequence[str], first: int, count: int) -> Callable[[], Any]:
    """The compiled filter of a job on some of its tracks."""
    scenario_name, initial, name = job
    scenario = make_scenario(scenario_name, initial=initial)
    data = scenario.simulate(count, 0, first=first)
    f = scenario_filter(name, scenario).compile()
    return lambda: run(f, scenario, data)


class Threads:
    """A call on so many threads of this process."""

    def __init__(self, job: Sequence[str], batch: int, count: int) -> None:
        self._call, self._count = call_of(job, 0, batch), count

    def first_call(self) -> float:
        """Seconds of the first call."""
        return self._timed(first_call)

    def one_pass(self) -> float:
        """Seconds per call, in one pass."""
        return self._timed(long_pass)

    def _timed(self, clock: Callable[[Callable[[], Any]], float]) -> float:
        before = torch.get_num_threads()
        torch.set_num_threads(self._count)
        try:
            return clock(self._call)
        finally:
            torch.set_num_threads(before)


class Team:
    """Processes of one thread each, that share the tracks; they wait while they are not asked."""

    def __init__(self, pipes: Sequence[Any]) -> None:
        self._pipes = pipes

    def first_call(self) -> float:
        """Seconds of the first call."""
        return first_call(self)

    def one_pass(self) -> float:
        """Seconds per call, in one pass."""
        return long_pass(self)

    def __call__(self) -> None:
        """One call of all processes, finished."""
        for pipe in self._pipes:
            pipe.send(True)
        for pipe in self._pipes:
            pipe.recv()


@contextmanager
def teams(job: Sequence[str], batch: int, sizes: Sequence[int]) -> Iterator[dict[str, Team]]:
    """A team of each size, by name; their processes end with the context."""
    spawn = multiprocessing.get_context("spawn")
    every, pipes = {}, []
    for size in sizes:
        ends = [spawn.Pipe() for _ in range(size)]
        shares = [(batch * k // size, batch * (k + 1) // size) for k in range(size)]
        for (_, there), (first, last) in zip(ends, shares, strict=True):
            spawn.Process(target=work, args=(there, job, first, last - first), daemon=True).start()
        every[f"{job[-1]}, {size} processes"] = Team([here for here, _ in ends])
        pipes += [here for here, _ in ends]
    try:
        yield every
    finally:
        for pipe in pipes:
            pipe.send(False)


def work(pipe: Any, job: Sequence[str], first: int, count: int) -> None:
    """The work of a process: a call whenever it is asked for one."""
    torch.set_num_threads(1)
    keep_memory()
    call = call_of(job, first, count)
    while pipe.recv():
        call()
        pipe.send(None)

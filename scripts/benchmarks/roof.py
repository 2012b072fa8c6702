"""Compiled filters against what this machine could do at most with the same arithmetic and the same bytes."""

from __future__ import annotations

import argparse
import copy
import ctypes
import os
import subprocess
from array import array
from collections import Counter
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import torch

from benchmarks.clock import one_pass
from benchmarks.timing import Row, calls, timed
from torchfra.catalogue import make_scenario, scenario_filter, track_filters
from torchfra.compiler.engine import Compiled
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.program import Program
from torchfra.compiler.schedule import conditions, regions
from torchfra.compiler.source import SCALARS, Port, Scan
from torchfra.evaluation import run
from torchfra.filters import Filter
from torchfra.running.jobs import one_thread
from torchfra.tree import map_tensors

ROUNDS, LANES = 20_000, 2048
"""Rounds of 16 multiply-adds in a call; tracks for which a function is timed, which stay in the first cache."""
PRECISIONS = {"double": torch.float64, "single": torch.float32}
COSTLY = {"div": 2, "sqrt": 1, "norm": 2, "atan2": 2, "hypot": 2, "exp": 1, "expm1": 1, "log": 1, "log1p": 1, "erf": 1,
          "sin": 1, "cos": 1, "tan": 1, "asin": 1, "acos": 1, "atan": 1, "pow": 2}  # fmt: skip
"""Operations whose time is measured, with the number of their arguments; any other is half a fused multiply-add."""
FILTERS = "ukf,srckf,fra_srckf,fra"
"""The default of the other benchmarks; here it means all."""


class Machine(NamedTuple):
    """The measured performance of a machine, all threads together."""

    operations: float
    """Operations per second on numbers; a fused multiply-add counts as two."""
    costs: dict[str, float]
    """Seconds of an operation for one number."""
    bandwidth: dict[int, float]
    """Bytes per second to memory of so many bytes, by the better of two ways to write."""

    @classmethod
    def measured(cls, dtype: torch.dtype, sizes: set[int]) -> Machine:
        """Measures this machine."""
        size = 64 if "AVX512" in torch.backends.cpu.get_cpu_capability() else 32
        function, width = native(SCALARS[dtype], size), size // dtype.itemsize
        threads, source = torch.get_num_threads(), torch.full((1024 * width,), 0.5, dtype=dtype)

        def seconds(count: int, kind: int, out: torch.Tensor) -> float:
            ports = array("q", [source.data_ptr(), 0, 0, 0, out.data_ptr(), 0, 0, 0])
            address = ports.buffer_info()[0]
            return min(one_pass(lambda: function(count, kind, threads, address, address + 32)) for _ in range(5))

        operations = threads * ROUNDS * 16 * width * 2 / seconds(ROUNDS, 0, torch.zeros(width, dtype=dtype))
        bandwidth = {}
        for size in sizes:
            out = torch.zeros(size // dtype.itemsize // width * width + width, dtype=dtype)
            bandwidth[size] = size / min(seconds(len(out) // width - 1, kind, aligned(out)) for kind in (1, 2))
        return cls(operations, {op: cost(op, count, dtype) / threads for op, count in COSTLY.items()}, bandwidth)


def native(scalar: str, size: int) -> Any:
    """The function of ``roof.cpp`` for such numbers in registers of so many bytes."""
    with TemporaryDirectory() as folder:
        made = Path(folder) / "roof.so"
        flags = f"-O2 -march=native -fopenmp -shared -fPIC -std=c++17 -w -DSCALAR={scalar} -DBYTES={size}"
        command = [os.environ.get("CXX", "g++"), *flags.split(), str(Path(__file__).with_suffix(".cpp"))]
        subprocess.run([*command, "-o", str(made)], check=True)
        run = ctypes.CDLL(str(made)).run
    run.argtypes = [*[ctypes.c_int64] * 2, ctypes.c_int, *[ctypes.c_void_p] * 2]
    return run


def aligned(x: torch.Tensor) -> torch.Tensor:
    """From its first entry on that lies on a line of the cache."""
    return x[-x.data_ptr() % 64 // x.itemsize :]


def cost(op: str, count: int, dtype: torch.dtype) -> float:
    """Seconds of one thread for an operation on one number: what 64 of them in a kernel take more than 32 do."""
    times = []
    for repeats in (32, 64):
        book, total = Expressions(), 0
        x = book.input()
        for k in range(repeats):
            argument = book.apply("add", x, book.constant(0.01 * k))
            more = [book.apply("add", x, book.constant(0.3 + 0.02 * k))] * (count - 1)
            total = book.apply("add", total, book.apply(op, argument, *more))
        program = Program(Scan(book, [], [], [_port(x)], [_port(total)], dtype=dtype))
        data = torch.rand(LANES, 1, dtype=dtype, generator=torch.Generator().manual_seed(0)) * 0.3 + 0.01
        with one_thread():
            times.append(min(one_pass(partial(program, data.shape[:1], 1, [data])) for _ in range(5)))
    return max(times[1] - times[0], 0.0) / 32 / LANES


def _port(number: int) -> Port:
    return Port([number], torch.Size([1]))


class Work(NamedTuple):
    """Operations and bytes of a step of one track."""

    operations: Counter[str]
    read: int
    """Bytes."""
    written: int

    def bounds(self, machine: Machine, size: int) -> tuple[float, float]:
        """Seconds that arithmetic takes at least, and memory."""
        cheap = sum(n for op, n in self.operations.items() if op not in machine.costs)
        costly = sum(n * machine.costs[op] for op, n in self.operations.items() if op in machine.costs)
        return cheap / machine.operations + costly, (self.read + self.written) / machine.bandwidth[size]


def work(f: Filter) -> Work:
    """What a compiled filter that has run computes at each step, for every track: what few need is left out."""
    compiled: Compiled = f.__dict__["engine"]
    scan = next(x for x in compiled._versions[0].kernels.values() if x.step.repeated).step.forwards()
    step = scan.loop()
    nodes, live = step.book.nodes, [i for i in step.live if i in step.varying and step.book.nodes[i][0] != "input"]
    needed = conditions(step.book, step.live, [*step.carried.values(), *(i for i, _ in step.stores)])
    guards = regions(step.book, live, needed)
    always = [i for i in live if guards[i] is None]
    operations = Counter(nodes[i][0] for i in always)
    operations["add"] += sum(2 * (len(nodes[i][1]) - 2) for i in always if nodes[i][0] == "norm")
    sizes = [[len(p.ids) * (1 if p.truth else scan.dtype.itemsize) for p in ports if p.timed]
             for ports in (scan.reads, scan.writes)]  # fmt: skip
    return Work(operations, *map(sum, sizes))


def roof(options: argparse.Namespace) -> list[Row]:
    """Every filter (or ``--filters``) compiled, against the machine: time over the larger of the two bounds.

    The bounds hold what every track needs at every step: of a filter with branches, not what few of them need.
    """
    scenario = make_scenario(options.scenario, initial=options.initial)
    every = [name for name in track_filters() if name != "alphabeta"]  # which takes positions, no bearings
    names = every if options.filters == FILTERS else options.filters.split(",")
    rows: list[Row] = []
    for batch in map(int, (options.batch or "1000,10000").split(",")):
        tracks = map_tensors(lambda x: x.to(PRECISIONS[options.precision]), scenario.simulate(batch, 0))
        steps = min(scenario.steps, max(10, 1_000_000 // batch))
        tracks = tracks._replace(z=tracks.z[:, :steps], u=None if tracks.u is None else tracks.u[:steps])
        filters = {name: copy.deepcopy(scenario_filter(name, scenario)).compile() for name in names}
        systems = {name: partial(run, f, scenario, tracks) for name, f in filters.items()}
        timings = timed(calls(systems), options.passes, batch * steps, batch=batch)
        works = {name: work(f) for name, f in filters.items()}
        sizes = {name: (w.read + w.written) * batch * steps for name, w in works.items()}
        machine = Machine.measured(tracks.z.dtype, set(sizes.values()))
        rows += [_against(row, works[row["system"]], machine, sizes[row["system"]]) for row in timings]
    report(machine)
    return rows


def _against(row: Row, work: Work, machine: Machine, size: int) -> Row:
    arithmetic, memory = (seconds * 1e6 for seconds in work.bounds(machine, size))
    labels = {"batch": row["batch"], "operations": sum(work.operations.values()), "bytes": work.read + work.written,
              "arithmetic us": round(arithmetic, 4), "memory us": round(memory, 4)}  # fmt: skip
    times = {key: row[key] for key in ("median", "q1", "q3")}
    over = {f"{key} over roof": round(value / max(arithmetic, memory), 2) for key, value in times.items()}
    return {"system": row["system"], **labels, **over, **times, "first_call_s": row["first_call_s"]}


def report(machine: Machine) -> None:
    """Prints the performance of the machine."""
    print(f"{machine.operations / 1e9:.0f} billion operations a second (two for each fused multiply-add)")
    rates = [f"{rate / 1e9:.1f} GB/s to {size / 1e6:.0f} MB" for size, rate in sorted(machine.bandwidth.items())]
    print(f"memory: {', '.join(rates)}")
    print("ns for one number: " + ", ".join(f"{op} {seconds * 1e9:.2f}" for op, seconds in machine.costs.items()))

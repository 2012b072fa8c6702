"""Times filters on one job: two bearings, six states, 100 steps, float64, as one tensor program.

    python scripts/benchmark.py                                    filters, eager and compiled
    python scripts/benchmark.py --peers --filters srckf,fra        and JAX, dynamax, FilterPy, C++ in the same run
    python scripts/benchmark.py --what step,training               one measurement at a time; forward and backward
    python scripts/benchmark.py --what scaling --figure scaling.png
    python scripts/benchmark.py --what positions                   the alpha-beta bank on 100,000 tracks in space

Prints microseconds per track and step: median and quartiles of several passes, all systems in turn within a pass, so
that a machine whose speed drifts treats them alike.  Compile time is apart.  Ours returns whole estimates (means,
roots, scores at every step); the others the last mean only.
"""

from __future__ import annotations

import argparse
import copy
import ctypes
import platform
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchfra import keep_memory, presets, scenarios
from torchfra.app import plotting
from torchfra.app.atomic_write import write_json
from torchfra.app.evaluate import run, versions
from torchfra.app.progress import progress_bar
from torchfra.catalogue import SCENARIOS, make_scenario, scenario_filters, track_filters
from torchfra.linalg import triangular
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.sensors import Position
from torchfra.types import Gaussian

Row = dict[str, Any]


def timed(
    systems: dict[str, Callable[[], Any]], passes: int, count: int, device: str = "cpu"
) -> dict[str, tuple[float, ...]]:
    """Of each system: quartiles of its time, microseconds per track and step, and the seconds of its first call."""

    def once(call: Callable[[], Any]) -> float:
        start = time.perf_counter()
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter() - start

    first = {name: once(call) for name, call in systems.items()}
    for call in systems.values():
        once(call)
    seconds: dict[str, list[float]] = {name: [] for name in systems}
    for _ in progress_bar(range(passes), "pass", True):
        for name, call in systems.items():
            seconds[name].append(once(call))
    return {name: (*np.percentile(s, [25, 50, 75]) / count * 1e6, first[name]) for name, s in seconds.items()}


def rows_of(found: dict[str, tuple[float, ...]], **more: Any) -> list[Row]:
    """Results, said and kept."""
    rows = []
    for name, (q1, median, q3, first) in found.items():
        rows.append({"system": name, **more, "median": median, "q1": q1, "q3": q3, "first_call_s": first})
        where = ", ".join(f"{key} {value}" for key, value in more.items())
        print(f"{name:<28} {where}: {median:9.3f} us [{q1:.3f}, {q3:.3f}], first call {first:.1f} s", flush=True)
    return rows


def moved(x: Any, device: str) -> Any:
    """Tuples of tensors on another device."""
    return type(x)(*(moved(y, device) for y in x)) if isinstance(x, tuple) else x.to(device)


def tracks(options: argparse.Namespace) -> list[Row]:
    """Whole tracks, eager and compiled, and the peers."""
    scenario = make_scenario(options.scenario, initial=options.initial)
    rows: list[Row] = []
    for batch in map(int, (options.batch or "1,1000,10000").split(",")):
        data = moved(scenario.simulate(batch, 0), options.device)
        systems: dict[str, Callable[[], Any]] = {}
        for name in options.filters.split(","):
            f = copy.deepcopy(scenario_filters([name], scenario)[name]).to(options.device)
            if "compiled" in options.modes:
                fast = copy.deepcopy(f).compile()
                systems[f"{name}, compiled"] = lambda f=fast, data=data: run(f, scenario, data)
            if "eager" in options.modes:
                systems[f"{name}, eager"] = lambda f=f, data=data: run(f, scenario, data)
            if hasattr(f, "gate"):
                share = run(f, scenario, data).info.abnormal.double().mean().item()
                print(f"{name}: {share:.0%} of the steps abnormal")
        peers_here: list[str] = []
        if options.peers:
            import peers

            for name, make in peers.PEERS.items():
                if "FilterPy" in name and batch > 1:
                    continue
                try:
                    systems[name] = make(scenario, data)
                    peers_here.append(name)
                except ImportError as missing:
                    print(f"{name}: not installed ({missing}): pip install 'torchfra[bench]'")
        found = timed(systems, options.passes, batch * scenario.steps, options.device)
        rows += rows_of(found, batch=batch)
        if options.peers:
            own = run(presets.srckf(scenario.motion, scenario.sensor), scenario, data).mean[:, -1].numpy()
            for name in peers_here:
                apart = np.median(np.abs(systems[name]() - own)[:, :2].max(-1))
                print(f"{name}: its last positions are {apart:.1e} m from ours in the median")
            best = peers.limit(batch) if batch >= 8 else None
            if best is not None:
                rows += rows_of({"hand-written SIMD C++ SRCKF": (best, best, best, 0.0)}, batch=batch)
    return rows


def step(options: argparse.Namespace) -> list[Row]:
    """One track, one measurement at a time."""
    scenario = make_scenario(options.scenario, initial=options.initial)
    data = scenario.simulate(1, 0)
    systems: dict[str, Callable[[], Any]] = {}
    for name in options.filters.split(","):
        f = scenario_filters([name], scenario)[name]
        for mode in options.modes.split(","):
            g = copy.deepcopy(f).compile() if mode == "compiled" else f

            def stream(f=g):
                state = f.init(Gaussian(data.prior.mean[0], data.prior.scale_tril))
                for z, u in zip(data.z[0], data.u, strict=True):
                    state, _ = f.step(state, z, u=u)

            systems[f"{name}.step, {mode}"] = stream
    return rows_of(timed(systems, options.passes, scenario.steps))


@contextmanager
def plain_qr():
    """Gradients through ``torch.linalg.qr`` itself, as one would write it."""

    class Plain:
        @staticmethod
        def apply(a):
            lower = torch.linalg.qr(a.mT).R.mT
            return lower * lower.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)

    own, triangular._Tria = triangular._Tria, Plain
    try:
        yield
    finally:
        triangular._Tria = own


def peak(call: Callable[[], Any]) -> float | None:
    """MiB that a call needs on top of what is there; None where the system does not say."""
    status = Path("/proc/self/status")

    def read(key: str) -> int:
        return int(next(line for line in status.read_text().splitlines() if line.startswith(key)).split()[1])

    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
        before = read("VmRSS")
        call()
        return (read("VmHWM") - before) / 1024
    except (OSError, AttributeError, StopIteration):
        return None


def training(options: argparse.Namespace) -> list[Row]:
    """Forward and backward of FRA over 64 tracks (or the first of ``--batch``) of 100 steps, all values learning."""
    scenario = make_scenario(options.scenario, outliers="std", initial=options.initial)
    batch = int((options.batch or "64").split(",")[0])
    data, count = scenario.simulate(batch, 0), batch * scenario.steps

    def lesson(f: Any, **more: Any) -> Callable[[], None]:
        def call() -> None:
            f.zero_grad()
            estimate = f(data.z, data.prior, u=data.u, **more)
            (estimate.mean - data.truth)[..., :2].square().mean().backward()

        return call

    rows: list[Row] = []
    for kind, temperature in (("hard", 0.0), ("soft", 1.0)):
        f = presets.fra(scenario.motion, scenario.sensor, learn="all", temperature=temperature)
        eager = lesson(f)

        def plain(eager: Callable[[], None] = eager) -> None:
            with plain_qr():
                eager()

        systems = {
            f"fra {kind}, torch.linalg.qr": plain,
            f"fra {kind}, eager": eager,
            f"fra {kind}, eager, checkpoints": lesson(f, checkpoint=10),
            f"fra {kind}, compiled": lesson(copy.deepcopy(f).compile()),
        }
        rows += rows_of(timed(systems, options.passes, count), batch=batch)
        for row in rows[-len(systems) :]:
            row["peak_mib"] = peak(systems[row["system"]])
            if row["peak_mib"] is not None:
                print(f"{row['system']:<32} peak {row['peak_mib']:.0f} MiB")
    return rows


def scaling(options: argparse.Namespace) -> list[Row]:
    """Compiled SRCKF over the number of tracks, of states and of steps."""
    scenario = make_scenario(options.scenario, initial=options.initial)
    rows: list[Row] = []

    def measure(f: Any, z: torch.Tensor, prior: Gaussian, u: Any, **more: Any) -> None:
        found = timed({"srckf, compiled": lambda: f(z, prior, u=u)}, options.passes, z.shape[0] * z.shape[1])
        rows.extend(rows_of(found, **more))

    f = presets.srckf(scenario.motion, scenario.sensor).compile()
    for batch in (1, 10, 100, 1000, 10_000, 100_000):
        data = scenario.simulate(batch, 0)
        measure(f, data.z, data.prior, data.u, batch=batch)
    generator = torch.Generator().manual_seed(0)
    for motion in (ConstantVelocity(1.0, 1), ConstantVelocity(1.0, 2), ConstantAcceleration(1.0, 2),
                   ConstantVelocity(1.0, 4), ConstantVelocity(1.0, 5), ConstantAcceleration(1.0, 4)):  # fmt: skip
        g = presets.srckf(motion, Position(1.0, dims=motion.dims)).compile()
        z = torch.randn(1000, 100, motion.dims, dtype=torch.float64, generator=generator)
        n = motion.size
        prior = Gaussian(torch.zeros(n, dtype=torch.float64), torch.eye(n, dtype=torch.float64))
        measure(g, z, prior, None, states=n)
    for steps in (100, 1000, 10_000, 100_000):
        z = torch.randn(8, steps, 2, dtype=torch.float64, generator=generator)
        motion = ConstantAcceleration(1.0)
        g = presets.srckf(motion, Position(1.0)).compile()
        measure(g, z, Gaussian(torch.zeros(6).double(), torch.eye(6).double()), None, steps=steps)
    if options.figure is not None:
        sizes = ("batch", "states", "steps")
        panels = {key: [(row[key], row["median"]) for row in rows if key in row] for key in sizes}
        plotting.save(plotting.scaling(panels, "compiled SRCKF, float64"), options.figure)
        print(f"figure: {options.figure}")
    return rows


def positions(options: argparse.Namespace) -> list[Row]:
    """The alpha-beta bank on positions in space, with two and with three gains."""
    batch, steps = int(options.batch or 100_000), 20
    tracks = scenarios.level_then_weave().simulate(256, 0).z[:, 60 : 60 + steps]
    rows: list[Row] = []
    for dtype in (torch.float64, torch.float32):
        z = tracks.repeat(-(-batch // 256), 1, 1)[:batch].to(options.device, dtype)
        systems: dict[str, Callable[[], Any]] = {}
        for label, motion in (("two gains", ConstantVelocity(1.0, 3)), ("three gains", ConstantAcceleration(4.0, 3))):
            prior = Gaussian(*(x.to(z) for x in (torch.zeros(motion.size), torch.eye(motion.size))))
            f = presets.alphabeta(motion, Position(20.0, dims=3)).to(options.device)
            for mode in options.modes.split(","):
                g = copy.deepcopy(f).compile() if mode == "compiled" else f
                systems[f"alphabeta, {label}, {mode}"] = lambda g=g, z=z, prior=prior: g(z, prior)
        found = timed(systems, options.passes, batch * steps, options.device)
        rows += rows_of(found, batch=batch, dtype=str(dtype).removeprefix("torch."))
    return rows


BEARINGS = [name for name in SCENARIOS if name.startswith("bearings")]
KINDS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    f.__name__: f for f in (tracks, step, training, scaling, positions)
}


def main(arguments: list[str] | None = None) -> int:
    """Runs the benchmark."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("--what", default="tracks", help=f"out of {', '.join(KINDS)} (default: tracks)")
    parser.add_argument("--batch", help="tracks at once (default: 1,1000,10000; 64 for training)")
    parser.add_argument("--filters", default="ukf,srckf,fra_srckf,fra", help=f"out of {', '.join(track_filters())}")
    parser.add_argument("--modes", default="compiled,eager", help="compiled, eager or both (default)")
    parser.add_argument("--device", default="cpu", help="cpu (default) or cuda; compiled kernels run on the cpu only")
    parser.add_argument("--scenario", default="bearings-outliers", choices=BEARINGS)
    parser.add_argument("--initial", default="truth", choices=["truth", "paper"], help="initial state (default: truth)")
    parser.add_argument("--passes", type=int, default=7, help="timed passes (default: 7)")
    parser.add_argument("--peers", action="store_true", help="also JAX, dynamax and FilterPy, where installed, and C++")
    parser.add_argument("--figure", type=Path, metavar="FILE", help="PNG of what 'scaling' finds")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results for machines to read")
    options = parser.parse_args(arguments)
    for name, given, known in (("what", options.what, tuple(KINDS)),
                               ("filters", options.filters, track_filters()),
                               ("modes", options.modes, ("compiled", "eager"))):  # fmt: skip
        wrong = [part for part in given.split(",") if part not in known]
        if wrong:
            parser.error(f"--{name}: expected names out of {', '.join(known)}, received {', '.join(wrong)}")
    if options.device == "cuda" and (options.peers or "compiled" in options.modes):
        parser.error("--device cuda: expected --modes eager, without --peers")
    kept = keep_memory()
    print(f"torch {torch.__version__}, {torch.get_num_threads()} threads, {platform.machine()}, {options.device}")
    rows = []
    for kind in options.what.split(","):
        with torch.set_grad_enabled(kind == "training"):
            rows += KINDS[kind](options)
    if options.json is not None:
        settings = {key: str(value) if isinstance(value, Path) else value for key, value in vars(options).items()}
        settings |= {"threads": torch.get_num_threads(), "keep_memory": kept}
        write_json(options.json, {"settings": settings, "versions": versions(), "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Beside other libraries, in one command: the cells in which torchfra is not the first come first.

    python scripts/field.py                     every job
    python scripts/field.py --quick             the same jobs, smaller: five minutes on two cores
    python scripts/field.py --jobs spikes,imm --json out/field.json --figure out/field.png

Each library runs in a process of its own, which sleeps while others are timed; one that is not installed is named and
left out (``pip install 'torchfra[bench]'``; the environment variable TORCHFRA_PEERS_PYTHON may name the Python that has
them).  A cell is a job and what is compared: the time of a call, a pass of each in turn, or the error of the position.
A filter of your own joins with ``--own FILE``, which has ``peer(job)``: see ``scripts/peers_field.py``.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import peers_targets
import torch
from benchmarks.elsewhere import LEARNERS, Peer
from benchmarks.elsewhere import PEERS as BEARINGS
from benchmarks.layer import layer
from benchmarks.linear import long_tracks
from benchmarks.timing import Here, System, calls, timed
from benchmarks.tracks import beside_peers
from learned import lorenz
from lists import check_list
from peers_field import Job
from regrets.open_cells import OpenCell

import torchfra
from torchfra import Gaussian, presets, scenarios
from torchfra.catalogue import scenario_filters
from torchfra.cli.command import add_json_option, check_files, check_least, exit_status, make_parser
from torchfra.evaluation import run
from torchfra.motion import ConstantVelocity, RandomWalk
from torchfra.running.versions import write_results
from torchfra.scenarios import Scenario, Tracks
from torchfra.sensors import Position, RangeBearing
from torchfra.tables import formed_table, significant
from torchfra.testing.case import drawn as drawn_of_models
from torchfra.types import Estimate

OTHERS = Path(__file__).with_name("peers_field.py")
CLOSE = 1.02
"""Ratio up to which torchfra is as good as the first."""
ALONE = (
    "outliers and manoeuvres together, told by the measurements that follow",
    "thresholds and fading factors that learn by gradient descent",
)
"""What no other library here does: a list and no victory."""
STAY = 0.95
"""Probability that a motion of a bank goes on, in the tracks and in ``imm_srckf``."""
ROBUST = ["rsrckf", "fra", "gpb"]
GATED = ["FilterPy", "FilterPy, gated", "kalbee, gated", "kalbee, adaptive", "kalbee, variational Bayes"]
NONLINEAR = ["FilterPy, extended", "FilterPy, unscented", "FilterPy, unscented, Julier's points"]
BANKS = ["FilterPy, IMM", "FilterPy, IMM, gated", "kalbee, IMM"]
PUBLISHED = {
    "forward": {
        "published: IMM of three": 77.46, "published: constant acceleration": 95.88,
        "published: variable dimension": 102.09, "published: input estimation": 142.21,
    },
    "smooth": {"published: Singer": 53.09},
}  # fmt: skip
"""Errors of positions, m, filtered and smoothed, in 200 runs of ``manoeuvring``, by filters in MATLAB of which all but
the second were tuned on it: github.com/zhenbiny/maneuvering-target-tracking-benchmark, README of June 2026."""


class Cell(NamedTuple):
    """What a job says of one measure, less is better."""

    job: str
    measure: str
    ours: dict[str, float]
    theirs: dict[str, float]

    @property
    def ratio(self) -> float:
        """The best of torchfra over the best of the others."""
        return min(self.ours.values()) / min(self.theirs.values())


def job_arrays(scenario: Scenario, tracks: Tracks, model: str) -> dict[str, np.ndarray]:
    """Tracks, and what filters are told of them, as ``peers_field.Job`` has it."""
    models = [scenario.motion] if scenario.bank is None else scenario.bank[:]
    n = scenario.motion.size
    dt = torch.as_tensor(scenario.dt, dtype=torch.float64).expand(scenario.steps)
    noises = [model.process_noise(dt) for model in models]
    size = len(models), len(models)
    chain = torch.full(size, (1 - STAY) / max(len(models) - 1, 1), dtype=torch.float64)
    values = {
        "matrices": torch.stack([
            of.transition(dt) if of.linear else dt[:, None, None] * torch.eye(n).double() for of in models
        ]),
        "noises": torch.stack([root @ root.mT for root in noises]),
        "chain": chain.fill_diagonal_(STAY if len(models) > 1 else 1.0),
        "sensor": scenario.sensor(torch.eye(n).double()).mT,
        "r": scenario.sensor.measurement_noise(tracks.z[0, 0]).std.square().diag(),
        "means": tracks.prior.mean, "p": tracks.prior.covariance, "z": tracks.z,
    }  # fmt: skip
    return {name: x.detach().numpy() for name, x in values.items()} | {"model": np.array(model)}


def compared(
    job: str, scenario: Scenario, tracks: Tracks, filters: Sequence[str], others: Sequence[str],
    options: argparse.Namespace, measures: Sequence[str] = ("error", "time"), smooth: bool = False, model: str = "",
) -> list[Cell]:  # fmt: skip
    """The cells of a job: filters of torchfra, compiled, and other libraries, on the same tracks."""
    calls_of: dict[str, Callable[[], Estimate]] = {}
    for name, f in scenario_filters(filters, scenario).items():
        compiled = f.compile()
        filtering = partial(run, compiled, scenario, tracks)
        smoothing = partial(compiled.smooth, tracks.z, tracks.prior, dt=scenario.dt)
        calls_of[f"torchfra, {name}"] = smoothing if smooth else filtering
    means = {label: call().mean.numpy() for label, call in calls_of.items()}
    systems: dict[str, System] = dict(calls(calls_of))
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        file = Path(folder) / "job.npz"
        np.savez(file, **job_arrays(scenario, tracks, model))
        for i, other in enumerate([*others, *([str(options.own)] if options.own else [])]):
            peer = started(other, file, Path(folder) / f"{i}.npy", stack)
            if peer is not None:
                systems[other], means[other] = peer, peer.means()
        rows = timed(systems, options.passes, tracks.z.shape[:2].numel()) if "time" in measures else []
    place = slice(0, scenario.sensor.size)
    truth = tracks.truth[..., place].numpy()
    error = {label: float(np.sqrt(np.square(x[..., place] - truth).sum(-1).mean())) for label, x in means.items()}
    values = {"error": error, "time": {row["system"]: row["median"] for row in rows}}
    return [cell(job, measure, values[measure]) for measure in measures]


def started(name: str, job: Path, means: Path, stack: ExitStack) -> Peer | None:
    """The process of a library; says if it is not installed."""
    python = os.environ.get("TORCHFRA_PEERS_PYTHON", sys.executable)
    try:
        peer = Peer([python, str(OTHERS), name, str(job), "--means", str(means)], means)
    except ImportError as missing:
        print(f"{name}: not installed ({missing}): pip install 'torchfra[bench]'")
        return None
    stack.callback(peer.close)
    return peer


def cell(job: str, measure: str, values: Mapping[str, float]) -> Cell:
    """A cell, from the values of all systems."""
    ours = {name: x for name, x in values.items() if name.startswith("torchfra")}
    return Cell(job, measure, ours, {name: x for name, x in values.items() if name not in ours})


def linear(options: argparse.Namespace) -> list[Cell]:
    """Kalman filters on batches of tracks: all have the same estimates, so it is time alone."""
    cells = []
    for batch in (1, 100) if options.quick else (1, 1000, 100_000):
        scenario = scenarios.as_stated()
        rows = beside_peers(scenario, scenario.simulate(batch, options.seed), timing(options))
        cells.append(of_rows(f"Kalman filter, {counted(batch)} of 100 steps", rows))
    return cells


def long(options: argparse.Namespace) -> list[Cell]:
    """Kalman filters on one long track."""
    steps, cells = 1000 if options.quick else 10_000, []
    for name, scenario in long_tracks(steps).items():
        rows = beside_peers(scenario, scenario.simulate(1, options.seed), timing(options))
        cells.append(of_rows(f"Kalman filter, one track of {steps} steps, {name}", rows))
    return cells


def bearings(options: argparse.Namespace) -> list[Cell]:
    """Cubature and unscented filters on two bearings from moving stations."""
    scenario, cells = scenarios.bearings_outliers(initial="truth"), []
    for batch in (1, 100) if options.quick else (1, 1000):
        rows = beside_peers(scenario, scenario.simulate(batch, options.seed), timing(options))
        cells.append(of_rows(f"bearings, {counted(batch)} of 100 steps", rows))
    return cells


def timing(options: argparse.Namespace) -> argparse.Namespace:
    """The options as ``benchmarks`` take them."""
    return argparse.Namespace(filters="srckf", modes="compiled", device="cpu", passes=options.passes, peers=True)


def of_rows(job: str, rows: Sequence[Mapping[str, Any]]) -> Cell:
    """A cell of times from rows of a benchmark."""
    names = {row["system"]: row["median"] for row in rows}
    return cell(job, "time", {f"torchfra, {n}" if n.endswith("compiled") else n: x for n, x in names.items()})


def gaps(options: argparse.Namespace) -> list[Cell]:
    """Irregular times, and measurements that are missing."""
    scenario, tracks = drawn(options, 20, spacing="mixed")
    missing = torch.rand(tracks.z.shape[:2], generator=torch.Generator().manual_seed(options.seed)) < 0.3
    tracks = tracks._replace(z=tracks.z.masked_fill(missing.unsqueeze(-1), torch.nan))
    others = ["FilterPy", "pykalman", "statsmodels"]
    return compared("irregular times, 30 % missing", scenario, tracks, ["srckf"], others, options)


def smoothing(options: argparse.Namespace) -> list[Cell]:
    """Smoothers of linear models."""
    names = ["FilterPy", "pykalman", "statsmodels", "simdkalman", "dynamax", "torch-kf"]
    others = [f"{name}, smoother" for name in names]
    return compared("smoothing", *drawn(options, 20), ["srckf"], others, options, smooth=True)


def spikes(options: argparse.Namespace) -> list[Cell]:
    """Spikes and heavy tails, for which users gate or adapt."""
    cells = []
    for words, cell in (
        ("spikes of 300 std", {"kind": "spikes", "size": 300.0}),
        ("spikes of 10 std", {"kind": "spikes"}),
        ("Student's t, 2 degrees", {"kind": "heavy"}),
    ):
        cells += compared(words, *drawn(options, 40, **cell), ROBUST, GATED, options, ["error"])
    return cells


def imm(options: argparse.Namespace) -> list[Cell]:
    """Targets that turn, with a bank whose motions and chain are told; and with spikes."""
    cells = []
    for words, cell, measures in (
        ("turning targets", {}, ["error", "time"]),
        ("turning targets, spikes of 300 std", {"kind": "spikes", "size": 300.0}, ["error"]),
    ):
        drawn_tracks = drawn(options, 40, motion="bank", **cell)
        cells += compared(words, *drawn_tracks, ["imm_srckf", "imm_fra", "gpb"], BANKS, options, measures)
    return cells


def manoeuvring(options: argparse.Namespace) -> list[Cell]:
    """Two manoeuvres of a straight course seen every 10 s: a public benchmark, with the values of its bank untuned."""
    truth, z, noise = manoeuvring_tracks(20 if options.quick else 200, options.seed)
    start = Gaussian.from_std([2000.0, 10_000.0, 0.0, -15.0], [10.0, 10.0, 1.0, 1.0])
    motions, sensor = [ConstantVelocity(q, continuous=True) for q in (1e-6, 3e-4, 0.5)], Position(100.0)
    filters = {
        "imm_srckf": presets.imm_srckf(motions, sensor), "fra": presets.fra(motions[1], sensor),
        "gpb": presets.gpb(motions[1], sensor), "gpb of the bank": presets.gpb(motions, sensor),
    }  # fmt: skip
    cells = []
    for way, published in PUBLISHED.items():
        errors = {}
        for name, f in filters.items():
            estimate = getattr(f, way)(z, start, dt=10.0, noise=noise)
            errors[f"torchfra, {name}"] = error_from_the_start(estimate, truth)
        words = "filtered" if way == "forward" else "smoothed"
        cells.append(cell(f"public benchmark of manoeuvring targets, {words}", "error", errors | published))
    return cells


def manoeuvring_tracks(runs: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """True positions ``(100, 2)`` after a known start, measurements ``(runs, 100, 2)``, a root of their covariance."""
    time = 10.0 * torch.arange(100).double()
    size = 0.075 * ((time >= 400) & (time < 600)) - 0.3 * ((time >= 610) & (time < 660))
    acceleration = size.double().unsqueeze(-1).expand(-1, 2)
    after = torch.tensor([0.0, -15.0], dtype=torch.float64) + 10.0 * acceleration.cumsum(0)
    truth = torch.tensor([2000.0, 10_000.0], dtype=torch.float64) + (10.0 * after - 50.0 * acceleration).cumsum(0)
    root = torch.linalg.cholesky(torch.tensor([[1e4, 500.0], [500.0, 1e4]], dtype=torch.float64))
    g = torch.Generator().manual_seed(seed)
    return truth, truth + torch.randn(runs, 100, 2, generator=g).double() @ root.mT, root.expand(runs, 100, 2, 2)


def error_from_the_start(estimate: Estimate, truth: torch.Tensor) -> float:
    """Root mean square error of positions, m, of which those of the start, which is known, are 0."""
    square = (estimate.mean[..., :2] - truth).square().sum(-1)
    return math.sqrt(square.mean().item() * truth.shape[0] / (truth.shape[0] + 1))


def nonlinear(options: argparse.Namespace) -> list[Cell]:
    """Ranges and bearings of targets that pass a radar, and Lorenz's attractor: extended and unscented filters."""
    runs, cells = 10 if options.quick else 40, []
    motion, sensor, steps = ConstantVelocity(0.1), RangeBearing((5.0, 0.03)), 100
    g = torch.Generator().manual_seed(options.seed)
    middle = torch.tensor([-300.0, 150, 8, -2], dtype=torch.float64)
    start = middle + 10 * torch.randn(runs, 4, generator=g).double()
    one = torch.tensor(1.0, dtype=torch.float64)
    truth, z = drawn_of_models(motion, sensor, start, one, None, steps, g, process_noise=True)
    passing = Tracks(truth, z, None, Gaussian(middle.expand(runs, 4), 10 * torch.eye(4).double()))
    setting = lorenz.Setting()
    path, seen, known = lorenz.simulate(setting, 1.0, runs, options.seed)
    attractor = Tracks(path, seen, None, known._replace(scale_tril=1e-3 * torch.eye(3).double()))
    for words, model, (moves, sees), dt, tracks in (
        ("ranges and bearings of a passing target", "radar", (motion, sensor), 1.0, passing),
        ("Lorenz's attractor", "lorenz", lorenz.models(setting, 1.0), lorenz.DT, attractor),
    ):
        scenario = Scenario(model, moves, sees, tracks.prior, dt, tracks.z.shape[1], _drawn_already, {})
        names = ["ekf", "ukf", "srckf", "ghckf"]
        cells += compared(words, scenario, tracks, names, NONLINEAR, options, model=model)
    return cells


def _drawn_already(*_: Any) -> Tracks:
    """In place of a scenario's simulation, where tracks come from elsewhere."""
    raise NotImplementedError


def clutter(options: argparse.Namespace) -> list[Cell]:
    """Targets whose number is not known among false measurements: GOSPA, and time of a scan."""
    size = ["--targets", "3", "--clutter", "10", "--scans", "30"] if options.quick else []
    given = ["--runs", "2" if options.quick else "5", "--seed", str(options.seed)]
    given += ["--trackers", "imm,gpb,stonesoup-jpda"]
    rows = peers_targets.simulation(peers_targets.checked(peers_targets.parser(), size + given))
    by_name = {row["tracker"]: row for row in rows}
    other = {"Stone Soup, JPDA": by_name.pop("stonesoup-jpda")} if "stonesoup-jpda" in by_name else {}
    by_name = {f"torchfra, {name}": row for name, row in by_name.items()} | other
    return [
        cell("targets among false measurements", words, {name: factor * row[key] for name, row in by_name.items()})
        for words, key, factor in (("GOSPA", "gospa_m", 1.0), ("time", "ms_per_scan", 1000.0))
    ]


def drawn(options: argparse.Namespace, runs: int, **cell: Any) -> tuple[Scenario, Tracks]:
    """Tracks of positions of 200 steps: see ``regrets.open_cells.OpenCell``."""
    scenario = OpenCell(**cell).scenario(steps=200)
    return scenario, scenario.simulate(runs // 4 if options.quick else runs, options.seed)


def gradient(options: argparse.Namespace) -> list[Cell]:
    """A step of learning of a network in front of the filter."""
    settings = vars(timing(options)) | {"scenario": "bearings-outliers", "initial": "truth", "batch": None}
    with torch.enable_grad():
        rows = layer(argparse.Namespace(**settings))
    rows = [row for row in rows if row["system"] in ("srckf, compiled", *(BEARINGS[name] for name in LEARNERS))]
    return [of_rows("gradient of a network in front, 64 tracks of 100 steps", rows)]


def likelihood(options: argparse.Namespace) -> list[Cell]:
    """The variances of a local level that make a series likeliest: time, and what is missing to the best likelihood."""
    g = torch.Generator().manual_seed(options.seed)
    z = (torch.randn(100, generator=g).double().cumsum(0) + 2 * torch.randn(100, generator=g).double())[:, None]
    level = presets.srckf(RandomWalk(1.0, dims=1), Position(1.0, dims=1))
    fitted: list[float] = []

    def call() -> None:
        with torch.enable_grad():
            found = torchfra.fit(level, z, learn=("q", "std"), quiet=True)
        start = Gaussian(z[0], found.filter.sensor.std().reshape(1, 1))  # after an exact diffuse start
        fitted.append(found.filter(z[1:], start).log_likelihood.sum().item())

    systems: dict[str, System] = {"torchfra, fit": Here(call, warming=(1, 0.0), seconds=1e-3)}
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        job, said = Path(folder) / "job.npz", Path(folder) / "said.npy"
        empty = np.zeros(0)
        np.savez(job, **dict.fromkeys(Job._fields, empty) | {"z": z.numpy()[None]})
        name = "statsmodels, local level"
        peer = started(name, job, said, stack)
        if peer is not None:
            systems[name] = peer
        rows = timed(systems, min(options.passes, 3), 1)
        values = {"torchfra, fit": fitted[-1], **({name: float(np.load(said)[0])} if peer is not None else {})}
    best = max(values.values())
    gaps = {
        label: 1.0 + best - x for label, x in values.items()
    }  # a ratio of differences of rounding would say nothing
    words = "likeliest local level, series of 100"
    times = {row["system"]: row["median"] for row in rows}
    return [cell(words, "1 + loss of log-likelihood", gaps), cell(words, "time", times)]


def counted(tracks: int) -> str:
    """A number of tracks in words."""
    return "one track" if tracks == 1 else f"{tracks} tracks"


JOBS: dict[str, Callable[[argparse.Namespace], list[Cell]]] = {
    "linear": linear,
    "long": long,
    "bearings": bearings,
    "gaps": gaps,
    "smoothing": smoothing,
    "spikes": spikes,
    "imm": imm,
    "manoeuvring": manoeuvring,
    "nonlinear": nonlinear,
    "clutter": clutter,
    "gradient": gradient,
    "likelihood": likelihood,
}


def table(cells: Sequence[Cell], form: str = "text") -> str:
    """Cells as text, the lost ones first."""
    rows = []
    for one in sorted(cells, key=lambda one: -one.ratio):
        unit = {"error": " m", "GOSPA": " m", "time": " us"}.get(one.measure, "")
        best = [min(systems.items(), key=lambda item: item[1]) for systems in (one.ours, one.theirs)]
        said = [f"{name.removeprefix('torchfra, ')} {significant(x)}{unit}" for name, x in best]
        rows.append([one.job, one.measure, f"{one.ratio:.2f}" if one.ratio >= 0.01 else f"{one.ratio:.1g}", *said])
    return formed_table(form, ["job", "measure", "ratio", "torchfra", "best other"], rows, "Ratios below 1 are ahead.")


def draw(cells: Sequence[Cell], path: Path) -> None:
    """Ratios as points, the lost ones on top."""
    import matplotlib.pyplot as plt

    ordered = sorted(cells, key=lambda one: one.ratio)
    figure, axes = plt.subplots(figsize=(8, 0.3 * len(ordered) + 1), layout="constrained")
    lost = ["tab:red" if one.ratio > CLOSE else "tab:blue" for one in ordered]
    axes.scatter([one.ratio for one in ordered], range(len(ordered)), c=lost)
    axes.set_yticks(range(len(ordered)), [f"{one.job}: {one.measure}" for one in ordered])
    axes.axvline(1.0, color="0.5", linewidth=1)
    axes.set(xscale="log", xlabel="torchfra over the best other library: time or error, less is better")
    figure.savefig(path)
    plt.close(figure)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = make_parser(__doc__)
    p.add_argument("--jobs", default=",".join(JOBS), help=f"some of {', '.join(JOBS)} (default: all)")
    p.add_argument("--quick", action="store_true", help="fewer and shorter tracks")
    p.add_argument("--own", type=Path, metavar="FILE", help="Python with peer(job), to be compared where others are")
    p.add_argument("--seed", type=int, default=0, help="of the tracks (default: 0)")
    p.add_argument("--passes", type=int, default=7, help="timed passes (default: 7)")
    p.add_argument("--figure", type=Path, metavar="FILE", help="PNG of the ratios")
    p.add_argument("--form", default="text", choices=["text", "markdown"], help="of the table (default: text)")
    add_json_option(p)
    return p


def main(arguments: list[str] | None = None) -> int:
    """Runs the jobs; returns the exit status: see ``torchfra.cli.command.exit_status``."""
    p = parser()
    options = p.parse_args(arguments)
    check_list(p, "jobs", options.jobs, JOBS)
    return exit_status("field", lambda: field(options))


@torch.no_grad()
def field(options: argparse.Namespace) -> None:
    """Runs the jobs that the options name, prints their cells and writes them."""
    check_least(options, passes=1)
    check_files({"json": options.json, "figure": options.figure}, [options.own] if options.own else [])
    cells: list[Cell] = []
    for name in options.jobs.split(","):
        cells += [one for one in JOBS[name](options) if one.theirs]
    if not cells:
        raise ValueError("jobs: expected another library that is installed, found none: pip install 'torchfra[bench]'")
    ahead = sum(one.ratio <= CLOSE for one in cells)
    print(f"\n{table(cells, options.form)}\nfirst, or within 2 % of it, in {ahead} of {len(cells)} cells")
    print(f"Not compared, as no other library here does it: {'; '.join(ALONE)}.")
    if options.figure is not None:
        draw(cells, options.figure)
    settings = {key: str(value) if isinstance(value, Path) else value for key, value in vars(options).items()}
    results = [{**one._asdict(), "ratio": one.ratio} for one in cells]
    write_results(options.json, {"settings": settings, "cells": results})


if __name__ == "__main__":
    sys.exit(main())

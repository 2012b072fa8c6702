"""Tracks begun and deleted among false measurements: torchfra's manager and Stone Soup's trackers on the same scans.

    python scripts/peers_targets.py                                   10 targets, 30 false measurements per scan
    python scripts/peers_targets.py --targets 30 --clutter 100 --runs 3 --json targets.json
    python scripts/peers_targets.py --trackers srckf --birth one --confirmation existence --seed 6 --runs 3
    python scripts/peers_targets.py --trackers srckf --hull 60 --link 50 --seed 6 --runs 3
    python scripts/peers_targets.py --trackers srckf --hidden 12 --stitch 20 100 --seed 6 --runs 10
    python scripts/peers_targets.py --trackers srckf --hidden 12 --confirmation existence --misses 0 --visible 60 10
    python scripts/peers_targets.py --trackers srckf --buoys 15 --map 10 60 --birth one --seed 6 --runs 3
    python scripts/peers_targets.py --harbour scenario2_detections.json.gz scenario3_detections.json.gz

Targets fly nearly straight in a square; positions are measured, some are missed, false ones lie anywhere.  All trackers
know the models, the detection and the density of false measurements, and end a target after five scans without one,
torchfra's also when its score has fallen by the log of 1e-4, or with ``--misses 0`` by its confirmation alone; none
knows their number.  Prints for each tracker
GOSPA (cutoff 100 m, mean over scans and runs) with the parts of its square, how often a target's track became another
one, how often a target was lost and found again and how many tracks were of no target per run, and milliseconds of the
processor per scan, which others on the machine disturb least.  Each tracker of Stone Soup runs in a process of its own,
one after the other.

With ``--harbour`` the scans are those of recordings of boats in a harbour, and the tracker is Stone Soup's joint
probabilistic data association by radar and by radar and lidar, with the motion, noise, detection and clutter that
``scripts/recordings.py autoferry`` has, and its figures.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lists import check_list
from recorded_bench import autoferry
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from torchfra import metrics, presets
from torchfra.association import ChiSquare, Clutter
from torchfra.cli.command import add_json_option, check_files, exit_status, make_parser
from torchfra.motion import Bank, ConstantVelocity
from torchfra.running.versions import write_results
from torchfra.sensors import Position
from torchfra.tables import text_table
from torchfra.targets import SPRT, ClutterMap, Deletion, Existence, OnePoint, Stitching, Targets, TwoPoint, Visibility

WORKER = Path(__file__).parent / "benchmarks" / "stone_soup.py"
Q, STD, SPEED, DETECTION, GATE, SIDE = 0.5, 10.0, 15.0, 0.95, 0.999, 2000.0
"""Acceleration noise (m^2/s^3), noise of a position (m), speed in each direction (m/s), probabilities, square (m)."""
CUTOFF = 100.0
"""Of the GOSPA metric, m."""
OURS = ("srckf", "imm", "gpb")
BIRTHS = {"one": OnePoint(SPEED), "two": TwoPoint(speed=4 * SPEED)}
CONFIRMATIONS = {"sprt": SPRT(1e-4), "existence": Existence()}
"""Of torchfra's manager: from how many measurements targets begin, and how they are confirmed."""
PEERS = {"stonesoup-jpda": "jpda", "stonesoup-mfa": "mfa"}


def main(arguments: list[str] | None = None) -> int:
    """Runs the comparison; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    return exit_status("peers_targets", lambda: compare(checked(parser(), arguments)))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = make_parser(__doc__)
    p.add_argument("--targets", type=int, default=10, help="targets (default: 10)")
    p.add_argument("--clutter", type=int, default=30, help="expected false measurements per scan (default: 30)")
    p.add_argument("--scans", type=int, default=60, help="scans of a run, 1 s apart (default: 60)")
    p.add_argument("--runs", type=int, default=5, help="runs (default: 5)")
    p.add_argument("--seed", type=int, default=0, help="of the random numbers (default: 0)")
    p.add_argument("--points", type=int, default=5, help="measurements by which Stone Soup confirms a track (default: "
                   "5, which of 3 to 6 has the least GOSPA at the other defaults)")  # fmt: skip
    p.add_argument("--birth", choices=BIRTHS, default="two", help="measurements that begin a target of torchfra's "
                   "(default: two)")  # fmt: skip
    p.add_argument("--confirmation", choices=CONFIRMATIONS, default="sprt", help="of torchfra's (default: sprt)")
    p.add_argument("--hidden", type=int, default=0, metavar="SCANS", help="a target is not measured for so long, once "
                   "in its life (default: 0)")  # fmt: skip
    p.add_argument("--stitch", type=float, nargs=2, metavar=("SECONDS", "METRES"), help="stitch torchfra's tracks")
    p.add_argument("--visible", type=float, nargs=2, metavar=("SEEN", "HIDDEN"), help="seconds that torchfra takes "
                   "targets to be visible and hidden on end (default: always visible)")  # fmt: skip
    p.add_argument("--misses", type=int, default=5, metavar="SCANS", help="torchfra deletes a target after so many "
                   "without a measurement; 0 for by existence alone (default: 5)")  # fmt: skip
    p.add_argument("--hull", type=float, default=0.0, metavar="METRES", help="a target that is measured has four "
                   "detections, anywhere along a hull of that length (default: one, at its place)")  # fmt: skip
    p.add_argument("--link", type=float, metavar="METRES", help="link detections of torchfra's scans up to so far")
    p.add_argument("--buoys", type=int, default=0, help="things that stay and are measured like targets (default: 0)")
    p.add_argument("--map", type=float, nargs=2, metavar=("METRES", "SECONDS"), help="a map of clutter with kernels of "
                   "that size, of torchfra's (default: none)")  # fmt: skip
    p.add_argument("--harbour", type=Path, nargs="+", metavar="FILE", help="recordings of a harbour; of the other "
                   "options only --points and --json count")  # fmt: skip
    p.add_argument("--trackers", default=",".join((*OURS, *PEERS)), help="some of %(default)s")
    add_json_option(p)
    return p


def checked(p: argparse.ArgumentParser, arguments: list[str] | None) -> argparse.Namespace:
    """The options, or the end of the program with a message if they make no sense."""
    options = p.parse_args(arguments)
    check_list(p, "trackers", options.trackers, (*OURS, *PEERS))
    for name in ("targets", "clutter", "runs", "points"):
        if getattr(options, name) < 1:
            p.error(f"--{name}: expected 1 or more, received {getattr(options, name)}")
    if options.scans < 10:
        p.error(f"--scans: expected 10 or more, received {options.scans}")
    if options.hidden < 0:
        p.error(f"--hidden: expected 0 or more, received {options.hidden}")
    if not 0 <= options.hull < math.inf:
        p.error(f"--hull: expected finite metres of 0 or more, received {options.hull}")
    if options.link is not None and not 0 < options.link < math.inf:
        p.error(f"--link: expected finite metres above 0, received {options.link}")
    if options.buoys < 0:
        p.error(f"--buoys: expected 0 or more, received {options.buoys}")
    for name in ("stitch", "visible", "map"):
        if getattr(options, name) is not None and min(getattr(options, name)) <= 0:
            p.error(f"--{name}: expected numbers above 0, received {getattr(options, name)}")
    if options.misses < 0 or (options.misses == 0 and options.confirmation != "existence"):
        p.error(f"--misses: expected 1 or more, or 0 with --confirmation existence, received {options.misses}")
    return options


def compare(options: argparse.Namespace) -> None:
    """Tracks by what the options say, prints the results and writes them."""
    check_files({"json": options.json})
    rows = harbour(options) if options.harbour else simulation(options)
    cells = [[f"{row[key]:.2f}" if isinstance(row[key], float) else str(row[key]) for key in row] for row in rows]
    if rows:
        print(text_table([key.replace("_", " ") for key in rows[0]], cells))
    harbours = [str(path) for path in options.harbour or ()]
    settings = vars(options) | {"json": str(options.json), "harbour": harbours}
    write_results(options.json, {"settings": settings, "rows": rows})


def simulation(options: argparse.Namespace) -> list[dict[str, Any]]:
    """What each tracker has reached on simulated scans."""
    truth, z = simulated(options)
    job = {
        "z": z.numpy(), "time": np.arange(1, options.scans + 1), "sensor": np.zeros(options.scans, dtype=np.int64),
        "q": Q, "std": [STD], "speed": SPEED, "detection": [DETECTION], "gate": GATE,
        "density": [options.clutter / SIDE**2], "points": options.points,
    }  # fmt: skip
    rows = []
    for name in options.trackers.split(","):
        found = here(name, z, options) if name in OURS else elsewhere(name, PEERS[name], job)
        if found is not None:
            rows.append(scored(name, *found, truth))
    return rows


def harbour(options: argparse.Namespace) -> list[dict[str, Any]]:
    """What Stone Soup reaches on recordings of a harbour."""
    rows = []
    scenes = [autoferry.read(path) for path in options.harbour]
    for scene, sensors in [(scene, name) for scene in scenes for name in autoferry.OWN_PRESETS]:
        scans, order = autoferry.scans_of(sensors, scene), [autoferry.RADAR, autoferry.LIDAR]
        z = pad_sequence([scan.z for scan in scans], batch_first=True, padding_value=math.nan)
        std, detection, rate = ([of[i] for i in order] for of in (autoferry.STD, autoferry.DETECTION, autoferry.RATE))
        job = {
            "z": z.unsqueeze(0).numpy(), "time": [scan.time - scans[0].time for scan in scans],
            "sensor": [order.index(scan.sensor) for scan in scans], "q": autoferry.Q, "std": std,
            "speed": autoferry.SPEED, "detection": detection, "gate": GATE,
            "density": [x / autoferry.WIDTH**2 for x in rate], "points": options.points,
        }  # fmt: skip
        found = elsewhere("stonesoup-jpda", "sensors", job)
        if found is not None:
            at = torch.tensor([scan.sensor == autoferry.RADAR for scan in scans])
            figures = autoferry.figures_of(sensors, scene, found[0][0][:, at])
            rows.append({"recording": scene.name, "sensors": sensors, **figures})
    return rows


def simulated(options: argparse.Namespace) -> tuple[Tensor, Tensor]:
    """Truth ``(R, N, T, 4)``, NaN where a target is not there, and scans ``(R, T, J, 2)``."""
    rng = np.random.default_rng(options.seed)
    runs, count, steps = options.runs, options.targets, options.scans
    motion, dt = ConstantVelocity(Q, continuous=True), torch.tensor(1.0, dtype=torch.float64)
    matrix, root = motion.transition(dt).numpy(), motion.process_noise(dt).numpy()
    place = rng.uniform(0, SIDE, (runs, count, 2))
    state = np.concatenate([place, SPEED * rng.standard_normal((runs, count, 2))], -1)
    states = []
    for _ in range(steps):
        state = state @ matrix.T + rng.standard_normal((runs, count, root.shape[1])) @ root.T
        states.append(state)
    truth, step = np.stack(states, 2), np.arange(steps)
    first, last = (rng.uniform(a * steps, b * steps, (runs, count, 1)) for a, b in ((0, 0.3), (0.7, 1)))
    truth[~((step >= np.floor(first)) & (step <= last))] = np.nan
    own = truth[..., :2] + STD * rng.standard_normal((runs, count, steps, 2))
    own[rng.random(own.shape[:-1]) >= DETECTION] = np.nan
    if options.hidden:
        since = rng.integers(int(0.4 * steps), int(0.5 * steps), (runs, count, 1))
        own[(step >= since) & (step < since + options.hidden)] = np.nan
    if options.hull:
        place = options.hull * (rng.random((runs, 4 * count, steps, 1)) - 0.5)
        more = STD * rng.standard_normal((runs, 3 * count, steps, 2)) + np.tile(truth[..., :2], (1, 3, 1, 1))
        more[np.tile(np.isnan(own), (1, 3, 1, 1))] = np.nan
        own = np.concatenate([own, more], 1) + place * np.array([1.0, 0.0])
    number = rng.poisson(options.clutter, (runs, steps, 1))
    false = rng.uniform(0, SIDE, (runs, steps, number.max(), 2))
    false[np.arange(number.max()) >= number] = np.nan
    if options.buoys:
        buoys = rng.uniform(0, SIDE, (runs, 1, options.buoys, 2))
        buoys = buoys + STD * rng.standard_normal((runs, steps, options.buoys, 2))
        buoys[rng.random(buoys.shape[:-1]) >= DETECTION] = np.nan
        false = np.concatenate([false, buoys], 2)
    return torch.from_numpy(truth), torch.from_numpy(np.concatenate([own.swapaxes(1, 2), false], 2))


def tracker(name: str, options: argparse.Namespace) -> Targets:
    """Torchfra's manager around a filter."""
    sensor, false = Position(STD), Clutter(SIDE**2, rate=float(options.clutter))
    motion: Any = ConstantVelocity(Q, continuous=True)
    inner: Callable[..., Any] = getattr(presets, name)
    if name == "imm":
        motion = Bank([motion, ConstantVelocity(16 * Q, continuous=True)])
    joint = presets.jpda(motion, sensor, inner=inner, clutter=false, detection=DETECTION, gate=ChiSquare(GATE))
    birth, confirmation = BIRTHS[options.birth], CONFIRMATIONS[options.confirmation]
    return Targets(
        joint, birth=birth, confirmation=confirmation,
        deletion=Deletion(options.misses, score_drop=1e-4) if options.misses else None,
        visibility=None if options.visible is None else {None: Visibility(*options.visible)},
        stitching=None if options.stitch is None else Stitching(*options.stitch),
        clutter_map=None if options.map is None else ClutterMap(*options.map),
        linkage=None if options.link is None else {None: options.link},
    )  # fmt: skip


def here(name: str, z: Tensor, options: argparse.Namespace) -> tuple[list[Tensor], list[float]]:
    """Tracks ``(K, T, n)`` of each run, and the processor's seconds: one run after the other, scan by scan."""
    targets, found, seconds = tracker(name, options), [], []
    with torch.no_grad():
        targets(z[0, :5])  # warm
        for scans in z:
            start = time.process_time()
            found.append(targets(scans).mean)
            seconds.append(time.process_time() - start)
    return found, seconds


def elsewhere(name: str, kind: str, values: dict[str, Any]) -> tuple[list[Tensor], list[float]] | None:
    """The same of a job with these values by Stone Soup, in a process of its own; None where it is not installed."""
    python = os.environ.get("TORCHFRA_PEERS_PYTHON", sys.executable)
    with tempfile.TemporaryDirectory() as folder:
        job, tracks = Path(folder) / "job.npz", Path(folder) / "tracks.npz"
        np.savez(job, **values)
        command = [python, str(WORKER), kind, str(job), str(tracks)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        answer = json.loads(done.stdout.splitlines()[-1])
        if "missing" in answer:
            print(f"{name}: not installed ({answer['missing']}): pip install 'torchfra[bench]'")
            return None
        with np.load(tracks) as arrays:
            return [torch.from_numpy(arrays[key]) for key in arrays.files], answer["seconds"]


def scored(name: str, found: list[Tensor], seconds: list[float], truth: Tensor) -> dict[str, Any]:
    """What a tracker has reached."""
    position, scans = slice(0, 2), truth.shape[-2]
    scores = [metrics.gospa(mean, run, position, cutoff=CUTOFF) for mean, run in zip(found, truth, strict=True)]
    distance, *squares = (
        torch.stack([getattr(score, part) ** power for score in scores]).mean().item()
        for part, power in (("distance", 1), ("localisation", 2), ("missed", 2), ("false", 2))
    )
    lives = [metrics.lives(mean, run, position, cutoff=CUTOFF) for mean, run in zip(found, truth, strict=True)]
    switches, breaks, false_tracks = (
        statistics.mean(float(getattr(life, part).sum()) for life in lives)
        for part in ("switches", "breaks", "false_tracks")
    )
    return {
        "tracker": name, "gospa_m": distance,
        **dict(zip(("localisation_m2", "missed_m2", "false_m2"), squares, strict=True)),
        "switches": switches, "breaks": breaks, "false_tracks": false_tracks,
        "ms_per_scan": 1000 * statistics.median(seconds) / scans,
    }  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())

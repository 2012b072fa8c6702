"""How many rows a second ``torchfra many`` cleans, and in how much memory.

    python scripts/many.py --tracks 1000,10000 --seed 0 --jobs 2 --json out/many.json
    python scripts/many.py --tracks 1000000 --seed 0 --share 100

Simulated flights of 100 fixes, one every 5 s, that turn now and then, anywhere on the earth: 20 m of noise, every
fiftieth fix 1 km off, in files of 10,000 flights whose rows are in the order of time.  Rows a second are given by the
clock and by the time of the processors, starting Python included, memory is the most of a process, after the first
part and at the end, and the error is across the ground, of cleaned positions over that of the fixes (root mean square
of all that are no outliers).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from lists import numbers_in
from pyarrow import dataset, parquet

from torchfra.cleaning.many import summed
from torchfra.cli.command import add_json_option, check_files, check_least, exit_status, make_parser
from torchfra.running.jobs import add_jobs_option
from torchfra.running.versions import write_results
from torchfra.tables import text_table

FIXES, STEP = 100, 5.0
NOISE, FAR, RATE = 20.0, 1000.0, 0.02
SPEED, TURN = 200.0, np.radians(1.5)
TOGETHER = 10_000
"""Flights of a file."""
DEGREE = 111_195.0
"""Metres of a degree on a sphere."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("--tracks", metavar="N,N", default="1000,10000", help="flights (default: 1000,10000)")
    p.add_argument("--seed", type=int, default=0, metavar="S", help="of the random numbers (default: 0)")
    p.add_argument("--share", type=int, default=1, metavar="N", help="clean every N-th part only (default: 1)")
    p.add_argument("--folder", type=Path, help="where data go for the time being (default: that of the system)")
    add_jobs_option(p)
    add_json_option(p)
    return exit_status("many", lambda: measure(p.parse_args(arguments)))


def measure(options: argparse.Namespace) -> None:
    """Simulates, cleans and measures."""
    check_least(options, jobs=1)
    check_files({"json": options.json})
    found = []
    for tracks in map(int, numbers_in("tracks", options.tracks)):
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            found.append(measured(Path(folder), tracks, options))
    names = list(found[0])
    print(text_table(names, [[f"{of[name]:,.3g}" if of[name] < 100 else f"{of[name]:,.0f}" for name in names]
                             for of in found]))  # fmt: skip
    write_results(options.json, {"seed": options.seed, "jobs": options.jobs, "runs": found})


def measured(folder: Path, tracks: int, options: argparse.Namespace) -> dict[str, float]:
    """Time and memory to clean ``tracks`` flights, by way of a folder."""
    (folder / "flights").mkdir()
    rng = np.random.default_rng(options.seed)
    for first in range(0, tracks, TOGETHER):
        data = flights(first, min(TOGETHER, tracks - first), rng)
        parquet.write_table(data, folder / f"flights/{first:09}.parquet", compression="zstd")
    command = [sys.executable, "-m", "torchfra", "many", str(folder / "flights"), "--out", str(folder / "clean")]
    environment = os.environ | {"RANK": "0", "WORLD_SIZE": str(options.share)}
    before, begun = processors(), time.perf_counter()
    subprocess.run([*command, "--jobs", str(options.jobs), "--quiet"], check=True, env=environment)
    seconds, busy = time.perf_counter() - begun, processors() - before
    files = sorted((folder / "clean/_parts").iterdir(), key=lambda file: file.stat().st_mtime_ns)
    parts = [json.loads(file.read_text()) for file in files]
    total = summed(parts)
    return {
        "tracks": total["targets"], "rows": total["rows"], "parts": len(parts),
        "rows a second": total["rows"] / seconds, "rows a processor's second": total["rows"] / busy,
        "MB after a part": parts[0]["memory"] / 1e6, "MB": total["memory"] / 1e6, "error": error(folder),
    }  # fmt: skip


def flights(first: int, count: int, rng: np.random.Generator) -> Any:
    """A table of flights in the order of time, with the truth and which fixes are outliers."""
    turning = np.repeat(rng.random((count, FIXES // 10)) < 0.2, 10, 1) * rng.choice([-TURN, TURN], (count, 1))
    course = rng.uniform(0, 2 * np.pi, (count, 1)) + np.cumsum(turning * STEP, 1)
    path = np.cumsum(SPEED * STEP * np.stack([np.cos(course), np.sin(course)], -1), 1)
    outlier = rng.random((count, FIXES)) < RATE
    off = np.where(outlier[..., None], FAR / np.sqrt(2), NOISE) * rng.standard_normal(path.shape)
    start = rng.uniform([-60.0, -170.0], [60.0, 170.0], (count, 1, 2))
    scale = DEGREE * np.stack([np.ones((count, 1)), np.cos(np.radians(start[..., 0]))], -1)
    truth, fixes = ((start + where / scale).reshape(-1, 2) for where in (path, path + off))
    moment = (1.7e9 + rng.uniform(0, 80_000, (count, 1)).round(1) + STEP * np.arange(FIXES)).ravel()
    columns = {
        "time": moment, "icao24": np.repeat([f"{first + i:06x}" for i in range(count)], FIXES), "lat": fixes[:, 0],
        "lon": fixes[:, 1], "geoaltitude": 9000 + NOISE * rng.standard_normal(len(moment)),
        "true_north": truth[:, 0], "true_east": truth[:, 1], "is_outlier": outlier.ravel().astype(np.int8),
    }  # fmt: skip
    return pyarrow.table(columns).take(np.argsort(moment, kind="stable"))


def error(folder: Path) -> float:
    """Of cleaned positions over that of the fixes."""
    names = ["row", "latitude", "longitude", "raw_latitude", "raw_longitude"]
    cleaned = dataset.dataset(folder / "clean", format="parquet").to_table(names)
    row, *places = (column.to_numpy() for column in cleaned.columns)
    squares, first = np.zeros(2), 0
    for file in sorted((folder / "flights").iterdir()):
        truth = parquet.read_table(file, columns=["true_north", "true_east", "is_outlier"])
        north, east, outlier = (column.to_numpy() for column in truth.columns)
        here = (row >= first) & (row < first + len(north))
        at = row[here] - first
        for i in range(2):
            off = [
                places[2 * i][here] - north[at],
                (places[2 * i + 1][here] - east[at]) * np.cos(np.radians(north[at])),
            ]
            squares[i] += np.square(off).sum(0)[outlier[at] == 0].sum()
        first += len(north)
    return float(np.sqrt(squares[0] / squares[1]))


def processors() -> float:
    """Seconds that processors have worked for the processes that this one has started."""
    of = resource.getrusage(resource.RUSAGE_CHILDREN)
    return of.ru_utime + of.ru_stime


if __name__ == "__main__":
    sys.exit(main())

"""Two boats or one ship: the harbour's manager of targets on simulated harbours, by kind of encounter.

    python scripts/harbours.py --seed 100 --runs 4 --json out/harbours.json
    python scripts/harbours.py --kinds beside,ship --apart 10 15 --detection 0.85 --sensors radar

``scenarios.harbour`` has boats side by side, turning together, crossing and overtaking, and ships that show their other
end now and then.  Each row is a mean over runs, distances and probabilities of detection: GOSPA, HOTA and IDF1 with a
cutoff of 20 m, the share of the radar's scans in which boats are followed, switches of identity, false tracks a minute,
and the most scans on end in which two tracks are within a cutoff of a ship.
"""

from __future__ import annotations

import argparse
import sys
from statistics import fmean
from typing import Any

from lists import check_list
from recorded_bench import autoferry
from torch import Tensor

from torchfra import scenarios
from torchfra.cli.command import add_output_options, add_runs_options, check_files, exit_status, make_parser
from torchfra.running.versions import write_results
from torchfra.scenarios.harbour import KINDS
from torchfra.tables import significant, text_table

PARTS = (*autoferry.PARTS, "twice")


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns the exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    add_runs_options(p, 2, 100)
    p.add_argument("--kinds", default=",".join(KINDS), metavar="A,B", help=f"some of {', '.join(KINDS)} (default: all)")
    p.add_argument("--apart", type=float, nargs="+", default=[10.0, 15.0], metavar="METRES",
                   help="between two boats (default: 10 15)")  # fmt: skip
    p.add_argument("--detection", type=float, nargs="+", default=[0.6, 0.85], metavar="P",
                   help="of the radar (default: 0.6 0.85)")  # fmt: skip
    p.add_argument("--sensors", default=",".join(autoferry.OWN_PRESETS), metavar="A,B", help="default: %(default)s")
    add_output_options(p)
    options = p.parse_args(arguments)
    check_list(p, "kinds", options.kinds, KINDS)
    check_list(p, "sensors", options.sensors, autoferry.OWN_PRESETS)
    return exit_status("harbours", lambda: compare(options))


def compare(options: argparse.Namespace) -> None:
    """Follows all boats, prints and writes."""
    check_files({"json": options.json})
    rows = []
    for kind in options.kinds.split(","):
        aparts = options.apart[:1] if kind == "ship" else options.apart
        for sensors in options.sensors.split(","):
            found = [
                followed(sensors, scenarios.harbour(kind, seed=options.seed + run, apart=apart, detection=detection))
                for apart in aparts for detection in options.detection for run in range(options.runs)
            ]  # fmt: skip
            rows.append({"kind": kind, "sensors": sensors} | {x: fmean(of[x] for of in found) for x in PARTS[:-1]})
            rows[-1]["twice"] = max(of["twice"] for of in found)
    if not options.quiet:
        cells = [[row["kind"], row["sensors"], *(significant(row[x]) for x in PARTS)] for row in rows]
        print(text_table(["kind", "sensors", *PARTS], cells))
    write_results(options.json, {"settings": vars(options) | {"json": str(options.json)}, "rows": rows})


def followed(sensors: str, recording: scenarios.Harbour) -> dict[str, Any]:
    """The figures of a recording, and the most scans on end in which a boat has two tracks."""
    found = autoferry.follow(sensors, scene(recording))
    return {**found.figures, "twice": twice(found.mean, recording) if len(recording.truth) == 1 else 0}


def scene(recording: scenarios.Harbour) -> autoferry.Scene:
    """A simulated recording as one of the harbour, whose radar says later when it has measured."""
    scans = []
    for k, lidar in enumerate(recording.lidar.tolist()):
        sensor = autoferry.LIDAR if lidar else autoferry.RADAR
        age, z, truth = autoferry.AGE[sensor], recording.z[k], recording.truth[:, k]
        z = z[~z.isnan().any(-1)]
        moved = truth[:, :2] + age * truth[:, 2:]
        scans.append(autoferry.Scan(float(recording.time[k]) + age, sensor, recording.ferry[k], z, moved))
    return autoferry.Scene("simulated", sorted(scans, key=lambda scan: scan.time), {})


def twice(mean: Tensor, recording: scenarios.Harbour) -> int:
    """The most scans on end in which two tracks ``mean (K, T, 2)`` are nearer to the ship than the cutoff."""
    ship = recording.truth[0, ~recording.lidar, :2]
    near = ((mean - ship).norm(dim=-1) < autoferry.CUTOFF).sum(0) >= 2
    longest = run = 0
    for now in near.tolist():
        run = run + 1 if now else 0
        longest = max(longest, run)
    return longest


if __name__ == "__main__":
    sys.exit(main())

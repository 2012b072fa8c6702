"""What mending the time stamps of recorded flights changes (torchfra.readers.flyable).

    python scripts/time_stamps.py FILES

Quantiles before and after, over steps of 5 s of all tracks of the files that last 100 s without a gap over 30 s:
accelerations along and across the track and as a whole, speed, turn rate.  Then how far positions moved: from where the
recording has them at the same time, and from the recorded path at any time within 30 s.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from torchfra.cli.command import add_output_options, check_files, exit_status, make_parser
from torchfra.readers import Recording, flyable, read, resample
from torchfra.readers.columns import Array
from torchfra.running.versions import write_results
from torchfra.tables import text_table

DT, MAX_GAP, SHORTEST, NEAR = 5.0, 30.0, 21, 30.0
QUANTILES = (0.5, 0.9, 0.99, 1.0)


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("files", metavar="FILE", nargs="+", type=Path, help="recorded tracks")
    add_output_options(p)
    return exit_status("time_stamps", lambda: compare(p.parse_args(arguments)))


def compare(options: argparse.Namespace) -> None:
    """Reads, mends, compares and prints.

    Raises:
        ValueError: no track is long enough.
    """
    check_files({"json": options.json}, options.files)
    before = [recording for file in options.files for recording in read(file)]
    after = [flyable(recording, max_gap=MAX_GAP) for recording in before]
    raw, mended = motion(before), motion([piece for pieces in after for piece in pieces])
    values = {f"{name}, {when}": x[name] for name in raw for when, x in (("recorded", raw), ("mended", mended))}
    pairs = [(recording, piece) for recording, pieces in zip(before, after, strict=True) for piece in pieces]
    values["moved, m"] = np.concatenate([moved(*pair) for pair in pairs])
    values["off the recorded path, m"] = np.concatenate([off_path(*pair) for pair in pairs])
    result = {name: np.quantile(x, QUANTILES).tolist() for name, x in values.items()}
    if not options.quiet:
        rows = [[name, *(f"{value:.1f}" for value in row)] for name, row in result.items()]
        print(text_table(["", *(f"{q:.0%}" for q in QUANTILES)], rows))
    write_results(options.json, {"quantiles": QUANTILES, **result})


def motion(recordings: Sequence[Recording]) -> dict[str, Array]:
    """Accelerations, speeds and turn rates at all steps of all long pieces."""
    found: dict[str, list[Array]] = {}
    pieces = (piece for recording in recordings for piece in resample(recording, DT, max_gap=MAX_GAP))
    for _, position in pieces:
        if len(position) < SHORTEST:
            continue
        velocity = np.diff(position[:, :2], axis=0) / DT
        change, mean = np.diff(velocity, axis=0) / DT, (velocity[1:] + velocity[:-1]) / 2
        ahead = mean / np.linalg.norm(mean, axis=1).clip(1e-9)[:, None]
        heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        for name, values in (
            ("acceleration along, m/s^2", np.abs((change * ahead).sum(1))),
            ("acceleration across, m/s^2", np.abs(change[:, 0] * ahead[:, 1] - change[:, 1] * ahead[:, 0])),
            ("acceleration, m/s^2", np.linalg.norm(change, axis=1)),
            ("speed, m/s", np.linalg.norm(velocity, axis=1)),
            ("turn rate, degrees/s", np.degrees(np.abs(np.diff(heading))) / DT),
        ):
            found.setdefault(name, []).append(values)
    if not found:
        raise ValueError(f"files: expected a track of {SHORTEST * DT:g} s or longer without a gap over {MAX_GAP:g} s")
    return {name: np.concatenate(values) for name, values in found.items()}


def moved(recording: Recording, piece: Recording) -> Array:
    """Distances between both at the times of the fixes that are left."""
    old, new = np.isin(recording.time, piece.time), np.isin(piece.time, recording.time)
    return np.asarray(np.linalg.norm(piece.position[new, :2] - recording.position[old, :2], axis=1))


def off_path(recording: Recording, piece: Recording) -> Array:
    """Distances of a mended piece from the curve through the recorded fixes."""
    return np.array(
        [min(_to_curve(recording, *at), default=0.0) for at in zip(piece.time, piece.position[:, :2], strict=True)]
    )


def _to_curve(recording: Recording, time: float, point: Array) -> Iterator[float]:
    low, high = np.searchsorted(recording.time, (time - NEAR, time + NEAR))
    low, high = max(low - 2, 0), high + 2
    part = Recording("", recording.time[low:high], recording.position[low:high], None, {})
    for _, curve in resample(part, 0.5, max_gap=np.inf):
        start, leg = curve[:-1, :2], np.diff(curve[:, :2], axis=0)
        share = ((point - start) * leg).sum(1) / (leg**2).sum(1).clip(1e-9)
        yield float(np.linalg.norm(start + share.clip(0, 1)[:, None] * leg - point, axis=1).min())


if __name__ == "__main__":
    sys.exit(main())

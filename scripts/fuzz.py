"""Fuzzing of what reads files that others made: tracks, ranges, learned values, kernels.

Bytes are changed with coverage as the guide (https://github.com/google/atheris, `pip install atheris`) until something
else comes out than what is promised: tracks in order of time or a ValueError; values within their ranges or a
ValueError; the kernel of its digest or None.  What breaks that, takes 10 seconds or 2 GiB is left in a
file beside the folder that `--again FILE` tries once more.
"""

from __future__ import annotations

import argparse
import gzip
import io
import json
import os
import struct
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow
import torch
from pyarrow import feather, parquet

try:
    import atheris

    watched = atheris.instrument_imports(include=["torchfra"])
except ImportError:  # the targets can be called without it
    atheris, watched = None, nullcontext()

with watched:
    from torchfra import presets, readers, state_files
    from torchfra.compiler import cache
    from torchfra.motion import ConstantVelocity
    from torchfra.readers.formats import FORMATS
    from torchfra.sensors import Position

ROOT = Path(__file__).resolve().parent.parent
ENDS = (".csv", ".json", ".gpx", ".kml", ".nmea", ".igc", ".fit", ".parquet", ".xlsx", ".txt")
"""Of a file's name: its first byte chooses one."""
MOST = 2**20
"""Bytes that a file may hold, unpacked."""
NAME, KERNEL = "kernel.o", bytes(range(200))


def written(folder: Path, data: bytes, ends: Sequence[str]) -> Path:
    """The file, whose first byte chooses the end of its name."""
    path = folder / f"a{ends[data[0] % len(ends)]}"
    path.write_bytes(data[1:])
    return path


def tracks(folder: Path, data: bytes) -> None:
    """A file of tracks is read or refused."""
    try:
        recordings = readers.read(written(folder, data, ENDS), max_bytes=MOST)
    except ValueError:
        return
    for one in recordings:
        assert len(one.time) == len(one.position) >= 2, one
        assert (np.diff(one.time, prepend=-np.inf) > 0).all(), one
        assert np.isfinite(np.column_stack([one.time, one.position])).all(), one


def ranges(folder: Path, data: bytes) -> None:
    """A file of ranges is read or refused."""
    try:
        recording = readers.read_ranges(written(folder, data, ENDS[:2]), max_bytes=MOST)
    except ValueError:
        return
    for time, distance in zip(recording.times, recording.ranges, strict=True):
        assert (np.diff(time, prepend=-np.inf) > 0).all(), recording
        assert (distance > 0).all(), recording


def values(folder: Path, data: bytes) -> None:
    """Learned values, with a right digest or as they are, are loaded or refused."""
    path, f = folder / "a.pt", FILTER
    body = data[1:-2] + struct.pack("<H", state_files._LENGTH)
    path.write_bytes(body + state_files._digest(body) if data[0] % 2 else data[1:])
    try:
        state_files.load_values(f, state_files.read(path))
    except ValueError:
        return
    assert all(x.isfinite().all() for x in f.state_dict().values()), f


def kernels(folder: Path, data: bytes) -> None:
    """A kernel is what its digest says, or none."""
    path = folder / NAME
    path.write_bytes(data)
    path.chmod(0o600)
    found = cache.read(NAME)  # the digest may be right of another content, as comparisons tell it to the fuzzer
    assert found is None or data == found + cache._digest(NAME, found)


FILTER = presets.fra(ConstantVelocity(q=1.0), Position(std=2.0), learn=("threshold", "weakening"))
TARGETS: dict[str, Callable[[Path, bytes], None]] = {
    "tracks": tracks, "ranges": ranges, "values": values, "kernels": kernels
}  # fmt: skip


def examples(target: str) -> list[bytes]:
    """Good files, from which changes begin."""
    if target == "kernels":
        return [KERNEL + cache._digest(NAME, KERNEL)]
    if target == "values":
        torch.save(FILTER.state_dict(), file := io.BytesIO())
        return [b"\0" + state_files.pack(FILTER.state_dict()), b"\1" + file.getvalue()]
    sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests/readers")]
    if target == "ranges":
        import test_range_readers as files

        texts = [files.device("A3"), files.plain("A3"), files.together(), files.together(True), files.ANCHORS]
        return [bytes([0]) + text.encode() for text in texts]
    import test_formats

    held = [("a.parquet", in_memory(parquet.write_table)), ("a.parquet", in_memory(feather.write_feather))]
    for name, content in test_formats.FILES.items():
        text = (content if isinstance(content, str) else json.dumps(content, default=float)).encode()
        held.append((name, gzip.compress(text) if name.endswith("gz") else text))
    for one in FORMATS:
        names = [*(need.split("|")[0] for need in one.needs.split()), "time", "lat", "lon", "x", "y"]
        held.append(("a.csv", test_formats.table(",".join(names), [[i] * len(names) for i in range(3)]).encode()))
    return [bytes([ENDS.index(end) if (end := Path(name).suffix) in ENDS else 0]) + text for name, text in held]


def in_memory(write: Callable[[object, object], None]) -> bytes:
    """A small table, written by pyarrow."""
    write(
        pyarrow.table({"t": np.arange(5.0), "x": np.zeros(5), "y": np.zeros(5), "id": ["a"] * 5}), file := io.BytesIO()
    )
    return file.getvalue()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument(
        "--corpus", type=Path, required=True, metavar="FOLDER", help="found files, kept from run to run"
    )
    parser.add_argument("--seconds", type=int, default=600, help="(default: %(default)s)")
    parser.add_argument("--again", metavar="FILE", help="only this one")
    options = parser.parse_args()
    if atheris is None:
        parser.error("needs Atheris: pip install atheris")
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    options.corpus.mkdir(parents=True, exist_ok=True)
    for i, example in enumerate(examples(options.target)):
        (options.corpus / f"example-{i}").write_bytes(example)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.path.isdir("/dev/shm") else None) as folder:
        os.environ["TORCHFRA_CACHE"] = folder
        os.chmod(folder, 0o700)
        work = partial(TARGETS[options.target], Path(folder))
        limits = [
            f"-artifact_prefix={options.corpus}-",
            "-timeout=10",
            "-rss_limit_mb=2048",
            "-max_len=8192",
            f"-max_total_time={options.seconds}",
        ]
        given = [options.again] if options.again else [str(options.corpus), *limits]
        atheris.Setup([sys.argv[0], *given], lambda data: work(data or b"\0"))
        atheris.Fuzz()


if __name__ == "__main__":
    main()

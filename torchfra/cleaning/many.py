"""Tracks of a data set, cleaned part by part, each into a file of its own that is written completely or not at all.

An existing part is done, so that work that was ended at any moment continues where it was.
"""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchfra.cleaning import Cleaned, clean_tracks
from torchfra.cleaning.outputs.parquet import Growing
from torchfra.readers.clocks import YEAR_1980
from torchfra.readers.datasets import DataSet
from torchfra.readers.options import listed
from torchfra.readers.recording import Recording
from torchfra.running.atomic_write import write, write_json
from torchfra.running.memory import peak_memory
from torchfra.version import __version__

_TOGETHER = 25_000
"""Approximate number of rows that are cleaned at a time, in some 350 MB."""
_RUN, _FACTS = "_run.json", "_parts"
"""Names of the settings of all parts, and of the results of each; readers of data sets skip names with underscores."""


@dataclass(frozen=True)
class Work:
    """The parts of a data set, and the folder of their results."""

    data: DataSet
    folder: Path
    rows: int
    """Approximate number of rows of a part."""
    settings: Mapping[str, Any]
    """Arguments of ``clean_tracks``."""

    @property
    def parts(self) -> int:
        """The number of parts."""
        return -(-self.data.rows // self.rows)

    def begin(self) -> None:
        """Makes the folder, or finds the parts of another call in it.

        Raises:
            ValueError: it holds something else, or parts of other data or settings.
            OSError: it cannot be written.
        """
        # Files are listed first: another process that begins at the same moment writes its settings before its parts;
        # hidden files are unfinished.
        names = [path.name for path in self.folder.iterdir()] if self.folder.exists() else []
        foreign = sorted(name for name in names if name not in (_RUN, _FACTS) and not name.startswith("."))
        ours, path = self._plan(), self.folder / _RUN
        if path.exists():
            theirs = _read(path)
            for name in (name for name in ours if ours[name] != theirs.get(name)):
                old, new = theirs.get(name), ours[name]
                raise ValueError(
                    f"out: expected the settings of the parts in {self.folder}, {name} {_difference(old, new)}, "
                    f"received {_difference(new, old)}: name another folder, or remove that one"
                )
        elif foreign:
            raise ValueError(
                f"out: expected a new folder or an empty one, received {self.folder} with {listed(foreign)}"
            )
        else:
            write_json(path, ours)

    def _plan(self) -> dict[str, Any]:
        reader = self.data.reader
        reading = {name: said for name, said in asdict(reader.options).items() if said is not None}
        files = {file.name: [file.rows, file.bytes, file.footer] for file in self.data.files}
        return {
            "version": __version__, "rows": self.rows, **self.settings, "reading": reading,
            "columns": reader.layout.source.columns, "files": files,
        }  # fmt: skip

    def is_done(self, part: int) -> bool:
        """Whether the files of a part exist."""
        return all(path.exists() for path in self._paths(part))

    def facts(self) -> list[dict[str, Any]]:
        """The results of the existing parts; see ``clean_part``."""
        return [_read(self._paths(part)[0]) for part in range(self.parts) if self.is_done(part)]

    def _paths(self, part: int) -> tuple[Path, Path]:
        """Paths of the results of a part, which are written last, and of its table."""
        name = f"part-{part:05}"
        return self.folder / _FACTS / f"{name}.json", self.folder / f"{name}.parquet"


def clean_part(work: Work, part: int) -> dict[str, Any]:
    """Cleans the targets of a part, some at a time, and writes them.

    Returns:
        Counts of ``targets``, ``rows``, ``fixes``, ``outliers``, ``steps`` in the table and
        ``repairs``; ``failed``, names of targets and why; ``seconds`` that it took; and ``memory``, the most that this
        process has had, in bytes.
    """
    begun, counts, repairs = time.perf_counter(), Counter[str](), Counter[str]()
    failed: dict[str, str] = {}
    facts, table = work._paths(part)

    def fill(file: Any) -> None:
        with closing(Growing(file, _like(work))) as growing:
            for rows, recordings, wrong in work.data.recordings(part, work.parts, _TOGETHER):
                failed.update(wrong.failed)
                repairs.update(wrong.repairs)
                results = _cleaned(recordings, work.settings, failed)
                growing.add(results)
                counts["rows"] += rows
                for cleaned in results:
                    fixes, rejected = int((cleaned.row >= 0).sum()), int((cleaned.flag == "outlier").sum())
                    counts.update(targets=1, fixes=fixes, outliers=rejected, steps=len(cleaned.time))
                    repairs.update(cleaned.recording.repairs)
                    if unknown := int(cleaned.failed.sum()):
                        failed[cleaned.recording.name] = f"NaN or infinity in {unknown} of {len(cleaned.time)} steps"

    write(table, fill)
    said: dict[str, Any] = {name: counts[name] for name in ("targets", "rows", "fixes", "outliers", "steps")}
    said |= {"repairs": dict(+repairs), "failed": failed}
    said |= {"seconds": time.perf_counter() - begun, "memory": peak_memory()}
    write_json(facts, said)
    return said


def _cleaned(recordings: Sequence[Recording], settings: Mapping[str, Any], failed: dict[str, str]) -> list[Cleaned]:
    """The recordings that can be cleaned; reasons of the others are added to ``failed``."""
    try:
        results = clean_tracks(recordings, **settings)
    except ValueError as error:  # of one target that is too fast for its bank; the others are cleaned without it
        if len(recordings) == 1:
            failed[recordings[0].name] = str(error)
            return []
        return [cleaned for one in recordings for cleaned in _cleaned([one], settings, failed)]
    failed |= {cleaned.recording.name: cleaned.found.failure for cleaned in results if cleaned.found.failure}
    return [cleaned for cleaned in results if not cleaned.found.failure]


def _like(work: Work) -> Cleaned:
    """A target with all columns that any target of the data set can have."""
    layout = work.data.reader.layout
    time = np.arange(3, dtype=np.float64) + (YEAR_1980 if layout.clock.dated else 0.0)
    d = 3 if {"altitude", "z"} & layout.columns.keys() else 2
    position, origin = np.repeat(time[:, None], d, 1), (0.0, 0.0, 0.0) if layout.degrees else None
    (cleaned,) = clean_tracks([Recording("", time, position, origin, {}, source=layout.source)], **work.settings)
    return cleaned


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"out: expected JSON of this command in {path}, received other text") from error


def _difference(one: object, other: object) -> str:
    """The text of one of two values that differ; of two dictionaries, the first entry that does."""
    if isinstance(one, dict) and isinstance(other, dict):
        return next((f"{key} {json.dumps(one[key])}" for key in one if one[key] != other.get(key)), "nothing more")
    return json.dumps(one)


def summed(every: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Results of all parts, from those of each; ``rows_per_second`` are those of one process."""
    total: dict[str, Any] = {
        name: sum(facts[name] for facts in every)
        for name in ("targets", "rows", "fixes", "outliers", "steps", "seconds")
    }
    total["repairs"] = dict(sum((Counter(facts["repairs"]) for facts in every), Counter[str]()))
    total["failed"] = {name: why for facts in every for name, why in facts["failed"].items()}
    total["memory"] = max((facts["memory"] for facts in every), default=0)
    return total | {"rows_per_second": total["rows"] / total["seconds"] if total["seconds"] else 0.0}

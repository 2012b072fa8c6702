"""Repairs the rows of every target, and counts the repairs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.clocks import YEAR_1980
from torchfra.readers.columns import Array, grouped
from torchfra.readers.layouts import SIDES, Layout, without_sign
from torchfra.readers.names import MARKS
from torchfra.readers.options import AskError, listed
from torchfra.readers.tables import Table
from torchfra.readers.times import count_of
from torchfra.tables import in_words, plural

_MANY = 0.1
"""Share of rows with another position at the time of another row, from which on they are of several targets."""
_HELD, _ONCE, _NEW, _FAR = 25, 0.1, 0.5, 10.0
"""Positions from which on they may be held, the share of them that may come once only, the share that is new at least,
and how many of the last digits that are written lie between neighbours."""
_RARELY, _PIECES, _APART = 0.1, 3, 3.0
"""Share of rows whose time may go back where it has no date; rows that are neighbours in time alone, for each Unix time
that goes back, up to which a file has whole pieces of a track in another order; and how many times as long as in the
file the ways between such rows may be otherwise."""
_SOONER, _OLDEST, _OFTEN = 1.0, 60.0, 0.5
"""Seconds by which the update of a position may be later than its row and earlier, and the share of rows with one."""
_HOUR, _COARSE = 3600.0, (60.0, 1.0)
"""Seconds; whole minutes and seconds, in which several rows may be."""
_NEIGHBOURS = 1.5
"""How much farther apart rows of a moment may be than those of two moments, if all are of one target."""
_PLACEHOLDERS = (-999.0, -1000.0, -9999.0, -99999.0, 999.0, 9999.0, 99999.0, -32768.0, 32767.0, -2147483648.0,
                 2147483647.0)  # fmt: skip
_ENOUGH, _NULL_ISLAND = 25, 1.0
"""Numbers that may stand for none, the fewest others that show it; degrees around 0, 0 without any other fix."""


@dataclass(frozen=True)
class Target:
    """A target and the fixes that are left of it."""

    name: str
    time: Array
    """``(k,)`` seconds."""
    place: Array
    """``(k, 2)`` coordinates as in the file: x and y in metres, or latitude and longitude."""
    height: Array | None
    """``(k,)`` metres."""
    filled: NDArray[np.bool_] | None
    """``(k,)`` whether the height is missing in the file, and is that of the fix before (or after)."""
    sigma: Array | None
    """``(k,)`` or ``(k, d)`` metres."""
    row: NDArray[np.int64]
    repairs: Counter[str]


class TooFewError(ValueError):
    """No target has 2 fixes or more."""


def repaired_targets(table: Table, layout: Layout, stem: str) -> list[Target]:
    """The targets of a file that have 2 fixes or more left, in the order of the file.

    Raises:
        TooFewError: no target has as many.
    """
    ids, calls = (table.texts.get(layout.columns.get(role, "")) for role in ("id", "call"))
    down = 0
    if ids is not None:
        ids, down = _filled_down(ids, asked=layout.stated.id is not None)
    if len(zones := {*filter(None, table.texts.get(layout.columns.get("zone", ""), ()))}) > 1:
        raise ValueError(
            f"expected one zone of the grid, received {listed(sorted(zones))}: convert all to one, or to degrees"
        )
    columns, targets = _Columns(table, layout), []
    for name, rows in ({"": np.arange(table.rows)} if ids is None else grouped(ids)).items():
        index, repairs = columns.rows_to_keep(rows)
        call = "" if calls is None else next((calls[i] for i in index if calls[i]), "")
        height, filled = columns.heights(index, repairs)
        sigma = columns.sigmas(index, repairs, 2 if height is None else 3)
        full = f"{name} {call}".strip() or stem
        place, row = columns.place[index], index.astype(np.int64)
        targets.append(Target(full, columns.time[index], place, height, filled, sigma, row, repairs))
    good = [target for target in targets if len(target.time) >= 2]
    if not good:
        same = f" of the same {layout.source.word}" if len(targets) > 1 else ""
        received = max(len(target.time) for target in targets)
        counts = sum((target.repairs for target in targets), Counter[str]())
        after = f" after repairs: {in_words(counts)}" if counts else ""
        raise TooFewError(f"expected 2 or more rows with time and position{same}, received {received}{after}")
    # The counts of all targets sum to those of the file.
    good[0].repairs[dropped(layout)] = len(targets) - len(good)
    good[0].repairs["rows named as the target above them"] = down
    good[0].repairs.update(table.repairs)
    return good


def dropped(layout: Layout) -> str:
    """What became of targets that have no 2 fixes."""
    return f"{plural(layout.source.word)} of one fix or none dropped"


def _filled_down(ids: list[str], *, asked: bool) -> tuple[list[str], int]:
    """Names of targets, those above where there are none; and how many of these.

    So merged cells are written, which have a name in their first row; or the caller names the column.
    """
    several = Counter(filter(None, ids))
    if "" not in ids or not several or not ids[0] or not (asked or max(several.values()) == 1):
        return ids, 0
    filled, last = [], ""
    for name in ids:
        last = name or last
        filled.append(last)
    return filled, ids.count("")


def _check_placeholders(several: Mapping[str, Array], stated: str | None) -> None:
    """Refuses numbers such as -999, far from all others of a column: nobody says that they are none.

    Those that are ``stated`` to be none are so already.
    """
    before = f"{stated}," if stated else ""
    for number in _PLACEHOLDERS:
        rows = dict[str, int]()
        for name, values in several.items():
            at = np.isclose(values, number, rtol=0, atol=1e-6)
            rest = np.sign(number) * values[~at & np.isfinite(values)]
            if at.any() and len(rest) >= _ENOUGH and rest.max() < abs(number) / 2:
                rows[name] = int(at.argmax()) + 1
        if rows:
            raise AskError(f"received {number:.10g} as {' and '.join(rows)} in data row {min(rows.values())}, far from "
                           "all others: say ", {"missing": f"{before}{number:.10g}"}, " if it stands for none, or ",
                           {"missing": f"{before}none"})  # fmt: skip


class _Columns:
    """The columns of a table by what they hold."""

    def __init__(self, table: Table, layout: Layout) -> None:
        def column(*roles: str) -> Array:
            return table.column(next((layout.columns[role] for role in roles if role in layout.columns), ""))

        self.layout, self.clock, self.dated = layout, layout.clock, layout.clock.dated
        self.time = layout.clock.whole(table.column(layout.clock.column))
        self.place = np.stack([column("latitude", "x"), column("longitude", "y")], 1)
        self.height, self.update = column("altitude", "z"), column("update")
        for name in (layout.columns[role] for role in SIDES if role in layout.columns):
            for i, role in enumerate(("latitude", "longitude")):
                if (np.isin(table.column(name), (i + 1, 3)) & (self.place[:, i] > 0)).any():
                    raise without_sign(layout.columns[role], name)
        null = (self.place == 0).all(1)
        near = (np.abs(self.place) < _NULL_ISLAND).all(1) & ~null
        absent = null & (layout.degrees and not near.any() and not null.all())
        if "none" not in (layout.stated.missing or "").split(","):
            lengths = {layout.columns[role]: column(role) / layout.source.unit
                       for role in ("altitude", "x", "y", "z") if role in layout.columns}  # fmt: skip
            _check_placeholders(lengths, layout.stated.missing)
        self.sent = np.zeros(len(self.time), dtype=bool)
        if self.dated and layout.stated.time is None:
            # State vectors of OpenSky are of a moment up to a minute after that of the position.
            updated = np.where(self.update > 1e11, self.update / 1e3, self.update)
            sent = (self.time - updated > -_SOONER) & (self.time - updated < _OLDEST)
            if sent.sum() > _OFTEN * len(sent):
                self.sent, self.time = sent, np.where(sent, updated, self.time)
        self.noise = layout.per_axis([table.column(name) for name in layout.noise])
        marked = np.any([column("visible") == 0, *(column(role) == 1 for role in MARKS[1:])], axis=0)
        old = self.time < (YEAR_1980 if self.dated else -math.inf)
        self.tests: tuple[tuple[str, NDArray[np.bool_]], ...] = (
            ("rows without time dropped", np.isfinite(self.time)),
            ("rows without position dropped", np.asarray(np.isfinite(self.place).all(1))),
            ("rows marked as outliers dropped", np.asarray(~marked)),
            ("rows marked as invalid dropped", np.asarray(column("valid") != 0)),
            ("rows at 0, 0 degrees dropped", ~absent),
            ("rows from before 1980 dropped", ~old),
        )

    def rows_to_keep(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], Counter[str]]:
        """Which of the rows of a target to keep, in order of time, and the count of the repairs."""
        repairs: Counter[str] = Counter()

        def keep(index: NDArray[np.intp], mask: NDArray[np.bool_], what: str) -> NDArray[np.intp]:
            repairs[what] += len(index) - int(mask.sum())
            return index if mask.all() else index[mask]

        repairs["times taken from the update of the position"] = int(self.sent[rows].sum())
        index = rows
        for what, good in self.tests:
            index = keep(index, good[index], what)
        repairs["times within whole seconds spread by the order of rows"] = self._spread(index)
        time = self.time[index]
        repairs["rows put in time order"] = int((time < np.maximum.accumulate(time)).sum())
        order = np.argsort(time, kind="stable")
        self._check_same_times(index[order])
        self._check_order(time, index, order)
        index = index[order]
        again = np.diff(self.time[index], prepend=-math.inf) == 0
        index = keep(index, ~(again & self.sent[index]), "held positions dropped")
        index = keep(index, np.diff(self.time[index], prepend=-math.inf) > 0, "duplicate times dropped")
        aircraft = self.layout.source.word == "aircraft"
        cells = np.column_stack([self.place, self.update if aircraft else np.zeros(len(self.place))])
        moved = (np.diff(np.nan_to_num(cells[index], nan=1e16), axis=0, prepend=2e16) != 0).any(1)
        if not aircraft and not self._are_held(index, moved):
            return index, repairs
        return keep(index, moved, "held positions dropped"), repairs

    def _spread(self, index: NDArray[np.intp]) -> int:
        """Spreads the rows of a target within whole seconds or minutes by their order; returns how many.

        So loggers that are faster than their clock is fine write them: most moments have several rows, and
        rows of a moment are no farther apart than those of two, as rows of several targets would be.
        """
        time, steps = self.time[index], np.diff(self.time[index])
        whole_hours = (time % _HOUR == 0).all()  # such as dates whose clock is in another column
        coarse = next((one for one in _COARSE if not whole_hours and (time % one == 0).all()), 0.0)
        if not coarse or (steps < 0).any() or not (steps > 0).any():
            return 0
        starts = np.flatnonzero(np.diff(time, prepend=-math.inf) > 0)
        counts = np.diff(starts, append=len(time))
        usual = int(np.median(counts[1:-1] if len(counts) > 2 else counts))
        if (steps == 0).sum() < _OFTEN * len(time) and np.median(counts) < 2:
            return 0
        place = self.place[index]
        near, far = (np.median(np.linalg.norm(place[lag:] - place[:-lag], axis=1)) for lag in (1, usual))
        if near > _NEIGHBOURS * far or (np.diff(place, axis=0) == 0).all(1)[steps == 0].mean() > _OFTEN:
            return 0
        within = np.arange(len(time)) - np.repeat(starts, counts)
        parts = np.repeat(np.maximum(counts, usual), counts)
        within[: counts[0]] += max(usual - counts[0], 0)  # the first rows are the last of their moment
        self.time[index] = time + coarse * within / parts
        return int((within > 0).sum())

    def _are_held(self, index: NDArray[np.intp], moved: NDArray[np.bool_]) -> bool:
        """Whether rows repeat a position until there is a new one, as logs of faster sensors do, and no target rests.

        So it is where nearly all positions are repeated, which lie much farther apart than they are rounded, and most
        of them are new: receivers that say where a target is heard have few places, where it may stay.
        """
        starts = np.flatnonzero(moved)
        if len(starts) < _HELD or (np.diff(starts) < 2).mean() > _ONCE:
            return False
        places = self.place[index][starts]
        if len(np.unique(places, axis=0)) < _NEW * len(starts):
            return False
        unit = 1.0 if self.layout.degrees else self.layout.source.unit
        digits = [np.abs(places * 10**k / unit - np.rint(places * 10**k / unit)).max() < 1e-3 for k in range(9)]
        finest = unit / 10 ** (digits.index(True) if True in digits else 9)
        return bool(np.median(np.abs(np.diff(places, axis=0)).max(1)) > _FAR * finest)

    def _check_order(self, time: Array, index: NDArray[np.intp], order: NDArray[np.intp]) -> None:
        """Refuses times that begin anew: in order, the rows would mix pieces of a track, or several."""
        late, new = time < np.maximum.accumulate(time), np.flatnonzero(np.diff(order) != 1)
        if not late.any() or (np.diff(time) <= 0).all():
            return
        ways, inside = (np.linalg.norm(np.diff(self.place[of], axis=0), axis=1) for of in (index, index[order]))
        anew = not self.dated and ((late[1:] & late[:-1]).any() or late.sum() > max(1, _RARELY * len(late)))
        counted = self.dated and count_of(self.clock.form) is not None  # no date that may be turned round
        mixed = not counted or len(new) > _PIECES * (np.diff(time) < 0).sum()
        if anew or (mixed and np.median(inside[new]) > _APART * np.median(ways)):
            raise AskError(f"expected times that go on, received earlier ones from data row {index[late.argmax()] + 1} "
                           f"on, column {self.clock.column}, as of a clock that is put back or begins anew, or of "
                           "several targets: put the rows in order, or name another column, or one that tells pieces "
                           "apart, such as ", *self.layout.other_ids)  # fmt: skip

    def _check_same_times(self, index: NDArray[np.intp]) -> None:
        """Refuses rows of several targets in one: many have the time of another row and another position."""
        same = np.diff(self.time[index], prepend=-math.inf) == 0
        moved = (np.diff(self.place[index], axis=0, prepend=self.place[index[:1]]) != 0).any(1)
        count = int((same & moved).sum())
        if count > _MANY * len(index) and len(index) > 10:
            if not any(self.layout.unread) and count_of(self.clock.form):
                return  # nothing else could distinguish them
            raise AskError(
                f"{count} of {len(index)} rows have other positions at the same times as others, as rows of several "
                "targets do, or times that are too coarse: name the column that tells targets apart, such as ",
                *self.layout.other_ids, ", or another of times",
            )  # fmt: skip

    def heights(self, index: NDArray[np.intp], repairs: Counter[str]) -> tuple[Array | None, NDArray[np.bool_] | None]:
        """Altitudes, those that are missing as at the fix before (or after), and which are; None if all are missing."""
        heights = self.height[index]
        some = np.isfinite(heights)
        if not some.any():
            return None, None
        before = np.maximum.accumulate(np.where(some, np.arange(len(index)), -1))
        row = np.where(before < 0, some.argmax(), before)
        repairs["altitudes missing"] = int((~some).sum())
        return heights[row], ~some

    def sigmas(self, index: NDArray[np.intp], repairs: Counter[str], dims: int) -> Array | None:
        """Standard deviations with those that are missing or not above 0 filled; None if the file has none."""
        if not self.noise or not len(index):
            return None
        values = np.stack([column[index] for column in self.noise], 1)
        good = np.isfinite(values) & (values > 0)
        if not good.any(0).all():
            return None
        usual = np.array([np.median(column[mask]) for column, mask in zip(values.T, good.T, strict=True)])
        repairs["sigmas filled with their median"] = int((~good).any(1).sum())
        values = np.where(good, values, usual)
        if values.shape[1] == 1:
            return np.asarray(values[:, 0])
        return np.asarray(np.pad(values, ((0, 0), (0, max(0, dims - values.shape[1]))), mode="edge")[:, :dims])

"""Repairs the rows of every target, and counts the repairs."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.clocks import YEAR_1980
from torchfra.readers.columns import Array, grouped, in_seconds
from torchfra.readers.layouts import Layout
from torchfra.readers.placeholders import no_altitudes, nowhere, stand_for_none
from torchfra.readers.spelling import MARKS, name_words
from torchfra.readers.tables import Table
from torchfra.readers.times import written

_MANY = 0.1
"""Share of rows with another position at the time of another row, from which on they are of several targets."""


_HELD, _ONCE, _NEW, _FAR = 25, 0.1, 0.5, 10.0
"""Positions from which on they may be held, the share of them that may come once only, the share that is new at least,
and how many of the finest steps lie between neighbours."""
_RARELY, _MIXED = 0.04, 10
"""Share of rows whose time may go back, and how often rows change their order for each of these, where a count begins
anew."""
_APART = 3.0
"""How many times as long the ways between rows in order of time are as in the file, where dated ones are of several."""
_ZONE, _LEAST_EASTING = re.compile(r"\s*[0-9]{1,2}\s*[A-Za-z]?\s*"), 1e5
"""The name of a zone of a grid, and the least easting in one, m: zones of a house or of a field are others."""
_YEAR, _HOUR = 366 * 86_400.0, 3600.0
"""s."""
_PUT_BACK = 1.0
"""How often a year clocks are put back by an hour."""
_SOONER, _OLDEST, _OFTEN = 1.0, 60.0, 0.5
"""Seconds by which the update of a position may be later than its row and earlier, and the share of rows with one."""
_CLOSE = 0.5
"""How far the step to the first row after that may be from the usual one, as a share of it, an hour added."""


def plural(word: str) -> str:
    """Several of ``Source.word``."""
    return word if word == "aircraft" else f"{word}s"


def in_words(repairs: Mapping[str, int]) -> str:
    """Repairs with their counts as a list, in the singular where the count is 1."""
    singular = re.compile(r"s(?= |$)")  # the end of the first word that has an s there
    return ", ".join(f"{n:,} {singular.sub('', what, count=1) if n == 1 else what}" for what, n in repairs.items())


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
    members = {"": np.arange(table.rows)} if ids is None else grouped(ids)
    columns, targets = _Columns(table, layout, members), []
    for name, rows in members.items():
        index, repairs = columns.rows_to_keep(rows)
        call = "" if calls is None else next((calls[i] for i in index if calls[i]), "")
        height, filled = columns.heights(index, repairs)
        sigma = columns.sigmas(index, repairs, 2 if height is None else 3)
        full = f"{name} {call}".strip() or stem
        place = np.stack([columns.first[index], columns.second[index]], 1)
        targets.append(Target(full, columns.time[index], place, height, filled, sigma, index.astype(np.int64), repairs))
    good = [target for target in targets if len(target.time) >= 2]
    zones = table.texts.get(layout.columns.get("zone", ""), [])
    for target in good:
        several = {zones[row] for row in target.row if zones and _ZONE.fullmatch(zones[row])}
        if len(several) > 1 and np.abs(target.place[:, 0]).min() > _LEAST_EASTING:
            raise ValueError(
                f"expected positions of {layout.source.word} {target.name} in one zone of the grid, received "
                f"{layout.columns['zone']} {', '.join(sorted(several)[:3])}: convert them to one, or to degrees"
            )
    if not good:
        raise TooFewError(_too_few(targets, layout.source.word))
    # The counts of all targets sum to those of the file.
    good[0].repairs[dropped(layout)] = len(targets) - len(good)
    return good


def dropped(layout: Layout) -> str:
    """What became of targets that have no 2 fixes."""
    return f"{plural(layout.source.word)} of one fix or none dropped"


def _too_few(targets: list[Target], word: str) -> str:
    """An error message."""
    same = f" of the same {word}" if len(targets) > 1 else ""
    received = max(len(target.time) for target in targets)
    repairs = sum((target.repairs for target in targets), Counter[str]())
    after = f" after repairs: {in_words(repairs)}" if repairs else ""
    return f"expected 2 or more rows with time and position{same}, received {received}{after}"


class _Columns:
    """The columns of a table by what they hold."""

    def __init__(self, table: Table, layout: Layout, members: Mapping[str, NDArray[np.intp]]) -> None:
        def column(*roles: str) -> Array:
            return table.column(next((layout.columns[role] for role in roles if role in layout.columns), ""))

        self.clock = layout.clock
        self.time = layout.clock.whole(table.column(layout.clock.column))
        self.carried = self._carry_on_together(members.values())
        layout.clock.check_order(self.time)
        self.first, self.second = column("latitude", "x"), column("longitude", "y")
        self.height, self.spare = column("altitude", "z"), column("second")
        unit = 1.0 if layout.degrees else layout.source.unit
        self.absent = nowhere(self.first / unit, self.second / unit, layout.degrees)
        is_none = no_altitudes if layout.degrees else stand_for_none
        self.no_height = is_none(self.height / layout.source.unit)
        self.height = np.where(self.no_height, np.nan, self.height)
        self.update, self.time_stated = column("update"), layout.time_stated
        self.sent = self._times_of_positions()
        self.time = np.where(self.sent, in_seconds(self.update), self.time)
        noise = [table.column(name) for name in layout.noise]
        self.noise = layout.per_axis(noise)
        self.marked = column("visible") == 0
        for role in MARKS[1:]:
            self.marked |= column(role) == 1
        self.valid = column("valid") != 0
        self.may_be_held = layout.source.word == "aircraft"
        self.dated, self.ids = layout.clock.since_1970, layout.source.id_options
        self.other_times = layout.other_times

    def _carry_on_together(self, members: Iterable[NDArray[np.intp]]) -> NDArray[np.bool_]:
        """Carries counts that begin anew on for all targets at once, where rows are in order; returns which rows.

        A target alone may have no row before midnight.  Rows of one target behind those of another begin anew too.
        """
        rows, carried = np.flatnonzero(np.isfinite(self.time)), np.zeros(len(self.time), dtype=bool)
        mixed = any((np.diff(of) != 1).any() for of in members)
        if mixed and (np.diff(together := self.clock.going_on(self.time[rows])) >= 0).all():
            carried[rows] = together != self.time[rows]
            self.time[rows] = together
        return carried

    def _times_of_positions(self) -> NDArray[np.bool_]:
        """Rows ``(rows,)`` whose position is of the moment of its update, as state vectors of OpenSky have it.

        Their own time is that of the state, up to a minute later.
        """
        if not self.clock.since_1970 or self.time_stated:
            return np.zeros(len(self.time), dtype=bool)
        age = self.time - in_seconds(self.update)
        sent = (age > -_SOONER) & (age < _OLDEST)
        return sent if sent.sum() > _OFTEN * len(sent) else np.zeros_like(sent)

    def rows_to_keep(self, rows: NDArray[np.intp]) -> tuple[NDArray[np.intp], Counter[str]]:
        """Which of the rows of a target to keep, in order of time, and the count of the repairs."""
        repairs: Counter[str] = Counter()

        def keep(index: NDArray[np.intp], mask: NDArray[np.bool_], what: str) -> NDArray[np.intp]:
            repairs[what] += len(index) - int(mask.sum())
            return index if mask.all() else index[mask]

        repairs["times taken from the update of the position"] = int(self.sent[rows].sum())
        index = keep(rows, np.isfinite(self.time[rows]), "rows without time dropped")
        time = self.clock.going_on(self.time[index])
        repairs["times carried on where the count begins anew"] = int(
            (self.carried[index] | (time != self.time[index])).sum()
        )
        self.time[index] = time
        self._check_count_down(time)
        index = keep(index, np.isfinite(self.first[index]) & np.isfinite(self.second[index]),
                     "rows without position dropped")  # fmt: skip
        index = keep(index, ~self.marked[index], "rows marked as outliers dropped")
        index = keep(index, self.valid[index], "rows marked as invalid dropped")
        index = keep(index, ~self.absent[index], "rows with a placeholder for their position dropped")
        if self.dated:
            index = keep(index, self.time[index] >= YEAR_1980, "rows from before 1980 dropped")
        time = self.time[index]
        self._check_season(time, index)
        repairs["rows put in time order"] = int((time < np.maximum.accumulate(time)).sum())
        order = np.argsort(time, kind="stable")
        self._check_same_times(index[order])
        self._check_restart(time, index, order)
        index = index[order]
        again = np.diff(self.time[index], prepend=-math.inf) == 0
        index = keep(index, ~(again & self.sent[index]), "held positions dropped")
        index = keep(index, np.diff(self.time[index], prepend=-math.inf) > 0, "duplicate times dropped")
        moved = np.zeros(len(index), dtype=bool)
        for column in (self.first, self.second, self.update) if self.may_be_held else (self.first, self.second):
            moved |= np.diff(np.nan_to_num(column[index], nan=1e16), prepend=2e16) != 0
        if not self.may_be_held and not self._are_held(index, moved):
            return index, repairs
        return keep(index, moved, "held positions dropped"), repairs

    def _are_held(self, index: NDArray[np.intp], moved: NDArray[np.bool_]) -> bool:
        """Whether rows repeat a position until there is a new one, as logs of faster sensors do, and no target rests.

        So it is where nearly all positions are repeated, which lie much farther apart than they are rounded, and most
        of them are new: receivers that say where a target is heard have few places, where it may stay.
        """
        starts = np.flatnonzero(moved)
        if len(starts) < _HELD or (np.diff(starts) < 2).mean() > _ONCE:
            return False
        places = np.stack([self.first[index][starts], self.second[index][starts]], 1)
        if len(np.unique(places, axis=0)) < _NEW * len(starts):
            return False
        steps = [np.abs(np.diff(column[index][starts])) for column in (self.first, self.second)]
        finest = [step[step > 0].min(initial=np.inf) for step in steps]
        return bool(max(np.median(step / fine) for step, fine in zip(steps, finest, strict=True)) > _FAR)

    def _check_season(self, time: Array, index: NDArray[np.intp]) -> None:
        """Refuses times of a clock that is put back by an hour while rows go on."""
        steps = np.diff(time)
        back = np.flatnonzero(steps < 0)
        if not self.clock.is_local or not 0 < len(back) <= _PUT_BACK * (time.max() - time.min()) / _YEAR + 1:
            return
        usual = np.median(steps)
        if (np.abs(steps[back] + _HOUR - usual) < _CLOSE * usual + 1).all():
            raise ValueError(
                f"expected times that go on, received one {-steps[back[0]] / 60:.3g} minutes before that of the row "
                f"before in data row {index[back[0] + 1] + 1}, {self.clock.column}, as of a clock that is put back an "
                "hour at the end of summer time: write UTC, or an offset such as +01:00 behind each time"
            )

    def _check_restart(self, time: Array, index: NDArray[np.intp], order: NDArray[np.intp]) -> None:
        """Refuses times that begin anew while rows go on: ordered, pieces of one track, or several, would be mixed."""
        back = np.flatnonzero(np.diff(time) < 0)
        mixed = np.count_nonzero(np.diff(order) != 1)
        if not 0 < len(back) <= _RARELY * len(time) or mixed <= _MIXED * len(back):
            return
        if self._usual_way(index[order]) > (_APART if self.dated else 1) * self._usual_way(
            index
        ):  # the rows are no pieces of one path
            two = time[back[0] : back[0] + 2]
            before, after = written(two, self.clock.form) if self.dated else [f"{value:g} s" for value in two]
            cause = "rows of another target" if self.dated else "a logger that was started again"
            raise ValueError(
                f"expected times that go on, received {after} behind {before} in data row {index[back[0] + 1] + 1}, "
                f"{self.clock.column}, as of {cause}: name another column by --time, or one that tells the pieces "
                "apart by --id"
            )

    def _usual_way(self, index: NDArray[np.intp]) -> float:
        """Median length of the ways between these rows, in the units of the file."""
        return float(np.median(np.hypot(np.diff(self.first[index]), np.diff(self.second[index]))))

    def _check_count_down(self, time: Array) -> None:
        """Refuses the clock of a game, which counts down, as times: velocities would point backwards."""
        words = {"clock", "remaining", "left", "countdown"} & {*name_words(self.clock.column)}
        if words and not self.dated and (np.diff(time) < 0).sum() > 2 * (np.diff(time) > 0).sum():
            raise ValueError(
                f"column {self.clock.column}: expected times that go on, received a clock that counts down: name "
                "another column by --time, or write seconds since the start"
            )

    def _check_same_times(self, index: NDArray[np.intp]) -> None:
        """Refuses rows of several targets in one: many have the time of another row and another position."""
        same = np.diff(self.time[index], prepend=-math.inf) == 0
        moved = np.zeros(len(index), dtype=bool)
        for column in (self.first, self.second):
            moved[1:] |= np.diff(column[index]) != 0
        count = int((same & moved).sum())
        if self.ids and count > _MANY * len(index):
            times = [f"; or, if it is one target, take other times: --time '{name}'" for name in self.other_times[:1]]
            raise ValueError(
                f"{count} of {len(index)} rows have other positions at the same times as others, as rows of several "
                f"targets do: name the column that distinguishes them, {' or '.join(self.ids[:2])}{''.join(times)}"
            )

    def heights(self, index: NDArray[np.intp], repairs: Counter[str]) -> tuple[Array | None, NDArray[np.bool_] | None]:
        """Altitudes, those that are missing as at the fix before (or after), and which are; None if all are missing.

        They are all of one column: of the spare one, if that has more than twice as many.
        """
        own, spare = np.isfinite(self.height[index]), np.isfinite(self.spare[index])
        # The two differ by the weather, up to hundreds of metres: where both were taken, one would be an outlier.
        use_spare = 2 * own.sum() < spare.sum()
        heights, some = (self.spare[index], spare) if use_spare else (self.height[index], own)
        placeholders = self.no_height[index] & ~some
        repairs["altitudes of a placeholder taken as missing"] = int(placeholders.sum())
        if not some.any():
            return None, None
        before = np.maximum.accumulate(np.where(some, np.arange(len(index)), -1))
        row = np.where(before < 0, some.argmax(), before)
        repairs["altitudes taken from geoaltitude"] = int(some.sum()) if use_spare else 0
        repairs["altitudes missing"] = int((~some & ~placeholders).sum())
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

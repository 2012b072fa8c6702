"""C++ of a step: its pieces as functions, and what calls them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import groupby

from torchfra.compiler.access import Access, Step
from torchfra.compiler.frame import crossing, frame
from torchfra.compiler.merges import with_merged
from torchfra.compiler.parts import apart, together
from torchfra.compiler.routines import texts
from torchfra.compiler.schedule import Condition, Piece, cut, guarded_share, pieces
from torchfra.compiler.statements import as_number, as_truth, called, declared, function, indented, statement

_PACKS, _BYTES = 32, 3 << 17
"""Packs of a block at most, and bytes of their values: a part of the second cache."""
_ALWAYS = "V* s, V* aside, V* left, const Port* in, const Port* out, const Block& at"
"""What a function takes that is called for all tracks."""


class Writer:
    """Writes the functions of a step.

    Args:
        step: the step.
        narrow: whether for one track.
        length: expressions of a function, about; None for what suits a CPU.
    """

    def __init__(self, step: Step, narrow: bool, length: int | None = None) -> None:
        self._step, self._book = step, step.book
        live = [i for i in step.live if i not in self._book.values and i not in step.carried]
        self._before = [
            Piece(part, None) for part in cut(self._book, [i for i in live if i not in step.varying], length)
        ]
        ends = [*step.carried.values(), *(i for i, _ in step.stores)]
        steps = pieces(self._book, [i for i in live if i in step.varying], ends, length)
        self._book, self._steps, self._merged = with_merged(self._book, steps)
        self.guarded = guarded_share(self._book, self._steps)
        many = bool(self.guarded) and not narrow
        self._frame = frame(self._book, self._before, self._steps, step.carried, ends, self._merged, many)
        self._unread = max(1, len({*self._frame.left.values()}))
        size = 64 * (self._frame.own + self._unread)
        self._packs = max(1, min(_PACKS, _BYTES // size)) if many else 1
        always = (piece for piece in self._steps if piece.guard is None)
        self._longest = max(always, key=lambda piece: len(piece.numbers), default=None)
        self._next = {} if narrow else self._written_next()
        self._frame.late.update(self._next)
        self._behind = self._writes()

    def texts(self, split: bool = False) -> dict[str, str]:
        """What takes the place of each word of the template; ``split``: functions of a large step are in parts."""
        functions = [self._begin()]
        long = texts(self._book, self._step.live)
        before, calls = ["begin(s[p], left[p], in, at[p]);"], []
        for k, piece in enumerate(self._before):
            head = f"before{k}(V* s, const Port* in, const Block& at)"
            long[head] = self._body(piece)
            before.append(f"before{k}(s[p], in, at[p]);")
        stored: set[int] = {*self._next}
        start, first = 0, list[str]()
        for guard, group in groupby(self._steps, key=lambda piece: piece.guard):
            parts = list(group)
            inside = "V* s" if guard else _ALWAYS
            long |= {f"piece{k}({inside})": self._body(piece, stored) for k, piece in enumerate(parts, start)}
            names = [f"piece{k}" for k in range(start, start + len(parts))]
            calls += self._region(guard, parts, names, functions, first) if guard else []
            start, first = start + len(parts), [] if guard else names
        functions += [self._turn(stored), self._last(), self._end()]
        calls += ["for (int64_t p = 0; p < packs; p++) {", *_always([*first, "turn"]), "}"]
        end = ["if (steps > 0) last(s[p], out, at[p]);", "at[p].step = 0;", "end(s[p], left[p], out, at[p]);"]
        return {
            "SIZE": str(self._frame.own),
            "PASSING": str(max(1, self._frame.size - self._frame.own)),
            "UNREAD": str(self._unread),
            "MANY": str(self._packs),
            "NUMBERS": str(len(self._step.stores)),
            "// PIECES\n": "".join(((apart if split else together)(long), *functions)),
            "    // FIXED\n": indented(before, 4),
            "    // STEP\n": indented(calls, 4),
            "    // END\n": indented(end, 4),
        }

    def _written_next(self) -> dict[int, int]:
        """State that a region completes at the end of a step: by its number, that of the old state of the next step.

        The next step writes it.
        """
        places, steps = self._frame.places, self._steps[self._steps.index(self._longest) :] if self._longest else []
        waiting = {i for piece in steps for i in piece.numbers} & {*self._merged.values()}
        carried = self._step.carried.items()
        return {new: old for old, new in carried if new in waiting and places[old] == places[new]}

    def _writes(self) -> dict[int, list[tuple[int, Access]]]:
        """By the expression behind which it is done: what is written, and where.

        Constants, and state of the step before, are spread over the longest piece, so that memory is never idle.
        """
        behind: dict[int, list[tuple[int, Access]]] = defaultdict(list)
        spread: list[tuple[int, Access]] = []
        for number, access in self._step.stores:
            if number in self._next:
                spread.append((self._next[number], access._replace(step="before")))
            elif number in self._book.values and self._longest:
                spread.append((number, access))
            elif number not in self._merged.values():
                behind[number].append((number, access))
        numbers = self._longest.numbers if self._longest else []
        for k, store in enumerate(spread):
            behind[numbers[len(numbers) * k // len(spread)]].append(store)
        return behind

    def _body(self, piece: Piece, stored: set[int] | None = None) -> list[str]:
        """The lines of a piece's function; ``stored``, if given, grows by what it writes."""
        body: list[str] = []
        late: list[str] = []
        opened: dict[str, str] = {}
        known = set(piece.numbers)
        told = ""
        for number in piece.numbers:
            access = self._step.loads.get(number)
            for arg in self._book.nodes[number][1]:
                if arg not in known and arg not in self._book.values:
                    body.append(self._taken(arg, piece))
                    known.add(arg)
            if access is None:
                origin = self._book.origin[number]
                if origin not in ("", told):
                    body.append(f"// {origin}")
                    told = origin
                body += statement(self._book, number)
            else:
                opened[access.name] = access.opened
                body.append(declared(self._book, number, f"{access.how}({access.name}, {access.entry})"))
            if number in self._frame.places or number in self._frame.left:
                (late if number in self._frame.late else body).append(self._put_aside(number, piece))
            for other, access in self._behind[number] if stored is not None else ():
                opened[access.name] = access.opened
                if other not in known and other not in self._book.values:
                    body.append(self._taken(other, piece))
                    known.add(other)
                body.append(self._written(other, access))
        if stored is not None:
            stored.update(other for number in piece.numbers for other, _ in self._behind[number])
        return [*opened.values(), *body, *late]

    def _taken(self, number: int, piece: Piece | None = None) -> str:
        """The line that takes a value from its place."""
        place = self._place(number, piece)
        return declared(self._book, number, f"truth({place})" if self._book.is_bool(number) else place)

    def _put_aside(self, number: int, piece: Piece) -> str:
        name = called(self._book, number)
        return f"{self._place(number, piece)} = {f'kept({name})' if self._book.is_bool(number) else name};"

    def _place(self, number: int, piece: Piece | None = None) -> str:
        """Where a value is; regions have all places side by side."""
        place, own = self._frame.places.get(number), self._frame.own
        if place is None:
            return f"left[{self._frame.left[number]}]"
        return f"s[{place}]" if place < own or (piece and piece.guard) else f"aside[{place - own}]"

    def _written(self, number: int, access: Access) -> str:
        value = (as_truth if access.how == "mark" else as_number)(self._book, number)
        return f"{access.how}({access.name}, {access.entry}, {value});"

    def _region(
        self, guard: Condition, parts: Sequence[Piece], names: Sequence[str], functions: list[str], first: Sequence[str]
    ) -> list[str]:
        """What calls pieces for the tracks that need them, and before them others for all; adds to the functions."""
        mask, value = guard
        name = names[0].replace("piece", "region")
        functions.append(function(f"{name}(V* s)", [f"{piece}(s);" for piece in names]))
        numbers, own = crossing(self._book, parts, self._steps, self._merged), self._frame.own
        taken, given = ([self._frame.places[i] for i in group] for group in numbers)
        kinds = {"taken": [k for k in taken if k < own], "passed": [k - own for k in taken if k >= own], "given": given}
        values = []
        for kind, places in kinds.items():
            functions.append(f"TABLE {name}_{kind}[] = {{{', '.join(map(str, places or [0]))}}};\n")
            values.append(f"Values{{{name}_{kind}, {len(places)}}}")
        text = f"{self._frame.places[mask]}, {'true' if value else 'false'}, {name}, {', '.join(values)}"
        return [f"guarded(s, aside, packs, {text}, [&](int64_t p) {{", *_always(first), "});"]

    def _begin(self) -> str:
        """The function that reads what is carried."""
        opened = dict.fromkeys(access.opened for access in self._step.first.values())
        reads = [f"{self._place(i)} = get({access.name}, {access.entry});" for i, access in self._step.first.items()]
        return function("begin(V* s, V* left, const Port* in, const Block& at)", [*opened, *reads])

    def _turn(self, stored: set[int]) -> str:
        """The function that ends a step: it writes what no piece has computed, and moves what is carried on."""
        stores = [(i, access) for i, access in self._step.stores if i not in stored]
        opened = dict.fromkeys(access.opened for _, access in stores)
        numbers = dict.fromkeys([*(i for i, _ in stores), *(i for i, _ in self._frame.moves)])
        taken = [self._taken(i) for i in numbers if i not in self._book.values]
        writes = [self._written(i, access) for i, access in stores]
        moves = [f"s[{place}] = {as_number(self._book, i)};" for i, place in self._frame.moves]
        return function(f"turn({_ALWAYS})", [*opened, *taken, *writes, *moves])

    def _last(self) -> str:
        """The function that writes of the last step what the next one would write."""
        stores = [(i, access) for i, access in self._step.stores if i in self._next]
        opened = dict.fromkeys(access.opened for _, access in stores)
        taken = [self._taken(i) for i in dict.fromkeys(i for i, _ in stores)]
        writes = [self._written(i, access) for i, access in stores]
        return function("last(V* s, const Port* out, const Block& at)", [*opened, *taken, *writes])

    def _end(self) -> str:
        """The function that writes what the last step has carried."""
        opened = dict.fromkeys(access.opened for _, access in self._step.end)
        writes = [
            f"put({access.name}, {access.entry}, {self._place(i) if i in self._step.carried else 'all(0)'});"
            for i, access in self._step.end
        ]
        return function("end(V* s, V* left, const Port* out, const Block& at)", [*opened, *writes])


def _always(names: Iterable[str]) -> list[str]:
    return [f"  {name}(s[p], aside, left[last ? p : 0], in, out, at[p]);" for name in names]

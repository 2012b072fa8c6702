"""A step as instructions of LLVM: its pieces as functions, and the loops around them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from torchfra.compiler.elementary_functions import SHARED, applied, shared
from torchfra.compiler.expressions import Expressions, Routine
from torchfra.compiler.gathering import entry, gathered, table
from torchfra.compiler.instructions import Code, Lanes
from torchfra.compiler.plan import Access, Loop, Order, Plan, crossing, needs
from torchfra.compiler.routines import called_by
from torchfra.compiler.schedule import Condition, Piece
from torchfra.compiler.tensor_entries import BLOCK, TensorEntries

_ALWAYS = ("%s", "%aside", "%left", "%in", "%out", "%at")
"""What a function takes that is called for all tracks."""
_BEGIN, _ONCE = ("%s", "%left", "%in", "%at"), ("%s", "%in", "%at")
_LAST, _END = ("%s", "%out", "%at"), ("%s", "%left", "%out", "%at")
"""What those take that are called before and after the loop."""
_OPERATORS = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_COMPARED = {"lt": "olt", "le": "ole", "eq": "oeq"}
_LONG = 20_000
"""Expressions from which on a step calls the function ``SHARED``, where a shorter one has it written out: LLVM then
takes less time, and a step hardly more."""


class Native:
    """Writes the functions of a step.

    Args:
        loop: the step.
        lanes: the tracks of a pack.
        backwards: whether from the last step to the first.
        name: what the names of its functions begin with.
    """

    def __init__(self, loop: Loop, lanes: Lanes, backwards: bool = False, name: str = "") -> None:
        self._loop, self.lanes, self._backwards, self._name = loop, lanes, backwards, name
        self.plan = Plan(loop, lanes.width == 1, tables=True)
        self._book, self._frame = self.plan.book, self.plan.frame
        self.declared: set[str] = set()
        self.texts: list[str] = []
        self.rows: dict[int, int] = {}
        self._is_long = len(loop.live) > _LONG
        self._write()

    @property
    def block(self) -> str:
        """The function of a block of tracks."""
        return f"{self._name}block"

    @property
    def written(self) -> int:
        """Numbers that are written at each step of a track."""
        return len(self._loop.stores)

    def _function(self, name: str, args: Sequence[str], counts: Sequence[str] = ()) -> Code:
        parameters = ", ".join([*(f"ptr noalias {arg}" for arg in args), *(f"i64 {count}" for count in counts)])
        return Code(self.lanes, f"define internal void @{self._name}{name}({parameters})")

    def _ordered(self, name: str, args: Sequence[str], orders: Sequence[Order], guarded: bool = False) -> None:
        """A function that does what a plan says; ``guarded``: in a region."""
        body = _Body(self, self._function(name, args), guarded=guarded)
        body.do(orders)
        self._done(body.code)

    def _done(self, code: Code) -> None:
        if not code.lines or not code.lines[-1].startswith("ret"):
            code.do("ret void")
        self.texts.append(code.text())
        self.declared |= code.declared

    def applied(self, code: Code, op: str, args: Sequence[str]) -> str:
        """The value of a function of numbers: written out, or in a long step called."""
        if op != SHARED or not self._is_long:
            return applied(code, op, args)
        return code.call(code.numbers, f"{self._name}one_{op}", *((code.numbers, arg) for arg in args))

    def _write(self) -> None:
        plan = self.plan
        if self._is_long:
            self._done(shared(self.lanes, f"{self._name}one_{SHARED}"))
        for routine in called_by(self._book, self._loop.live):
            self._routine(routine)
        self._table()
        self._ordered("begin", _BEGIN, plan.begin())
        for k, piece in enumerate(plan.before):
            self._ordered(f"before{k}", _ONCE, plan.once(piece))
        calls: list[tuple[list[str], str | None]] = []
        start, first = 0, list[str]()
        needed = [needs(self._book, piece) for piece in plan.steps]
        for guard, group in groupby(plan.steps, key=lambda piece: piece.guard):
            parts = list(group)
            names = [f"piece{k}" for k in range(start, start + len(parts))]
            for name, piece in zip(names, parts, strict=True):
                self._ordered(name, ("%s",) if guard else _ALWAYS, plan.each(piece), bool(guard))
            if guard:
                others = [*needed[:start], *needed[start + len(parts) :]]
                calls.append((first, self._region(guard, parts, names, start, others)))
            start, first = start + len(parts), [] if guard else names
        calls.append(([*first, "turn"], None))
        self._ordered("turn", _ALWAYS, plan.turn())
        self._ordered("last", _LAST, plan.last())
        self._ordered("end", _END, plan.end())
        self._loops(calls)

    def _table(self) -> None:
        """The places of all calls by a table, one call behind the other, and the function that does such a call."""
        places = list[int]()
        for call, (args, results) in self.plan.tabled.items():
            self.rows[call] = len(places)
            places += [*args, *(k for pair in results for k in pair)]
        if not places:
            return
        self.texts.append(table(f"{self._name}table", places))
        pointers = ("%s", "%aside", "%row", "%routine", "%a", "%r")
        code, own, size = self._function("through", pointers, ("%args", "%results")), self._frame.own, self.lanes.size

        def place(k: str) -> str:
            number = entry(code, "%row", k)
            is_own = code.new(f"icmp slt i64 {number}, {own}")
            start = code.new(f"select i1 {is_own}, ptr %s, ptr %aside")
            before = code.new(f"select i1 {is_own}, i64 0, i64 {own}")
            return code.at(start, code.numbers, code.op("sub", number, before))

        with code.loop("%args") as k:
            value = code.load(code.numbers, place(k), size)
            code.store(code.numbers, value, code.at("%a", code.numbers, k), size)
        code.do("call void %routine(ptr %a, ptr %r)")
        with code.loop("%results") as k:
            at = code.op("add", "%args", code.op("mul", k, 2))
            value = code.load(code.numbers, code.at("%r", code.numbers, entry(code, "%row", at)), size)
            code.store(code.numbers, value, place(code.op("add", at, 1)), size)
        self._done(code)

    def _routine(self, routine: Routine) -> None:
        code = self._function(routine.name, ("%a", "%r"))
        body = _Body(self, code, routine.book)
        for k, i in enumerate(routine.inputs):
            body.known[i] = code.load(code.numbers, code.at("%a", code.numbers, k), self.lanes.size)
        for number in routine.live:
            body.compute(number)
        computed = {*routine.live}
        for k, i in enumerate(routine.outputs):
            if i in computed:
                code.store(code.numbers, body.value(i), code.at("%r", code.numbers, k), self.lanes.size)
        self._done(code)

    def _region(
        self,
        guard: Condition,
        parts: Sequence[Piece],
        names: Sequence[str],
        start: int,
        others: Sequence[Sequence[int]],
    ) -> str:
        """The function that computes pieces for the tracks that need them; returns its name."""
        numbers, own = crossing(self._book, parts, others, self.plan.merged), self._frame.own
        taken, stored = ([self._frame.places[i] for i in group] for group in numbers)
        region = self._function(f"region{start}", ("%s",))
        for name in names:
            region.do(f"call void @{self._name}{name}(ptr %s)")
        self._done(region)
        mask, value = guard
        texts, declared = gathered(
            self.lanes, f"{self._name}{{}}{start}", self._frame.places[mask], value, self._frame.size,
            [k for k in taken if k < own], [k for k in taken if k >= own], stored, own,
        )  # fmt: skip
        self.texts += texts
        self.declared |= declared
        return str(start)

    def _loops(self, calls: Sequence[tuple[Sequence[str], str | None]]) -> None:
        """The function of a block: the loop over time, in it that over the packs of tracks."""
        head = f"define internal void @{self.block}(ptr %in, ptr %out, i64 %steps, i64 %first, i64 %lanes, i8 %past)"
        code, width = Code(self.lanes, head), self.lanes.width
        own, unread, many = self._frame.own, self.plan.unread, self.plan.packs
        passing = max(1, self._frame.size - own)
        s, aside, left = (code.place(code.numbers, n) for n in (many * own, passing, many * unread))
        at = code.place(BLOCK, many)
        if self.plan.many:
            together, state = code.place(code.numbers, own + passing), code.place("i64", 8 + 2 * width)
            memory = f"ptr {together}, ptr {state}, ptr {code.place(code.integers, width)}"
            code.store("i64", "0", state)
            code.store("i64", "0", code.at(state, "i64", 1))
        more = code.op("add", "%lanes", width - 1)
        packs = code.op("sdiv", more, width)

        def of(p: str) -> dict[str, str]:
            """What functions take of a pack."""
            places = code.at(s, f"[{own} x {code.numbers}]", p)
            unread_places = code.at(left, f"[{unread} x {code.numbers}]", p)
            return {
                "%s": places,
                "%left": unread_places,
                "%at": code.at(at, BLOCK, p),
                "%aside": aside,
                "%in": "%in",
                "%out": "%out",
            }

        def call(name: str, args: Sequence[str], arguments: dict[str, str]) -> None:
            code.do(f"call void @{self._name}{name}({', '.join(f'ptr {arguments[arg]}' for arg in args)})")

        with code.loop(packs) as p:
            arguments = of(p)
            done = code.op("mul", p, width)
            rest = code.op("sub", "%lanes", done)
            full = code.new(f"icmp sge i64 {rest}, {width}")
            fields = [
                ("i64", code.op("add", "%first", done)),
                ("i64", code.new(f"select i1 {full}, i64 {width}, i64 {rest}")),
                ("i64", "0"), ("i64", "0"), ("i8", code.new(f"select i1 {full}, i8 %past, i8 0")),
            ]  # fmt: skip
            for number, (type, value) in enumerate(fields):
                code.store(type, value, code.field(BLOCK, arguments["%at"], number))
            call("begin", _BEGIN, arguments)
            for number in range(len(self.plan.before)):
                call(f"before{number}", _ONCE, arguments)
        with code.loop("%steps") as k:
            time = k
            if self._backwards:
                time = code.op("sub", code.op("sub", "%steps", 1), k)
            next_step = code.op("add", k, "1")
            last = code.new(f"icmp eq i64 {next_step}, %steps")
            begun = code.new(f"icmp sgt i64 {k}, 0")
            with code.loop(packs) as p:
                steps = [code.field(BLOCK, at, field, p) for field in (2, 3)]
                old = code.load("i64", steps[0])
                code.store("i64", code.new(f"select i1 {begun}, i64 {old}, i64 {time}"), steps[1])
                code.store("i64", time, steps[0])
            for names, region in calls:
                with code.loop(packs) as p:
                    arguments = of(p)
                    if self.plan.packs > 1:
                        chosen = code.new(f"select i1 {last}, i64 {p}, i64 0")
                        arguments["%left"] = code.at(left, f"[{unread} x {code.numbers}]", chosen)
                    for name in names:
                        call(name, _ALWAYS, arguments)
                    if region is not None:
                        # What a region takes is gathered behind what is computed for all, while that is in the first
                        # cache.
                        together = f", ptr {aside}, {memory}" if self.plan.many else ""
                        code.do(f"call void @{self._name}guarded{region}(ptr {arguments['%s']}{together})")
                if region is not None and self.plan.many:
                    code.do(f"call void @{self._name}flush{region}({memory})")
        some = code.new("icmp sgt i64 %steps, 0")
        with code.loop(packs) as p:
            arguments = of(p)
            with code.where(some):
                call("last", _LAST, arguments)
            code.store("i64", "0", code.field(BLOCK, at, 2, p))
            call("end", _END, arguments)
        self._done(code)


class _Body:
    """The instructions of one function, and the values that it knows."""

    def __init__(self, of: Native, code: Code, book: Expressions | None = None, guarded: bool = False) -> None:
        self._of, self.code, self._book, self._guarded = of, code, book or of.plan.book, guarded
        self._frame = of.plan.frame
        self.known: dict[int, str] = {}
        self._opened: dict[Access, TensorEntries] = {}
        self._called: tuple[str, str] | None = None

    def do(self, orders: Sequence[Order]) -> None:
        """What a plan says."""
        code = self.code
        for what, number, access, place in orders:
            if what == "compute":
                self.compute(number)
            elif what == "call":
                self._through(number)
            elif what == "take":
                value = code.load(code.numbers, self._place(number), code.lanes.size)
                self.known[number] = code.truth(value) if self._book.is_bool(number) else value
            elif access is None:
                value = self._kept(number)
                to = code.at("%s", code.numbers, place) if what == "move" else self._place(number)
                code.store(code.numbers, value, to, code.lanes.size)
            elif what == "read":
                tensor = self._tensor(access)
                self.known[number] = tensor.load(access.entry) if access.packed else tensor.get(access.entry)
            elif access.type == "bool":
                self._tensor(access).mark(access.entry, self.truth(number))
            else:
                self._tensor(access).write(access.entry, self.value(number))

    def value(self, number: int) -> str:
        """An expression where numbers are wanted."""
        known = self.known.get(number)
        return self.code.constant(self._book.values[number]) if known is None else known

    def truth(self, number: int) -> str:
        """An expression where truth values are wanted."""
        constant = self._book.values.get(number)
        return self.known[number] if constant is None else self.code.every("i1", "true" if constant else "false")

    def compute(self, number: int) -> None:
        """An expression that is no constant and no input."""
        self.known[number] = self._computed(number, *self._book.nodes[number])

    def _computed(self, number: int, op: str, args: tuple[int, ...]) -> str:
        book, code = self._book, self.code
        if op == "call":
            return self._call(number, args)
        if op == "result":
            return code.load(
                code.numbers, code.at(self.known[args[0]], code.numbers, book.places[number]), code.lanes.size
            )
        if op == "select":
            kind, type = (self.truth, code.truths) if book.is_bool(number) else (self.value, code.numbers)
            yes, no = (kind(i) for i in args[1:])
            return code.new(f"select {code.truths} {self.truth(args[0])}, {type} {yes}, {type} {no}")
        if op in ("and", "or", "not") or (op == "eq" and any(book.is_bool(i) for i in args)):
            truths = [*map(self.truth, args)]
            if op in ("and", "or"):
                return code.new(f"{op} {code.truths} {truths[0]}, {truths[1]}")
            differ = truths[0] if op == "not" else code.new(f"xor {code.truths} {truths[0]}, {truths[1]}")
            return code.new(f"xor {code.truths} {differ}, {code.every('i1', 'true')}")
        values = [*map(self.value, args)]
        if op in _OPERATORS:
            return code.new(f"{_OPERATORS[op]} contract {code.numbers} {values[0]}, {values[1]}")
        if op in _COMPARED:
            return code.new(f"fcmp {_COMPARED[op]} {code.numbers} {values[0]}, {values[1]}")
        if op == "neg":
            return code.new(f"fneg {code.numbers} {values[0]}")
        return values[0] if op == "same" else self._of.applied(code, op, values)

    def _call(self, number: int, args: Sequence[int]) -> str:
        """Where the results of a call of a routine are."""
        code, routine = self.code, self._book.calls[number]
        arguments = code.place(code.numbers, max(len(args), 1))
        for k, arg in enumerate(args):
            code.store(code.numbers, self.value(arg), code.at(arguments, code.numbers, k), code.lanes.size)
        results = code.place(code.numbers, max(len(routine.outputs), 1))
        code.do(f"call void @{self._of._name}{routine.name}(ptr {arguments}, ptr {results})")
        return results

    def _through(self, number: int) -> None:
        """A call by a table."""
        code, of, tabled = self.code, self._of, self._of.plan.tabled
        if self._called is None:
            most = max(len(args) for args, _ in tabled.values())
            results = max(len(self._book.calls[call].outputs) for call in tabled)
            self._called = code.place(code.numbers, most), code.place(code.numbers, results)
        aside = code.at("%s", code.numbers, self._frame.own) if self._guarded else "%aside"
        row = code.at(f"@{of._name}table", "i16", of.rows[number])
        routine = f"@{of._name}{self._book.calls[number].name}"
        pointers = ", ".join(f"ptr {x}" for x in ("%s", aside, row, routine, *self._called))
        counts = ", ".join(f"i64 {len(x)}" for x in tabled[number])
        code.do(f"call void @{of._name}through({pointers}, {counts})")

    def _kept(self, number: int) -> str:
        """A value as it lies in its place: of a truth value all bits where it holds."""
        if not self._book.is_bool(number):
            return self.value(number)
        code = self.code
        integer = code.new(f"sext {code.truths} {self.truth(number)} to {code.integers}")
        return code.new(f"bitcast {code.integers} {integer} to {code.numbers}")

    def _place(self, number: int) -> str:
        """The place of a value; regions have all places side by side."""
        place, own = self._frame.places.get(number), self._frame.own
        if place is None:
            return self.code.at("%left", self.code.numbers, self._frame.left[number])
        if place < own or self._guarded:
            return self.code.at("%s", self.code.numbers, place)
        return self.code.at("%aside", self.code.numbers, place - own)

    def _tensor(self, access: Access) -> TensorEntries:
        key = access._replace(entry=0)
        if key not in self._opened:
            self._opened[key] = TensorEntries(self.code, access)
        return self._opened[key]

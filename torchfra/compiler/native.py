"""A step as instructions of LLVM: its pieces as functions, the regions that gather tracks, and the loops around them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import groupby

from torchfra.compiler.access import Access, Step
from torchfra.compiler.elementary_functions import applied
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.frame import crossing
from torchfra.compiler.gathering import gathered
from torchfra.compiler.instructions import Code, Lanes, literal, phi
from torchfra.compiler.plan import Plan
from torchfra.compiler.routines import Routine, called_by
from torchfra.compiler.schedule import Condition, Piece

PORT = "{ ptr, i64, i64, i64 }"
"""A tensor: where it is, and how far it is to the next track, the next step, the next entry."""
BLOCK = "{ i64, i64, i64, i64, i8 }"
"""A pack of tracks: the first, how many, the step, the step before it, whether what is written is too much for caches."""
_ALWAYS = ("%s", "%aside", "%left", "%in", "%out", "%at")
"""What a function takes that is called for all tracks."""
_BYTES = {"double": 8, "float": 4, "bool": 1}
_OPERATORS = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}
_COMPARED = {"lt": "olt", "le": "ole", "eq": "oeq"}


class Native:
    """Writes the functions of a step.

    Args:
        step: the step.
        lanes: the tracks of a pack.
        backwards: whether from the last step to the first.
        name: what the names of its functions begin with.
    """

    def __init__(self, step: Step, lanes: Lanes, backwards: bool = False, name: str = "") -> None:
        self._step, self.lanes, self._backwards, self._name = step, lanes, backwards, name
        self.plan = Plan(step, lanes.count == 1)
        self._book, self._frame = self.plan.book, self.plan.frame
        self.declared: set[str] = set()
        self.texts: list[str] = []
        self._write()

    @property
    def block(self) -> str:
        """The function of a block of tracks."""
        return f"{self._name}block"

    def _function(self, name: str, args: Sequence[str], result: str = "void") -> Code:
        given = ", ".join(f"ptr noalias {arg}" for arg in args)
        return Code(self.lanes, f"define internal {result} @{self._name}{name}({given})")

    def _done(self, code: Code) -> None:
        if not code.lines or not code.lines[-1].startswith("ret"):
            code.do("ret void")
        self.texts.append(code.text())
        self.declared |= code.declared

    def _write(self) -> None:
        plan = self.plan
        for routine in called_by(self._book, self._step.live):
            self._routine(routine)
        self._begin()
        for k, piece in enumerate(plan.before):
            body = _Body(self, self._function(f"before{k}", ("%s", "%in", "%at")))
            body.piece(piece, None)
            self._done(body.code)
        stored = {*plan.next}
        calls: list[tuple[list[str], str | None]] = []
        start, first = 0, list[str]()
        for guard, group in groupby(plan.steps, key=lambda piece: piece.guard):
            parts = list(group)
            names = [f"piece{k}" for k in range(start, start + len(parts))]
            for name, piece in zip(names, parts, strict=True):
                body = _Body(self, self._function(name, ("%s",) if guard else _ALWAYS))
                body.piece(piece, stored)
                self._done(body.code)
            if guard:
                calls.append((first, self._region(guard, parts, names, start)))
            start, first = start + len(parts), [] if guard else names
        calls.append(([*first, "turn"], None))
        self._turn(stored)
        self._last()
        self._end()
        self._loops(calls)

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

    def _begin(self) -> None:
        """Reads what is carried."""
        body = _Body(self, self._function("begin", ("%s", "%left", "%in", "%at")))
        for number, access in self._step.first.items():
            body.put_aside(number, body.read(access), None)
        self._done(body.code)

    def _turn(self, stored: set[int]) -> None:
        """Ends a step: writes what no piece has computed, and moves what is carried on."""
        body = _Body(self, self._function("turn", _ALWAYS))
        stores = [(i, access) for i, access in self._step.stores if i not in stored]
        for number in dict.fromkeys([*(i for i, _ in stores), *(i for i, _ in self._frame.moves)]):
            body.take(number)
        for number, access in stores:
            body.written(number, access)
        for number, place in self._frame.moves:
            body.code.store(body.code.numbers, body.kept(number), body.code.at("%s", body.code.numbers, place), self.lanes.size)
        self._done(body.code)

    def _last(self) -> None:
        """Writes of the last step what the next one would write."""
        body = _Body(self, self._function("last", ("%s", "%out", "%at")))
        for number, access in self._step.stores:
            if number in self.plan.next:
                body.take(number)
                body.written(number, access)
        self._done(body.code)

    def _end(self) -> None:
        """Writes what the last step has carried."""
        body = _Body(self, self._function("end", ("%s", "%left", "%out", "%at")))
        for number, access in self._step.end:
            if number in self._step.carried:
                body.take(number, None)
                body.write(access, body.known[number])
            else:
                body.write(access, body.code.constant(0.0))
        self._done(body.code)

    def _region(self, guard: Condition, parts: Sequence[Piece], names: Sequence[str], start: int) -> str:
        """The function that computes pieces for the tracks that need them; returns its name."""
        numbers, own = crossing(self._book, parts, self.plan.steps, self.plan.merged), self._frame.own
        taken, given = ([self._frame.places[i] for i in group] for group in numbers)
        region = self._function(f"region{start}", ("%s",))
        for name in names:
            region.do(f"call void @{self._name}{name}(ptr %s)")
        self._done(region)
        mask, value = guard
        texts, declared = gathered(
            self.lanes, f"{self._name}{{}}{start}", self._frame.places[mask], value, self._frame.size,
            [k for k in taken if k < own], [k for k in taken if k >= own], given, own,
        )  # fmt: skip
        self.texts += texts
        self.declared |= declared
        return str(start)

    def _loops(self, calls: Sequence[tuple[Sequence[str], str | None]]) -> None:
        """The function of a block: the loop over time, in it that over the packs of tracks."""
        head = f"define internal void @{self.block}(ptr %in, ptr %out, i64 %steps, i64 %first, i64 %lanes, i8 %past)"
        code, width = Code(self.lanes, head), self.lanes.count
        own, unread, many = self._frame.own, self.plan.unread, self.plan.packs
        passing = max(1, self._frame.size - own)
        s, aside, left = (code.place(code.numbers, n) for n in (many * own, passing, many * unread))
        at = code.place(BLOCK, many)
        if self.plan.many:
            together, state = code.place(code.numbers, own + passing), code.place("i64", 8 + 2 * width)
            memory = f"ptr {together}, ptr {state}, ptr {code.place(code.wholes, width)}"
            code.store("i64", "0", state)
            code.store("i64", "0", code.at(state, "i64", 1))
        more = code.op("add", "%lanes", width - 1)
        packs = code.op("sdiv", more, width)

        def of(p: str) -> dict[str, str]:
            """What functions take of a pack."""
            places = code.at(s, f"[{own} x {code.numbers}]", p)
            unread_places = code.at(left, f"[{unread} x {code.numbers}]", p)
            return {"%s": places, "%left": unread_places, "%at": code.at(at, BLOCK, p), "%aside": aside, "%in": "%in", "%out": "%out"}

        def call(name: str, args: Sequence[str], given: dict[str, str]) -> None:
            code.do(f"call void @{self._name}{name}({', '.join(f'ptr {given[arg]}' for arg in args)})")

        with code.loop(packs) as p:
            given = of(p)
            done = code.op("mul", p, width)
            rest = code.op("sub", "%lanes", done)
            full = code.new(f"icmp sge i64 {rest}, {width}")
            fields = [
                ("i64", code.op("add", "%first", done)),
                ("i64", code.new(f"select i1 {full}, i64 {width}, i64 {rest}")),
                ("i64", "0"), ("i64", "0"), ("i8", code.new(f"select i1 {full}, i8 %past, i8 0")),
            ]  # fmt: skip
            for k, (type, value) in enumerate(fields):
                code.store(type, value, code.new(f"getelementptr inbounds {BLOCK}, ptr {given['%at']}, i64 0, i32 {k}"))
            call("begin", ("%s", "%left", "%in", "%at"), given)
            for k in range(len(self.plan.before)):
                call(f"before{k}", ("%s", "%in", "%at"), given)
        with code.loop("%steps") as k:
            time = k
            if self._backwards:
                time = code.op("sub", code.op("sub", "%steps", 1), k)
            next_step = code.op("add", k, "1")
            last = code.new(f"icmp eq i64 {next_step}, %steps")
            begun = code.new(f"icmp sgt i64 {k}, 0")
            with code.loop(packs) as p:
                steps = [code.new(f"getelementptr inbounds {BLOCK}, ptr {at}, i64 {p}, i32 {field}") for field in (2, 3)]
                old = code.load("i64", steps[0])
                code.store("i64", code.new(f"select i1 {begun}, i64 {old}, i64 {time}"), steps[1])
                code.store("i64", time, steps[0])
            for names, region in calls:
                if region is None or not self.plan.many:
                    with code.loop(packs) as p:
                        given = of(p)
                        if self.plan.packs > 1:
                            chosen = code.new(f"select i1 {last}, i64 {p}, i64 0")
                            given["%left"] = code.at(left, f"[{unread} x {code.numbers}]", chosen)
                        for name in names:
                            call(name, _ALWAYS, given)
                        if region is not None:
                            code.do(f"call void @{self._name}guarded{region}(ptr {given['%s']})")
                else:
                    # What a region takes is gathered behind what is computed for all, while that is in the first cache.
                    with code.loop(packs) as p:
                        given = of(p)
                        chosen = code.new(f"select i1 {last}, i64 {p}, i64 0")
                        given["%left"] = code.at(left, f"[{unread} x {code.numbers}]", chosen)
                        for name in names:
                            call(name, _ALWAYS, given)
                        code.do(f"call void @{self._name}guarded{region}(ptr {given['%s']}, ptr {aside}, {memory})")
                    code.do(f"call void @{self._name}flush{region}({memory})")
        some = code.new("icmp sgt i64 %steps, 0")
        with code.loop(packs) as p:
            given = of(p)
            with code.where(some):
                call("last", ("%s", "%out", "%at"), given)
            code.store("i64", "0", code.new(f"getelementptr inbounds {BLOCK}, ptr {at}, i64 {p}, i32 2"))
            call("end", ("%s", "%left", "%out", "%at"), given)
        self._done(code)


class _Body:
    """The instructions of one function, and the values that it knows."""

    def __init__(self, of: Native, code: Code, book: Expressions | None = None) -> None:
        self._of, self.code, self._book = of, code, book or of.plan.book
        self._frame = of.plan.frame
        self.known: dict[int, str] = {}
        self._opened: dict[tuple[str, str, str], _Entries] = {}
        self._piece: Piece | None = None

    def piece(self, piece: Piece, stored: set[int] | None) -> None:
        """All of a piece; ``stored``, if given, grows by what it writes."""
        self._piece, step, frame = piece, self._of._step, self._frame
        late: list[int] = []
        values = self._book.values
        for number in piece.numbers:
            access = step.loads.get(number)
            for arg in self._book.nodes[number][1]:
                if arg not in self.known and arg not in values:
                    self.take(arg, piece)
            if access is None:
                self.compute(number)
            else:
                self.known[number] = self.read(access)
            if number in frame.places or number in frame.left:
                if number in frame.late:
                    late.append(number)
                else:
                    self.put_aside(number, self.known[number], piece)
            for other, store in self._of.plan.behind[number] if stored is not None else ():
                if other not in self.known and other not in values:
                    self.take(other, piece)
                self.written(other, store)
        for number in late:
            self.put_aside(number, self.known[number], piece)
        if stored is not None:
            stored.update(other for number in piece.numbers for other, _ in self._of.plan.behind[number])

    def value(self, number: int) -> str:
        """An expression where numbers are wanted."""
        constant = self._book.values.get(number)
        return self.known[number] if constant is None else self.code.constant(constant)

    def truth(self, number: int) -> str:
        """An expression where truth values are wanted."""
        constant = self._book.values.get(number)
        return self.known[number] if constant is None else self.code.every("i1", "true" if constant else "false")

    def compute(self, number: int) -> None:
        """An expression that is no constant and no input."""
        book, code = self._book, self.code
        op, args = book.nodes[number]
        if op == "call":
            self._call(number, args)
        elif op in _OPERATORS:
            a, b = (self.value(i) for i in args)
            self.known[number] = code.new(f"{_OPERATORS[op]} contract {code.numbers} {a}, {b}")
        elif op == "neg":
            self.known[number] = code.new(f"fneg {code.numbers} {self.value(args[0])}")
        elif op == "same":
            self.known[number] = self.value(args[0])
        elif op == "eq" and any(book.is_bool(i) for i in args):
            a, b = (self.truth(i) for i in args)
            differ = code.new(f"xor {code.truths} {a}, {b}")
            self.known[number] = code.new(f"xor {code.truths} {differ}, {code.every('i1', 'true')}")
        elif op in _COMPARED:
            a, b = (self.value(i) for i in args)
            self.known[number] = code.new(f"fcmp {_COMPARED[op]} {code.numbers} {a}, {b}")
        elif op in ("and", "or"):
            a, b = (self.truth(i) for i in args)
            self.known[number] = code.new(f"{op} {code.truths} {a}, {b}")
        elif op == "not":
            self.known[number] = code.new(f"xor {code.truths} {self.truth(args[0])}, {code.every('i1', 'true')}")
        elif op == "select":
            kind, type = (self.truth, code.truths) if book.is_bool(number) else (self.value, code.numbers)
            yes, no = (kind(i) for i in args[1:])
            self.known[number] = code.new(f"select {code.truths} {self.truth(args[0])}, {type} {yes}, {type} {no}")
        elif op == "result":
            where = code.at(self.known[args[0]], code.numbers, book.places[number])
            self.known[number] = code.load(code.numbers, where, code.lanes.size)
        else:
            self.known[number] = applied(code, op, [self.value(i) for i in args])

    def _call(self, number: int, args: Sequence[int]) -> None:
        """A call of a routine; what is known of it then is where its results are."""
        code, routine = self.code, self._book.calls[number]
        given = code.place(code.numbers, max(len(args), 1))
        for k, arg in enumerate(args):
            code.store(code.numbers, self.value(arg), code.at(given, code.numbers, k), code.lanes.size)
        self.known[number] = code.place(code.numbers, max(len(routine.outputs), 1))
        code.do(f"call void @{self._of._name}{routine.name}(ptr {given}, ptr {self.known[number]})")

    def take(self, number: int, piece: Piece | None = None) -> None:
        """Takes a value from its place, unless it is a constant."""
        if number in self._book.values:
            return
        code = self.code
        value = code.load(code.numbers, self._place(number, piece), code.lanes.size)
        self.known[number] = self._truth_of(value) if self._book.is_bool(number) else value

    def put_aside(self, number: int, value: str, piece: Piece | None) -> None:
        """Puts a value into its place."""
        value = self.kept_truth(value) if self._book.is_bool(number) else value
        self.code.store(self.code.numbers, value, self._place(number, piece), self.code.lanes.size)

    def kept(self, number: int) -> str:
        """A value as it lies in its place."""
        return self.kept_truth(self.truth(number)) if self._book.is_bool(number) else self.value(number)

    def kept_truth(self, value: str) -> str:
        """A truth value as numbers: all bits where it holds."""
        code = self.code
        whole = code.new(f"sext {code.truths} {value} to {code.wholes}")
        return code.new(f"bitcast {code.wholes} {whole} to {code.numbers}")

    def _truth_of(self, value: str) -> str:
        return code_of_truth(self.code, value)

    def _place(self, number: int, piece: Piece | None) -> str:
        """Where a value is; regions have all places side by side."""
        place, own = self._frame.places.get(number), self._frame.own
        if place is None:
            return self.code.at("%left", self.code.numbers, self._frame.left[number])
        if place < own or (piece and piece.guard):
            return self.code.at("%s", self.code.numbers, place)
        return self.code.at("%aside", self.code.numbers, place - own)

    def _open(self, access: Access) -> _Entries:
        key = access.port, access.type, access.step
        if key not in self._opened:
            self._opened[key] = _Entries(self.code, access)
        return self._opened[key]

    def read(self, access: Access) -> str:
        """What lies in a tensor."""
        entries = self._open(access)
        return entries.load(access.entry) if access.how == "load" else entries.get(access.entry)

    def written(self, number: int, access: Access) -> None:
        """Writes an expression to a tensor."""
        if access.how == "mark":
            self._open(access).mark(access.entry, self.truth(number))
        else:
            self.write(access, self.value(number))

    def write(self, access: Access, value: str) -> None:
        """Writes numbers to a tensor."""
        self._open(access).write(access.entry, value)


def code_of_truth(code: Code, value: str) -> str:
    """Where a number in a place stands for true."""
    whole = code.new(f"bitcast {code.numbers} {value} to {code.wholes}")
    zero = "0" if code.lanes.count == 1 else "zeroinitializer"
    return code.new(f"icmp ne {code.wholes} {whole}, {zero}")


class _Entries:
    """The entries of a tensor at a step, from the first track of a pack on."""

    def __init__(self, code: Code, access: Access) -> None:
        self._code = code
        self._scalar = code.lanes.scalar if access.type == "Scalar" else access.type
        self._bytes = _BYTES[self._scalar]
        port, number = access.port[:-1].split("[")

        def field(k: int) -> str:
            where = code.new(f"getelementptr inbounds {PORT}, ptr %{port}, i64 {number}, i32 {k}")
            return code.load("i64" if k else "ptr", where)

        def of_block(k: int) -> str:
            where = code.new(f"getelementptr inbounds {BLOCK}, ptr %at, i64 0, i32 {k}")
            return code.load("i8" if k == 4 else "i64", where)

        data, self._track, time, entry = map(field, range(4))
        first, self._lanes, step = of_block(0), of_block(1), of_block(2 if access.step == "step" else 3)
        a, b = code.op("mul", first, self._track), code.op("mul", step, time)
        offset = code.op("mul", code.op("add", a, b), self._bytes)
        self._first = code.at(data, "i8", offset)
        self._step = code.op("mul", entry, self._bytes)
        if port == "out" and code.lanes.count > 1:
            self._some = code.new(f"icmp slt i64 {self._lanes}, {code.lanes.count}")
            bits = code.new(f"trunc i64 {self._lanes} to i32")
            power = code.new(f"shl i32 1, {bits}")
            ones = code.new(f"sub i32 {power}, 1")
            self._mask = code.new(f"trunc i32 {ones} to i{code.lanes.count}")
            address = code.new(f"ptrtoint ptr {self._first} to i64")
            odd = code.op("and", code.op("or", address, self._step), 63)
            is_even = code.new(f"icmp eq i64 {odd}, 0")
            even = code.new(f"zext i1 {is_even} to i8")
            self._past = code.new(f"and i8 {of_block(4)}, {even}")
        elif code.lanes.count > 1:
            self._full = code.new(f"icmp sge i64 {self._lanes}, {code.lanes.count}")

    def _at(self, entry: int) -> str:
        if entry == 0:
            return self._first
        offset = self._step if entry == 1 else self._code.op("mul", self._step, entry)
        return self._code.at(self._first, "i8", offset)

    def get(self, entry: int) -> str:
        """What lies anywhere: the last track stands for those beyond it."""
        code, where = self._code, self._at(entry)
        if code.lanes.count == 1:
            value = code.load(self._scalar, where, self._bytes)
        else:
            value = code.call(
                code.lanes.of(self._scalar), f"get_{self._scalar}", ("ptr", where), ("i64", self._track), ("i64", self._lanes)
            )
        return value if self._scalar == code.lanes.scalar else code.new(f"fptrunc {code.lanes.of('double')} {value} to {code.numbers}")

    def load(self, entry: int) -> str:
        """The same of tracks side by side."""
        code = self._code
        if code.lanes.count == 1:
            return self.get(entry)
        where = self._at(entry)
        few, many, behind = (code.named(word) for word in ("few", "many", "behind"))
        code.do(f"br i1 {self._full}, label %{many}, label %{few}, !prof !0")
        code.start(many)
        whole = code.load(code.numbers, where, self._bytes)
        code.do(f"br label %{behind}")
        code.start(few)
        part = code.call(code.numbers, f"get_{self._scalar}", ("ptr", where), ("i64", self._track), ("i64", self._lanes))
        code.do(f"br label %{behind}")
        code.start(behind)
        return phi(code, code.numbers, [(whole, many), (part, few)])

    def write(self, entry: int, value: str) -> None:
        """Puts numbers there, past the caches if it is said so: such a store does not read the line first."""
        code, where = self._code, self._at(entry)
        if code.lanes.count == 1:
            code.store(code.numbers, value, where, self._bytes)
        elif code.lanes.registers == "avx512":  # no branch in sight, behind which fewer values would stay in registers
            plain = "vmovupd" if code.lanes.bits == 64 else "vmovups"
            text = f"cmpb $$0, $2\\0A\\09je 1f\\0A\\09vmovntdq $1, $0\\0A\\09jmp 2f\\0A1:\\09{plain} $1, $0 {{$3}}\\0A2:"
            wide = code.new(f"zext i{code.lanes.count} {self._mask} to i16") if code.lanes.count < 16 else self._mask
            args = f"ptr elementtype({code.numbers}) {where}, {code.numbers} {value}, i8 {self._past}, i16 {wide}"
            code.do(f'call void asm sideeffect "{text}", "=*m,v,q,^Yk,~{{flags}}"({args})')
        else:
            few, many, past, plain, behind = (code.named(w) for w in ("few", "many", "past", "plain", "behind"))
            code.do(f"br i1 {self._some}, label %{few}, label %{many}, !prof !1")
            code.start(few)
            code.call("void", "put", ("ptr", where), (code.numbers, value), ("i64", self._lanes))
            code.do(f"br label %{behind}")
            code.start(many)
            code.do(f"br i1 {code.new(f'icmp ne i8 {self._past}, 0')}, label %{past}, label %{plain}")
            code.start(past)
            code.do(f"store {code.numbers} {value}, ptr {where}, align {code.lanes.size}, !nontemporal !2")
            code.do(f"br label %{behind}")
            code.start(plain)
            code.store(code.numbers, value, where, self._bytes)
            code.do(f"br label %{behind}")
            code.start(behind)

    def mark(self, entry: int, value: str) -> None:
        """Puts truth values there."""
        code, where = self._code, self._at(entry)
        bytes_ = code.new(f"zext {code.truths} {value} to {code.lanes.of('i8')}")
        if code.lanes.count == 1:
            code.store("i8", bytes_, where, 1)
            return
        type = code.lanes.of("i8")
        mask = code.new(f"bitcast i{code.lanes.count} {self._mask} to {code.truths}")
        code.call("void", f"llvm.masked.store.v{code.lanes.count}i8.p0", (type, bytes_), ("ptr", where), ("i32", "1"), (code.truths, mask))


def common(lanes: Lanes) -> tuple[list[str], set[str]]:
    """Functions that all kernels of such lanes call: their texts, and what they declare."""
    texts, declared = list[str](), set[str]()
    if lanes.count == 1:
        return texts, declared
    for scalar in dict.fromkeys((lanes.scalar, "double")):
        kind = lanes.of(scalar)
        code = Code(lanes, f"define internal {kind} @get_{scalar}(ptr %from, i64 %track, i64 %lanes)")
        same = code.new("icmp eq i64 %track, 0")
        with code.where(same):
            one = code.load(scalar, "%from", _BYTES[scalar])
            code.do(f"ret {kind} {code.spread(scalar, one)}")
            code.start(code.named("unreached"))
        last, value = code.op("sub", "%lanes", "1"), "poison"
        for k in range(lanes.count):
            number = code.call("i64", "llvm.smin.i64", ("i64", str(k)), ("i64", last))
            each = code.load(scalar, code.at("%from", scalar, code.op("mul", number, "%track")), _BYTES[scalar])
            value = code.new(f"insertelement {kind} {value}, {scalar} {each}, i64 {k}")
        code.do(f"ret {kind} {value}")
        texts.append(code.text())
        declared |= code.declared
    code = Code(lanes, f"define internal void @put(ptr %to, {code.numbers} %value, i64 %lanes)")
    memory = code.place(code.numbers)
    code.store(code.numbers, "%value", memory, lanes.size)
    with code.loop("%lanes") as k:
        one = code.load(lanes.scalar, code.at(memory, lanes.scalar, k), lanes.bits // 8)
        code.store(lanes.scalar, one, code.at("%to", lanes.scalar, k), lanes.bits // 8)
    code.do("ret void")
    texts.append(code.text())
    return texts, declared


def shared_out(lanes: Lanes, block: str, packs: int, written: int, most: int) -> tuple[list[str], set[str]]:
    """The function ``run`` of a kernel: blocks of tracks, shared by threads.

    Args:
        lanes: of a pack.
        block: the function of a block.
        packs: of a block at most.
        written: numbers that are written at each step of a track.
        most: bytes written by a call from which on they go past the caches.
    """
    width = lanes.count
    one = Code(lanes, "define internal void @share(ptr %call, i64 %thread)")
    tracks, steps, threads, ins, outs = (
        one.load(type, one.new(f"getelementptr inbounds {CALL}, ptr %call, i64 0, i32 {k}"))
        for k, type in enumerate(("i64", "i64", "i64", "ptr", "ptr"))
    )
    all_packs = one.op("sdiv", one.op("add", tracks, width - 1), width)
    share = one.op("mul", threads, packs)
    more = one.op("sub", one.op("add", all_packs, share), 1)
    each = one.op("sdiv", more, share)
    blocks = one.op("mul", each, threads)
    size = one.op("mul", one.op("mul", tracks, steps), written * lanes.bits // 8)
    is_past = one.new(f"icmp sge i64 {size}, {most}")
    past = one.new(f"zext i1 {is_past} to i8")
    start = one.op("mul", each, "%thread")
    with one.loop(one.op("add", start, each), start) as k:
        def edge(number: str) -> str:
            return one.op("mul", one.op("sdiv", one.op("mul", all_packs, number), blocks), width)

        first, behind = edge(k), edge(one.op("add", k, "1"))
        last = one.call("i64", "llvm.smin.i64", ("i64", behind), ("i64", tracks))
        with one.where(one.new(f"icmp slt i64 {first}, {last}")):
            count = one.op("sub", last, first)
            one.do(f"call void @{block}(ptr {ins}, ptr {outs}, i64 {steps}, i64 {first}, i64 {count}, i8 {past})")
    if lanes.registers:
        one.call("void", "llvm.x86.sse.sfence")  # all is there before the threads meet
    one.do("ret void")
    run = Code(lanes, "define void @run(i64 %tracks, i64 %steps, i32 %threads, ptr %in, ptr %out)", "nounwind")
    with run.where(run.new("icmp eq i64 %tracks, 0")):
        run.do("ret void")
        run.start(run.named("unreached"))
    call, count = run.place(CALL), run.new("sext i32 %threads to i64")
    for k, (type, value) in enumerate((("i64", "%tracks"), ("i64", "%steps"), ("i64", count), ("ptr", "%in"), ("ptr", "%out"))):
        run.store(type, value, run.new(f"getelementptr inbounds {CALL}, ptr {call}, i64 0, i32 {k}"))
    on_threads(run, call, "%threads", "share")
    run.do("ret void")
    return [one.text(), *taken("share"), run.text()], one.declared | run.declared


CALL = "{ i64, i64, i64, ptr, ptr, i64 }"
"""Tracks, steps, threads, ports that are read and written, and how many shares have been taken."""


def on_threads(code: Code, call: str, threads: str, share: str) -> None:
    """Calls a function for the number of each thread, on as many threads."""
    alone = code.new(f"icmp eq i32 {threads}, 1")
    one, several, behind = (code.named(word) for word in ("one", "several", "behind"))
    code.do(f"br i1 {alone}, label %{one}, label %{several}")
    code.start(one)
    code.do(f"call void @{share}(ptr {call}, i64 0)")
    code.do(f"br label %{behind}")
    code.start(several)
    code.store("i64", "0", code.new(f"getelementptr inbounds {CALL}, ptr {call}, i64 0, i32 5"))
    code.call("void", "GOMP_parallel", ("ptr", f"@{share}_taken"), ("ptr", call), ("i32", threads), ("i32", "0"))
    code.do(f"br label %{behind}")
    code.start(behind)


def taken(share: str) -> list[str]:
    """What each thread does: it takes the next share until there is none."""
    return [
        f"""define internal void @{share}_taken(ptr %call) nounwind {{
entry:
  %counter = getelementptr inbounds {CALL}, ptr %call, i64 0, i32 5
  %all = getelementptr inbounds {CALL}, ptr %call, i64 0, i32 2
  %threads = load i64, ptr %all
  br label %next
next:
  %number = atomicrmw add ptr %counter, i64 1 monotonic
  %more = icmp slt i64 %number, %threads
  br i1 %more, label %share, label %done
share:
  call void @{share}(ptr %call, i64 %number)
  br label %next
done:
  ret void
}}
"""
    ]


def module(texts: Iterable[str], declared: Iterable[str]) -> str:
    """A module of these functions."""
    tail = "!0 = !{!\"branch_weights\", i32 2000, i32 1}\n!1 = !{!\"branch_weights\", i32 1, i32 2000}\n!2 = !{i32 1}\n"
    made = "\n".join(texts)
    defined = {line.split("@", 1)[1].split("(", 1)[0] for line in made.splitlines() if line.startswith("define")}
    needed = sorted(line for line in declared if line.split("@")[1].split("(")[0] not in defined)
    return "\n".join([*needed, made, tail])


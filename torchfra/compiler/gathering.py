"""Regions in instructions: what only some tracks need, computed for those of several packs together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from torchfra.compiler.instructions import Code, Lanes


def gathered(
    lanes: Lanes, name: str, place: int, value: bool, size: int, taken: Sequence[int], passed: Sequence[int],
    stored: Sequence[int], own: int,
) -> tuple[list[str], set[str]]:  # fmt: skip
    """The functions ``guarded`` and ``flush`` of a region, and what they declare.

    ``guarded`` takes the tracks of a pack that need the region to those of other packs; where they fill the lanes, and
    in the end, ``flush`` computes it, and takes the results back.

    Args:
        lanes: of a pack.
        name: of functions: ``{}`` stands for what they do.
        place: of the truth value that says which tracks need it.
        value: for which of its values they do.
        size: places of the region.
        taken: places that it takes from a pack's own.
        passed: those from what packs have together.
        stored: those that it stores.
        own: how many places are a pack's own; the others are behind them.
    """
    if lanes.width == 1:
        code = Code(lanes, f"define internal void @{name.format('guarded')}(ptr %s)")
        with code.where(code.truth(code.load(code.numbers, code.at("%s", code.numbers, place)), value)):
            code.do(f"call void @{name.format('region')}(ptr %s)")
        code.do("ret void")
        return [code.text()], code.declared
    tables = {kind: f"{name.format(kind)}" for kind in ("taken", "passed", "stored")}
    texts = [
        table(tables["taken"], taken),
        table(tables["passed"], [k - own for k in passed]),
        table(tables["stored"], stored),
    ]
    guarded = _guarded(lanes, name, place, value, tables, len(taken), len(passed), own)
    flush = _flush(lanes, name, tables["stored"], len(stored))
    return [*texts, guarded.text(), flush.text()], guarded.declared | flush.declared


def table(name: str, places: Sequence[int]) -> str:
    """Places as a table of a module."""
    numbers = ", ".join(f"i16 {k}" for k in places or [0])
    return f"@{name} = internal constant [{len(places or [0])} x i16] [{numbers}]\n"


def _state(code: Code) -> tuple[str, str]:
    """Where the count of lanes that wait is, and that of their packs."""
    return "%state", code.at("%state", "i64", 1)


def _packs(code: Code, number: str) -> tuple[str, str, str]:
    """Three addresses of a waiting pack: of the pointer to its places, its lanes, and their places in the region."""
    width = code.lanes.width
    pointers, lanes = code.at("%state", "i64", 8), code.at("%state", "i64", 8 + width)
    return code.at(pointers, "ptr", number), code.at(lanes, "i64", number), code.at("%places", code.integers, number)


def _moved(code: Code, kind: str) -> Callable[[str, str], str]:
    """What gives in each lane what is in that lane of another value at that number."""
    lanes = code.lanes
    name = {("avx512", 64): "llvm.x86.avx512.permvar.df.512", ("avx512", 32): "llvm.x86.avx512.permvar.sf.512"}.get(
        (lanes.registers, lanes.bits)
    )

    def moved(value: str, index: str) -> str:
        if name:
            return code.call(code.numbers, name, (code.numbers, value), (code.integers, index))
        if lanes.registers == "avx2":
            if lanes.bits == 32:
                return code.call("<8 x float>", "llvm.x86.avx2.permps", ("<8 x float>", value), ("<8 x i32>", index))
            low = code.new(f"shl <4 x i64> {index}, splat (i64 1)")
            high = code.new(f"shl <4 x i64> {code.new(f'or <4 x i64> {low}, splat (i64 1)')}, splat (i64 32)")
            halves = code.new(f"bitcast <4 x i64> {code.new(f'or <4 x i64> {low}, {high}')} to <8 x i32>")
            floats = code.new(f"bitcast <4 x double> {value} to <8 x float>")
            found = code.call("<8 x float>", "llvm.x86.avx2.permps", ("<8 x float>", floats), ("<8 x i32>", halves))
            return code.new(f"bitcast <8 x float> {found} to <4 x double>")
        result = "poison"
        for k in range(lanes.width):
            which = code.new(f"extractelement {code.integers} {index}, i64 {k}")
            inside = code.new(f"and i{lanes.bits} {which}, {lanes.width - 1}")
            one = code.new(f"extractelement {code.numbers} {value}, i{lanes.bits} {inside}")
            result = code.new(f"insertelement {code.numbers} {result}, {lanes.scalar} {one}, i64 {k}")
        return result

    return moved


def _flush(lanes: Lanes, name: str, table: str, count: int) -> Code:
    code = Code(lanes, f"define internal void @{name.format('flush')}(ptr %together, ptr %state, ptr %places)")
    waiting, sources = _state(code)
    some = code.new(f"icmp sgt i64 {code.load('i64', waiting)}, 0")
    moved, bits = _moved(code, "f"), f"i{lanes.width}"
    with code.where(some):
        code.do(f"call void @{name.format('region')}(ptr %together)")
        with code.loop(code.load("i64", sources)) as x:
            pointer, which, places = _packs(code, x)
            to, index = code.load("ptr", pointer), code.load(code.integers, places, lanes.size)
            lanes_given = code.new(f"trunc i64 {code.load('i64', which)} to {bits}")
            mask = code.new(f"bitcast {bits} {lanes_given} to {code.truths}")
            with code.loop(count) as i:
                place = entry(code, f"@{table}", i)
                new = moved(code.load(code.numbers, code.at("%together", code.numbers, place), lanes.size), index)
                where = code.at(to, code.numbers, place)
                old = code.load(code.numbers, where, lanes.size)
                chosen = code.new(f"select {code.truths} {mask}, {code.numbers} {new}, {code.numbers} {old}")
                code.store(code.numbers, chosen, where, lanes.size)
        code.store("i64", "0", waiting)
        code.store("i64", "0", sources)
    code.do("ret void")
    return code


def entry(code: Code, table: str, number: str) -> str:
    """The place at a number of a table."""
    return code.new(f"zext i16 {code.load('i16', code.at(table, 'i16', number), 2)} to i64")


def _guarded(
    lanes: Lanes, name: str, place: int, value: bool, tables: dict[str, str], taken: int, passed: int, own: int
) -> Code:
    code = Code(
        lanes,
        f"define internal void @{name.format('guarded')}(ptr %s, ptr %aside, ptr %together, ptr %state, ptr %places)",
    )
    width, bits = lanes.width, f"i{lanes.width}"
    moved = _moved(code, "f")
    count_at, sources_at = _state(code)
    buffer = code.place(code.integers)
    waits = code.truth(code.load(code.numbers, code.at("%s", code.numbers, place), lanes.size), value)
    first = code.which(waits)
    before = code.block
    code.do("br label %again")
    code.start("again")
    code.do(f"%waiting = phi {bits} [ {first}, %{before} ], [ %rest, %next ]")
    code.do(f"%some = icmp ne {bits} %waiting, 0")
    code.do("br i1 %some, label %inside, label %done")
    code.start("inside")
    count = code.load("i64", count_at)
    mask = code.new(f"bitcast {bits} %waiting to {code.truths}")
    # The numbers of the lanes that wait, side by side; and in each of these how many come before it.
    first_waiting = code.call(bits, f"llvm.cttz.{bits}", (bits, "%waiting"), ("i1", "true"))
    each = code.new(f"zext {bits} {first_waiting} to i{lanes.bits}")
    code.store(code.integers, code.spread(f"i{lanes.bits}", each), buffer, lanes.size)
    kind, type = f"v{width}i{lanes.bits}", code.integers
    code.call("void", f"llvm.masked.compressstore.{kind}.p0", (type, code.lane), ("ptr", buffer), (code.truths, mask))
    packed = code.new(f"bitcast {type} {code.load(type, buffer, lanes.size)} to {code.numbers}")
    code.store(type, code.lane, buffer, lanes.size)
    rank = code.call(
        type, f"llvm.masked.expandload.{kind}.p0", ("ptr", buffer), (code.truths, mask), (type, "zeroinitializer")
    )
    narrow = count if lanes.bits == 64 else code.new(f"trunc i64 {count} to i32")
    counts = code.spread(f"i{lanes.bits}", narrow)
    room = code.new(f"sub {type} {code.every(f'i{lanes.bits}', str(width))}, {counts}")
    fits = code.new(f"icmp slt {type} {rank}, {room}")
    now = code.new(f"and {bits} {code.which(fits)}, %waiting")
    free = code.new(f"icmp sge {type} {code.lane}, {counts}")
    index = code.new(f"sub {type} {code.lane}, {counts}")
    places = code.new(f"bitcast {code.numbers} {moved(packed, index)} to {type}")

    def gather(table: str, number: int, values: str, to: str) -> None:
        with code.loop(number) as i:
            k = entry(code, f"@{table}", i)
            new = moved(code.load(code.numbers, code.at(values, code.numbers, k), lanes.size), places)
            where = code.at(to, code.numbers, k)
            old = code.load(code.numbers, where, lanes.size)
            chosen = code.new(f"select {code.truths} {free}, {code.numbers} {new}, {code.numbers} {old}")
            code.store(code.numbers, chosen, where, lanes.size)

    gather(tables["taken"], taken, "%s", "%together")
    if passed:
        gather(tables["passed"], passed, "%aside", code.at("%together", code.numbers, own))
    sources = code.load("i64", sources_at)
    pointer, which, at = _packs(code, sources)
    code.store("ptr", "%s", pointer)
    code.store("i64", code.new(f"zext {bits} {now} to i64"), which)
    code.store(type, code.new(f"add {type} {rank}, {counts}"), at, lanes.size)
    code.store("i64", code.op("add", sources, "1"), sources_at)
    took = code.call(bits, f"llvm.ctpop.{bits}", (bits, now))
    after = code.op("add", count, code.new(f"zext {bits} {took} to i64"))
    code.store("i64", after, count_at)
    left = code.new(f"xor {bits} {now}, -1")
    code.do(f"%rest = and {bits} %waiting, {left}")
    with code.where(code.new(f"icmp eq i64 {after}, {width}")):
        code.do(f"call void @{name.format('flush')}(ptr %together, ptr %state, ptr %places)")
    code.do("br label %next")
    code.start("next")
    code.do("br label %again")
    code.start("done")
    code.do("ret void")
    return code

"""Whole tracks in instructions: the first state from a prior, all steps, and what the last one has left open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torchfra.compiler.instructions import Code, Lanes, literal
from torchfra.compiler.native import Native
from torchfra.compiler.sharing import called, fields, module, on_threads, taken
from torchfra.compiler.tensor_entries import PORT, functions


class Checked(NamedTuple):
    """A tensor that says whether all is finite.

    Args:
        port: its number.
        late: whether it is written a step late.
        entries: how many it has.
        always: whether at each step, or at the last alone.
    """

    port: int
    late: bool
    entries: int
    always: bool


class Places(NamedTuple):
    """Where the tensors of whole tracks lie.

    Args:
        states: ports of states, which lie in one room, so many bytes from its start as their ports say.
        arguments: ports whose addresses come with a call.
        late: ports of what the last step leaves open, with the bytes of an entry.
        checks: tensors that say whether all is finite.
        each: whole numbers that are the same for all tracks; they come last.
        after: the first port that the steps write.
        last: the first of those of what comes a step late.
        ports: how many there are.
    """

    states: list[int]
    arguments: list[int]
    late: list[tuple[int, int]]
    checks: list[Checked]
    each: Sequence[int]
    after: int
    last: int
    ports: int


def track_module(lanes: Lanes, begin: Native, finish: Native, at: Places) -> str:
    """The module whose function ``filter_tracks`` filters whole tracks; it returns whether the end of each is finite.

    It takes the kernel of the steps, how many tracks, steps and threads, the ports of the kernel, the prior, the last
    entries of what comes a step late and integers; their addresses, but those of states, and the room of these; and how
    many tracks begin differently.
    """
    begun, finished = _begun(lanes, begin), _finished(lanes, finish, at)
    run = _run(lanes, at)
    common, declared = functions(lanes)
    texts = [
        *common,
        *begin.texts,
        *finish.texts,
        begun.text(),
        taken("begun"),
        finished.text(),
        taken("finished"),
        run.text(),
    ]
    return module(
        texts, declared | begin.declared | finish.declared | begun.declared | finished.declared | run.declared
    )


def _run(lanes: Lanes, at: Places) -> Code:
    head = "ptr %run, i64 %tracks, i64 %steps, i32 %threads, ptr %like, ptr %places, ptr %room, i64 %begun"
    code = Code(lanes, f"define i32 @filter_tracks({head})", "nounwind")
    ports, sound = code.place(PORT, at.ports), code.place("i32")
    for k in range(at.ports):
        for field, type in enumerate(("ptr", "i64", "i64", "i64")):
            code.store(type, code.load(type, code.field(PORT, "%like", field, k)), code.field(PORT, ports, field, k))
    for k, port in enumerate(at.arguments):
        code.store("ptr", code.load("ptr", code.at("%places", "ptr", k)), code.field(PORT, ports, 0, port))
    for port in at.states:
        data = code.field(PORT, ports, 0, port)
        code.store("ptr", code.at("%room", "i8", code.load("i64", data)), data)
    for k, (port, size) in enumerate(at.late, at.last):
        first, time = (
            code.load("ptr", code.field(PORT, ports, 0, port)),
            code.load("i64", code.field(PORT, ports, 2, port)),
        )
        behind = code.op("mul", code.op("mul", "%steps", time), size)
        code.store("ptr", code.at(first, "i8", behind), code.field(PORT, ports, 0, k))
    for k, number in enumerate(at.each, at.last + len(at.late)):
        to = code.load("ptr", code.field(PORT, ports, 0, k))
        with code.loop("%tracks") as track:
            code.store("i64", str(number), code.at(to, "i64", track))
    threads = code.new("sext i32 %threads to i64")
    rest = ("i64", "%steps"), ("i64", threads), ("ptr", ports), ("ptr", sound)
    on_threads(code, called(code, (("i64", "%begun"), *rest)), "%threads", "begun")
    code.do(f"call void %run(i64 %tracks, i64 %steps, i32 %threads, ptr {ports}, ptr {code.at(ports, PORT, at.after)})")
    code.store("i32", "1", sound, 4)
    on_threads(code, called(code, (("i64", "%tracks"), *rest)), "%threads", "finished")
    code.do(f"ret i32 {code.load('i32', sound, 4)}")
    return code


def _blocks(code: Code, of: Native, tracks: str, threads: str) -> tuple[str, str, int]:
    """The first track of a thread's share, the one behind it, and how many make a block."""
    width = code.lanes.width
    packs = code.op("sdiv", code.op("add", tracks, width - 1), width)

    def edge(thread: str) -> str:
        return code.op("mul", code.op("sdiv", code.op("mul", packs, thread), threads), width)

    last = code.call("i64", "llvm.smin.i64", ("i64", edge(code.op("add", "%thread", 1))), ("i64", tracks))
    return edge("%thread"), last, width * of.plan.packs


def _block(code: Code, of: Native, first: str, last: str, size: int, ports: str) -> str:
    """Calls the function of a block; returns how many tracks it has."""
    count = code.call("i64", "llvm.smin.i64", ("i64", code.op("sub", last, first)), ("i64", str(size)))
    code.do(f"call void @{of.block}(ptr {ports}, ptr {ports}, i64 1, i64 {first}, i64 {count}, i8 0)")
    return count


def _begun(lanes: Lanes, begin: Native) -> Code:
    code = Code(lanes, "define internal void @begun(ptr %call, i64 %thread)")
    tracks, _, threads, ports, _ = fields(code)
    first, last, size = _blocks(code, begin, tracks, threads)
    with code.loop(last, first, size) as k:
        _block(code, begin, k, last, size, ports)
    code.do("ret void")
    return code


def _finished(lanes: Lanes, finish: Native, at: Places) -> Code:
    """Not finite at a step is not finite in the next one's score: all scores and the last belief say it all."""
    code = Code(lanes, "define internal void @finished(ptr %call, i64 %thread)")
    tracks, steps, threads, ports, sound = fields(code)
    first, last, size = _blocks(code, finish, tracks, threads)
    sums, rest = code.place(code.numbers), code.place(lanes.scalar)
    zero = literal(0.0, lanes.bits)
    code.store(code.numbers, code.constant(0.0), sums, lanes.size)
    code.store(lanes.scalar, zero, rest)
    width, bytes_ = lanes.width, lanes.bits // 8
    final = code.op("sub", steps, 1)
    with code.loop(last, first, size) as k:
        count = _block(code, finish, k, last, size, ports)
        full = code.op("mul", code.op("sdiv", count, width), width)
        for check in at.checks:
            data, _, time, entry = (
                code.load("i64" if f else "ptr", code.field(PORT, ports, f, check.port)) for f in range(4)
            )
            with code.loop(steps, "0" if check.always else final) as step, code.loop(check.entries) as number:
                row = code.op("mul", code.op("add", step, int(check.late)), time)
                place = code.op("add", code.op("add", row, code.op("mul", number, entry)), k)
                start = code.at(data, lanes.scalar, place)
                with code.loop(full, 0, width) as track:
                    here = code.load(code.numbers, code.at(start, lanes.scalar, track), bytes_)
                    total = code.load(code.numbers, sums, lanes.size)
                    code.store(code.numbers, code.new(f"fadd {code.numbers} {total}, {here}"), sums, lanes.size)
                with code.loop(count, full) as track:
                    one = code.load(lanes.scalar, code.at(start, lanes.scalar, track), bytes_)
                    total = code.load(lanes.scalar, rest)
                    code.store(lanes.scalar, code.new(f"fadd {lanes.scalar} {total}, {one}"), rest)
    total = code.load(lanes.scalar, rest)
    for lane in range(width):
        one = code.load(lanes.scalar, code.at(sums, lanes.scalar, lane), bytes_)
        total = code.new(f"fadd {lanes.scalar} {total}, {one}")
    nothing = code.new(f"fsub {lanes.scalar} {total}, {total}")
    with code.where(code.new(f"fcmp une {lanes.scalar} {nothing}, {zero}")):
        code.do(f"store atomic i32 0, ptr {sound} monotonic, align 4")
    code.do("ret void")
    return code

"""Whole tracks of one form in one call, from a prior to all that a filter returns.

``TrackKernel`` fills a table of ports, which the function ``filter_tracks``, written below, hands to the kernels of the
first state, of all steps, and of what the last step has left open.
"""

from __future__ import annotations

import ctypes
import itertools
import threading
from array import array
from collections.abc import Callable, Sequence
from struct import Struct
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.compiler import jit
from torchfra.compiler.boundary import Boundary
from torchfra.compiler.instructions import Code, Lanes, literal
from torchfra.compiler.llvm import lanes_of
from torchfra.compiler.native import Native
from torchfra.compiler.pages import maker
from torchfra.compiler.program import Ready, Strided, strided, threads
from torchfra.compiler.sharing import called, fields, module, on_threads, taken
from torchfra.compiler.source import Port, Scan
from torchfra.compiler.tensor_entries import PORT, functions
from torchfra.linalg.batches import broadcast_shapes
from torchfra.tree import flatten
from torchfra.types import Cause, Estimate


class TrackKernel:
    """A kernel and what comes before and after its steps, of which nothing but addresses differs from call to call.

    Args:
        ready: the steps.
        boundary: what comes before and after them.
        function: of these, as compiled by ``load``.
        prior: mean and root, of all tracks or of one that stands for all.
        rank: batch dimensions of what is written.
        remembers: whether ``states``, the first and the last, are kept for a gradient pass.
    """

    made: Estimate
    """The tree that is made."""
    after: list[int]
    """Where leaves of the state after the last step begin, in bytes of the memory of states."""

    def __init__(
        self, ready: Ready, boundary: Boundary, function: Callable[..., int], prior: Sequence[Strided], rank: int,
        remembers: bool = False,
    ) -> None:  # fmt: skip
        self._ready, self._function, self._rank = ready, function, rank
        self.made, self.places = boundary.made, boundary.places
        self._run = ctypes.cast(ready.run, ctypes.c_void_p).value
        count, reads = len(boundary.sizes), len(ready.table) // 4 - len(ready.like)
        like, late = ready.like[count:], [port - reads - count for port in boundary.late]
        differ = [*(track for _, track, _, _ in prior), *(ready.table[4 * row + 1] for row in boundary.values)]
        self._begun = ready.tracks if any(differ) else 1
        self._table, end = ready.table[:], 0
        for first, tracks in ((0, self._begun), (reads, ready.tracks)):
            for row, size in enumerate(boundary.sizes, first):
                self._table[4 * row : 4 * row + 4] = array("q", [end, int(tracks > 1), 0, tracks])
                end += size * tracks * like[0].element_size()
        for row, same in enumerate(boundary.same):  # what is the same at first lies in one place
            self._table[4 * row] = self._table[4 * same]
        self.after = list(self._table[4 * reads : 4 * (reads + count) : 4])
        self._table.extend(number for _, *strides in prior for number in (0, *strides))
        for port in boundary.late:
            self._table.extend([0, 1, 0, ready.table[4 * port + 3]])
        self._table.extend([0, 1, 0, ready.tracks] * len(_SOUND))
        if ready.steps == 1:  # no step is before it: the end of what comes late overwrites that
            for k in late:
                like[k], self._table[4 * (reads + count + k) + 2] = like[k].narrow(rank, 0, 1), 0
        self._late = late if ready.steps > 1 else []
        records = enumerate(flatten(boundary.step.record))
        self._counts = [(k, x.dtype) for k, x in records if not (x.is_floating_point() or x.dtype == torch.bool)]
        each = torch.empty(like[0].shape[:rank], dtype=torch.int64, device="meta")
        self._new = maker([*like, *[each] * len(_SOUND)], ready.device)
        self._room, self._remembers = end, remembers
        self._addresses = Struct(f"{2 + reads - count + len(like) + len(_SOUND)}q").pack

    def __call__(self, tensors: Sequence[Tensor]) -> tuple[list[Tensor], bool]:
        """What is written, new, with the batch in front; and whether what ends each track is finite.

        Of that the tensors of what is made are at ``places``, and numbers that are the same for all tracks at the end.

        Args:
            tensors: the prior's, and what the steps read besides the state.
        """
        return self.run(tensors)[:2]

    def run(self, tensors: Sequence[Tensor]) -> tuple[list[Tensor], bool, Tensor]:
        """The same with the memory where the first and the last state lie."""
        ready, written, room = self._ready, self._new(), _room(self._room, self._remembers)
        addresses = self._addresses(*map(Tensor.data_ptr, (*tensors, *written)))
        count, (ports, _) = threads(ready.tracks), self._table.buffer_info()
        sound = self._function(
            self._run, ready.tracks, ready.steps, count, ports, addresses, room.data_ptr(), self._begun
        )
        for k in self._late:
            written[k] = written[k].narrow(self._rank, 1, ready.steps)
        for k, dtype in self._counts:
            written[k] = written[k].to(dtype)
        return written, bool(sound), room


_ROOMS = threading.local()
"""Where states lie between the kernels of a call; each thread has its own, as large as it has needed."""
_HELD = 1 << 20
"""Bytes at most that are held from call to call."""


def _room(size: int, new: bool) -> Tensor:
    """Memory of so many bytes; of the caller alone if it is to be ``new``."""
    if size > _HELD or new:
        return torch.empty(size, dtype=torch.uint8, device="cpu")
    if size > getattr(_ROOMS, "size", -1):
        _ROOMS.memory, _ROOMS.size = torch.empty(size, dtype=torch.uint8, device="cpu"), size
    room: Tensor = _ROOMS.memory
    return room


def track_kernel(
    ready: Ready, boundary: Boundary, function: Callable[..., int], batch: torch.Size, prior: Sequence[Tensor],
    remembers: bool,
) -> TrackKernel | None:  # fmt: skip
    """Whole tracks of this batch from priors that lie in memory like this; None if one must be copied."""
    shared = broadcast_shapes(prior[0].shape[:-1], prior[1].shape[:-2])
    shared = shared if shared.numel() == 1 else batch
    ports = [Port([0] * x.shape[-1] ** event, x.shape[-event:]) for event, x in enumerate(prior, 1)]
    full = [x.expand(shared + port.shape) for x, port in zip(prior, ports, strict=True)]
    places = [strided(x, port, len(shared), shared.numel()) for x, port in zip(full, ports, strict=True)]
    if any(x.data_ptr() != y.data_ptr() for (x, *_), y in zip(places, prior, strict=True)):
        return None
    return TrackKernel(ready, boundary, function, places, len(batch), remembers)


_CHECKED = 3, 0, 1
"""Numbers of the tensors that say whether all is finite: the scores of all steps, others of the last."""
_SOUND = -1, int(Cause.NONE)
"""Step and cause of the failure of a track that has none."""


def load(boundary: Boundary, remembered: int = 0) -> Any:
    """The function ``filter_tracks`` of a boundary, compiled.

    Args:
        boundary: what comes before and after the steps.
        remembered: how many more tensors the steps write behind their records.

    Raises:
        CompileError: see ``jit.load``.
    """
    step, states = boundary.step, len(boundary.sizes)
    nothing: list[list[int]] = [[]]
    double = [*[False] * states, *(x.double for x in step.inputs.values())]
    reads = [
        _port(ids, double=any(double[k : k + 1]))
        for k, ids in enumerate([*boundary.reads, *nothing * remembered, *boundary.prior])
    ]
    after = states + len(step.inputs)
    first = after + states
    last = [_port(ids, truth=truth) for ids, truth in boundary.late.values()]
    begin = Scan(boundary.book, [], [], reads, list(map(_port, boundary.begun)), dtype=step.dtype)
    finish = Scan(boundary.book, [], [], reads, [*[_port([])] * len(reads), *last], dtype=step.dtype)
    made, prior, end = flatten(boundary.made), len(reads) - 2, len(reads) + len(last)
    ends = (prior, len(reads)), (states, after), (first, prior), (end, end + len(_SOUND))
    arguments = itertools.chain(*(range(*pair) for pair in ends))
    lanes = lanes_of(step.dtype)
    places = Places(
        [*range(states), *range(after, first)],
        list(arguments),
        [(port, 1 if late.truth else step.dtype.itemsize) for port, late in zip(boundary.late, last, strict=True)],
        [
            Checked(port, port in boundary.late, made[k].numel() // 2, always=k == _CHECKED[0])
            for k in _CHECKED
            for port in [first + boundary.places[k]]
        ],
        after, len(reads), end + len(_SOUND),
    )  # fmt: skip
    return jit.load_tracks(track_module(lanes, begin.native(lanes, "begin_"), finish.native(lanes, "finish_"), places))


def _port(ids: list[int], truth: bool = False, double: bool = False) -> Port:
    return Port(ids, torch.Size([len(ids)]), truth=truth, double=double)


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
        after: the first port that the steps write.
        last: the first of those of what comes a step late.
        ports: how many there are.
    """

    states: list[int]
    arguments: list[int]
    late: list[tuple[int, int]]
    checks: list[Checked]
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
    for k, number in enumerate(_SOUND, at.last + len(at.late)):
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

"""The function of a kernel in instructions: threads share the tracks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from torchfra.compiler.instructions import Code, Lanes

CALL = "{ i64, i64, i64, ptr, ptr, i64 }"
"""Tracks, steps, threads, two pointers (to ports that are read and written, say), and how many shares are taken."""

PART = "; another part\n"
"""Between the parts of a module."""
_LINES = 8000
"""Lines of a part, about."""


def called(code: Code, values: Sequence[tuple[str, str]]) -> str:
    """A ``CALL`` of these types and values, in memory of the function."""
    call = code.place(CALL)
    for k, (type, value) in enumerate(values):
        code.store(type, value, code.field(CALL, call, k))
    return call


def fields(code: Code) -> list[str]:
    """What the function of a share reads of its ``%call``, but the count of shares."""
    return [code.load(type, code.field(CALL, "%call", k)) for k, type in enumerate(("i64", "i64", "i64", "ptr", "ptr"))]


def kernel(lanes: Lanes, block: str, packs: int, written: int, most: int) -> tuple[list[str], set[str]]:
    """The function ``run`` of a kernel.

    Args:
        lanes: of a pack.
        block: the function of a block of tracks.
        packs: of a block at most.
        written: numbers that are written at each step of a track.
        most: bytes written by a call from which on they go past the caches.
    """
    width = lanes.width
    one = Code(lanes, "define internal void @share(ptr %call, i64 %thread)")
    tracks, steps, threads, reads, writes = fields(one)
    all_packs = one.op("sdiv", one.op("add", tracks, width - 1), width)
    share = one.op("mul", threads, packs)
    each = one.op("sdiv", one.op("sub", one.op("add", all_packs, share), 1), share)  # blocks: as many for each thread
    blocks = one.op("mul", each, threads)
    size = one.op("mul", one.op("mul", tracks, steps), written * lanes.bits // 8)
    is_past = one.new(f"icmp sge i64 {size}, {most}")
    past = one.new(f"zext i1 {is_past} to i8")
    start = one.op("mul", each, "%thread")

    def edge(number: str) -> str:
        return one.op("mul", one.op("sdiv", one.op("mul", all_packs, number), blocks), width)

    with one.loop(one.op("add", start, each), start) as k:
        first = edge(k)
        last = one.call("i64", "llvm.smin.i64", ("i64", edge(one.op("add", k, 1))), ("i64", tracks))
        with one.where(one.new(f"icmp slt i64 {first}, {last}")):
            count = one.op("sub", last, first)
            one.do(f"call void @{block}(ptr {reads}, ptr {writes}, i64 {steps}, i64 {first}, i64 {count}, i8 {past})")
    if lanes.registers and width > 1:
        one.call("void", "llvm.x86.sse.sfence")  # all is there before the threads meet
    one.do("ret void")
    run = Code(lanes, "define void @run(i64 %tracks, i64 %steps, i32 %threads, ptr %in, ptr %out)", "nounwind")
    with run.where(run.new("icmp sgt i64 %tracks, 0")):
        count = run.new("sext i32 %threads to i64")
        arguments = ("i64", "%tracks"), ("i64", "%steps"), ("i64", count), ("ptr", "%in"), ("ptr", "%out")
        on_threads(run, called(run, arguments), "%threads", "share")
    run.do("ret void")
    return [one.text(), taken("share"), run.text()], one.declared | run.declared


def on_threads(code: Code, call: str, threads: str, share: str) -> None:
    """Calls a function for the number of each thread, on as many threads."""
    alone = code.new(f"icmp eq i32 {threads}, 1")
    one, several, behind = (code.named(word) for word in ("one", "several", "behind"))
    code.do(f"br i1 {alone}, label %{one}, label %{several}")
    code.start(one)
    code.do(f"call void @{share}(ptr {call}, i64 0)")
    code.do(f"br label %{behind}")
    code.start(several)
    code.store("i64", "0", code.field(CALL, call, 5))
    code.call("void", "GOMP_parallel", ("ptr", f"@{share}_taken"), ("ptr", call), ("i32", threads), ("i32", "0"))
    code.do(f"br label %{behind}")
    code.start(behind)


def taken(share: str) -> str:
    """What each thread does: it takes the next share until there is none."""
    return f"""define internal void @{share}_taken(ptr %call) nounwind {{
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


def module(texts: Iterable[str], declared: Iterable[str]) -> str:
    """A module of these functions and tables; if it is long, its parts, ``PART`` between them: threads compile them."""
    tail = '!0 = !{!"branch_weights", i32 2000, i32 1}\n!1 = !{!"branch_weights", i32 1, i32 2000}\n!2 = !{i32 1}\n'
    texts = [*texts]
    heads = {head.split("@", 1)[1].split("(", 1)[0]: head for head in map(_head, texts)}
    needed = sorted(line for line in declared if line.split("@")[1].split("(")[0] not in heads)
    parts, lines = [list[str]()], 0
    for text in texts:
        if lines > _LINES:
            parts.append([])
            lines = 0
        parts[-1].append(text)
        lines += text.count("\n")
    if len(parts) == 1:
        return "\n".join([*needed, *texts, tail])
    made = []
    for part in parts:
        own = {*map(_head, part)}
        others = [_declared(head) for head in heads.values() if head not in own and "internal" in head]
        shared = [text.replace("internal", "hidden", 1) for text in part]
        made.append("\n".join([*needed, *others, *shared, tail]))
    return PART.join(made)


def _head(text: str) -> str:
    """The first line of a function or a table."""
    return text.split("\n", 1)[0]


def _declared(head: str) -> str:
    """What another part needs to know of a function or a table."""
    if head.startswith("@"):
        return head.replace("= internal", "= external hidden").split("] [")[0] + "]"
    kind, rest = head.replace("define internal", "declare hidden").split("(", 1)
    types = ", ".join(arg.rsplit(" ", 1)[0] for arg in rest.split(")")[0].split(", ") if arg)
    return f"{kind}({types}) nounwind"

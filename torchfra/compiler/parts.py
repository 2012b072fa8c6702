"""The functions of a large step in parts, which several processes compile at the same time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from torchfra.compiler.statements import function

_MOST = 60
"""Parts at most: bits of a number in a condition of the preprocessor."""
_LARGE = 6000
"""Lines from which a step is large: for a smaller one, to start another compiler and read its headers is no gain."""
_PART = "\n#if PARTS & "


def together(functions: Mapping[str, Sequence[str]]) -> str:
    """Functions one after the other.

    Args:
        functions: lines by name and arguments.
    """
    return "".join(function(head, lines) for head, lines in functions.items())


def apart(functions: Mapping[str, Sequence[str]]) -> str:
    """The same; large ones between conditions on the bits of ``PARTS``: those that a compiler is to take."""
    if sum(map(len, functions.values())) < _LARGE:
        return together(functions)
    declared = "".join(f"SHARED void {head};\n" for head in functions)
    defined = "".join(
        f"{_PART}{1 << k % _MOST}\n{function(head, lines, 'SHARED')}#endif\n"
        for k, (head, lines) in enumerate(functions.items())
    )
    return f"#ifndef PARTS\n#define PARTS {(1 << _MOST) - 1}\n#endif\n{declared}{defined}"


def opened(text: str) -> str:
    """The text around functions in parts, whose names these parts share: in a namespace that has a name."""
    return text.replace("namespace {", "inline namespace kernel {")


def are_in(text: str) -> bool:
    """Whether a text has parts."""
    return _PART in text


def shares(source: str, cores: int) -> list[int]:
    """Which parts of a source each of several compilers takes, as bits, so that all have about as much to do."""
    found = [part.partition("\n") for part in source.split(_PART)[1:]]
    lines: dict[int, int] = defaultdict(int)
    for number, _, text in found:
        lines[int(number)] += text.count("\n")
    taken, work = [0] * min(cores, max(len(lines), 1)), [0] * cores
    for part in sorted(lines, key=lambda part: -lines[part]):
        least = work.index(min(work[: len(taken)]))
        taken[least] |= part
        work[least] += lines[part]
    return taken

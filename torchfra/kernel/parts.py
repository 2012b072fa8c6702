"""The functions of a large step in parts, which several processes compile at the same time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torchfra.kernel.statements import function

COUNT = 8
"""Parts of a large step."""
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
    total = sum(map(len, functions.values()))
    if total < _LARGE:
        return together(functions)
    parts: list[list[str]] = [[] for _ in range(COUNT)]
    done = 0
    for head, lines in functions.items():
        parts[done * COUNT // total].append(function(head, lines, "SHARED"))
        done += len(lines)
    declared = "".join(f"SHARED void {head};\n" for head in functions)
    defined = "".join(f"{_PART}{1 << k}\n{''.join(part)}#endif\n" for k, part in enumerate(parts))
    return f"#ifndef PARTS\n#define PARTS {(1 << COUNT) - 1}\n#endif\n{declared}{defined}"


def shares(source: str, cores: int) -> list[int]:
    """Which parts of a source each of several compilers takes, as bits; one takes all of a source without parts."""
    count = min(cores, COUNT) if _PART in source else 1
    return [sum(1 << k for k in range(first, COUNT, count)) for first in range(count)]

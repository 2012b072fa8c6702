"""What expressions are called in C++: after fields and inputs of a step, and by their numbers else."""

from __future__ import annotations

import keyword
import re
from collections.abc import Sequence
from functools import lru_cache

from torchfra.compiler.expressions import Expressions
from torchfra.compiler.statements import file

KEYWORDS = {
    *keyword.kwlist, "alignas", "alignof", "and_eq", "asm", "auto", "bitand", "bitor", "bool", "case", "catch",
    "char", "compl", "concept", "const", "constexpr", "decltype", "default", "delete", "do", "double", "enum",
    "explicit", "export", "extern", "false", "float", "friend", "goto", "inline", "int", "long", "mutable",
    "namespace", "new", "noexcept", "not_eq", "nullptr", "or_eq", "operator", "private", "protected", "public",
    "register", "requires", "short", "signed", "sizeof", "static", "struct", "switch", "template", "this",
    "thread_local", "throw", "true", "typedef", "typeid", "typename", "union", "unsigned", "using", "virtual",
    "void", "volatile", "wchar_t", "xor", "xor_eq",
}  # fmt: skip
"""Keywords of C++, some of which Python has too."""
_MACROS = {"assert", "errno", "linux", "major", "minor", "std", "unix"}
_FILES = ("template.cpp", "narrow.cpp", "cuda.cpp")


def give(book: Expressions, path: str, numbers: Sequence[int], single: bool) -> None:
    """Calls the entries of a tensor ``belief_mean_0``, ``belief_mean_1`` and so on, or a single number ``dt``.

    What has a name keeps it.  Where a name is taken, or C++ might read it otherwise, the number stays.

    Args:
        book: the expressions.
        path: of the tensor, with dots.
        numbers: of its entries.
        single: whether it has no dimensions.
    """
    name = path.replace(".", "_")
    if not re.fullmatch(r"[a-z]([a-z0-9]|_(?!_))*(?<!_)", name) or re.fullmatch(r"(v|in|out|late|\w+_r)\d+", name):
        return
    taken = _words() | set(book.names.values())
    for entry, number in enumerate(numbers):
        called = name if single else f"{name}_{entry}"
        if called not in taken and number not in book.names and number not in book.values:
            book.names[number] = called


@lru_cache(maxsize=1)
def _words() -> frozenset[str]:
    """What has a meaning in the text around the expressions."""
    return frozenset(KEYWORDS | _MACROS | {word for name in _FILES for word in re.findall(r"\w+", file(name))})

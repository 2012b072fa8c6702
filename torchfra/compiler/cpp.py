"""C++ of a step, for a GPU and for use without torch."""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

from torchfra.compiler.expressions import Expressions, Routine
from torchfra.compiler.plan import Order, Plan
from torchfra.compiler.routines import called_by

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
_FILES = ("template.cpp", "cuda.cpp")


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


def called(book: Expressions, number: int) -> str:
    """The variable of an expression."""
    return book.names.get(number) or f"v{number}"


class _Lines:
    """Lines that compute expressions of a book."""

    def __init__(self, book: Expressions) -> None:
        self._book, self.lines, self._origin = book, list[str](), ""

    def _number(self, number: int) -> str:
        """An expression where a number is wanted."""
        value = self._book.values.get(number)
        if value is None:
            return called(self._book, number)
        text = "NAN" if math.isnan(value) else repr(value) if math.isfinite(value) else f"{'-' * (value < 0)}INFINITY"
        return f"Scalar({text})"

    def _truth(self, number: int) -> str:
        """An expression where a truth value is wanted."""
        value = self._book.values.get(number)
        return called(self._book, number) if value is None else "true" if value else "false"

    def value(self, number: int) -> str:
        """An expression as what it is."""
        return self._truth(number) if self._book.is_bool(number) else self._number(number)

    def set(self, number: int, text: str) -> None:
        """Gives an expression this value."""
        self.lines.append(
            f"const {'bool' if self._book.is_bool(number) else 'Scalar'} {called(self._book, number)} = {text};"
        )

    def compute(self, number: int) -> None:
        """An expression that is no constant and no input."""
        name, (op, args), origin = called(self._book, number), self._book.nodes[number], self._book.origin[number]
        if origin not in ("", self._origin):
            self._origin = origin
            self.lines.append(f"// {origin}")
        if op == "call":
            routine, values = self._book.calls[number], ", ".join(map(self._number, args))
            # Calls share the stack for their arguments.
            call = f"{{ const Scalar a[] = {{{values}}}; {routine.name}(a, {name}); }}"
            self.lines += [f"Scalar {name}[{len(routine.outputs)}];", call]
        else:
            self.set(number, self._computed(number, op, args))

    def _computed(self, number: int, op: str, args: Sequence[int]) -> str:
        if op in ("and", "or", "not"):
            truths = [*map(self._truth, args)]
            return f"!{truths[0]}" if op == "not" else f"{truths[0]} {'&' if op == 'and' else '|'} {truths[1]}"
        if op == "select":
            kind = self._truth if self._book.is_bool(number) else self._number
            return f"{self._truth(args[0])} ? {kind(args[1])} : {kind(args[2])}"
        numbers = [*map(self._number, args)]
        if op == "result":
            return f"{numbers[0]}[{self._book.places[number]}]"
        if op in ("neg", "same"):
            return numbers[0] if op == "same" else f"-{numbers[0]}"
        if op in _OPERATORS:
            return f"{numbers[0]} {_OPERATORS[op]} {numbers[1]}"
        return f"{_FUNCTIONS.get(op, f'::{op}')}({', '.join(numbers)})"


_OPERATORS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "=="}
_FUNCTIONS = {"abs": "::fabs", "round": "::nearbyint", "max": "largest", "min": "smallest", "norm": "norm"}
"""Functions that C++ calls otherwise, or does not have; nearbyint rounds halves to even, as torch does."""


def _function(head: str, lines: Iterable[str]) -> str:
    """A function without a result, by its name and arguments."""
    return f"NOINLINE void {head} {{\n{_indented(lines, 2)}}}\n"


def _indented(lines: Iterable[str], indent: int) -> str:
    return "".join(f"{' ' * indent}{line}\n" for line in lines)


@lru_cache(maxsize=1)
def template() -> tuple[str, str]:
    """``template.cpp``, before its namespace and that."""
    head, mark, block = file("template.cpp").partition("namespace {\nnamespace NAME {")
    return head, mark + block


@lru_cache
def file(name: str) -> str:
    """A file of this folder."""
    return Path(__file__).with_name(name).read_text()


_ALWAYS = "Scalar* s, Scalar* left, const Port* in, const Port* out, const Block& at"
"""What a function takes that is called at every step."""


def texts(plan: Plan, in_step: bool = False) -> dict[str, str]:
    """The functions of a step: what takes the place of each word of the template.

    Args:
        plan: how the step is computed.
        in_step: whether the threads of a GPU's block wait for each other at each step, so that they go through the same
            instructions at the same time: a long step does not fit into the cache of instructions.
    """
    functions = {f"{x.name}(const Scalar* a, Scalar* r)": _routine(x) for x in called_by(plan.book, plan.loop.live)}
    functions["begin(Scalar* s, Scalar* left, const Port* in, const Block& at)"] = _ordered(plan, plan.begin())
    before, calls = ["begin(s, left, in, at);"], ["__syncthreads();"] if in_step else []
    for k, piece in enumerate(plan.before):
        functions[f"before{k}(Scalar* s, const Port* in, const Block& at)"] = _ordered(plan, plan.once(piece))
        before.append(f"before{k}(s, in, at);")
    for k, piece in enumerate(plan.steps):
        functions[f"piece{k}({'Scalar* s' if piece.guard else _ALWAYS})"] = _ordered(plan, plan.each(piece))
        if piece.guard is None:
            calls.append(f"piece{k}(s, left, in, out, at);")
        else:
            mask, value = piece.guard
            calls.append(f"if (s[{plan.frame.places[mask]}] {'!=' if value else '=='} 0) piece{k}(s);")
    functions[f"turn({_ALWAYS})"] = _ordered(plan, plan.turn())
    functions["end(Scalar* s, Scalar* left, const Port* out, const Block& at)"] = _ordered(plan, plan.end())
    calls.append("turn(s, left, in, out, at);")
    return {
        "SIZE": str(plan.frame.own),
        "UNREAD": str(plan.unread),
        "// PIECES\n": "".join(_function(head, lines) for head, lines in functions.items()),
        "  // FIXED\n": _indented(before, 2),
        "    // STEP\n": _indented(calls, 4),
    }


def _ordered(plan: Plan, orders: Iterable[Order]) -> list[str]:
    """The lines of a function that does what a plan says."""
    body, opened = _Lines(plan.book), dict[str, None]()

    def place_of(number: int) -> str:
        place = plan.frame.places.get(number)
        return f"left[{plan.frame.left[number]}]" if place is None else f"s[{place}]"

    for what, number, access, place in orders:
        if access is not None:
            name = f"{access.port}{access.number}"
            opened[f"const Entries<{access.type}> {name}({access.port}[{access.number}], at);"] = None
        if what == "compute":
            body.compute(number)
        elif what == "take":
            body.set(number, place_of(number) + " != 0" * plan.book.is_bool(number))
        elif access is None:
            body.lines.append(f"{f's[{place}]' if what == 'move' else place_of(number)} = {body.value(number)};")
        elif what == "read":
            body.set(number, f"{name}[{access.entry}]")
        else:
            body.lines.append(f"{name}[{access.entry}] = {body.value(number)};")
    return [*opened, *body.lines]


def _routine(routine: Routine) -> list[str]:
    body, computed = _Lines(routine.book), {*routine.live}
    for k, number in enumerate(routine.inputs):
        body.set(number, f"a[{k}]")
    for number in routine.live:
        body.compute(number)
    results = [f"r[{k}] = {body.value(i)};" for k, i in enumerate(routine.outputs) if i in computed]
    return body.lines + results

"""C++ of single expressions, and the text around them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from torchfra.compiler.expressions import Expressions


def called(book: Expressions, number: int) -> str:
    """The variable of an expression."""
    return book.names.get(number) or f"v{number}"


def as_number(book: Expressions, number: int) -> str:
    """An expression where a vector of numbers is wanted."""
    value = book.values.get(number)
    if value is None:
        return called(book, number)
    if math.isnan(value):
        return "all(NAN)"
    return f"all({value!r})" if math.isfinite(value) else f"all({'-' if value < 0 else ''}INFINITY)"


def as_truth(book: Expressions, number: int) -> str:
    """An expression where a vector of truth values is wanted."""
    if number in book.values:
        return "(all(1.0) > all(0.0))" if book.values[number] else "(all(0.0) > all(1.0))"
    return called(book, number)


def statement(book: Expressions, number: int) -> list[str]:
    """The lines that compute an expression which is no constant and no input."""
    name, (op, args) = called(book, number), book.nodes[number]
    if op == "call":
        routine, values = book.calls[number], ", ".join(as_number(book, i) for i in args)
        call = f"{{ const V a[] = {{{values}}}; {routine.name}(a, {name}); }}"  # calls share the stack for them
        return [f"V {name}[{len(routine.outputs)}];", call]
    return [declared(book, number, computed(book, number))]


def declared(book: Expressions, number: int, text: str) -> str:
    """The line that gives an expression its value."""
    return f"const {'M' if book.is_bool(number) else 'V'} {called(book, number)} = {text};"


def computed(book: Expressions, number: int) -> str:
    """The value of an expression that is no constant and no input, from those it acts on."""
    op, args = book.nodes[number]
    if op in ("and", "or", "not"):
        masks = [as_truth(book, i) for i in args]
        return f"!{masks[0]}" if op == "not" else f"{masks[0]} {'&' if op == 'and' else '|'} {masks[1]}"
    if op == "select":
        kind = as_truth if book.is_bool(number) else as_number
        yes, no = (kind(book, i) for i in args[1:])
        return f"{as_truth(book, args[0])} ? {yes} : {no}"
    numbers = [as_number(book, i) for i in args]
    if op == "result":
        return f"{numbers[0]}[{book.places[number]}]"
    if op in ("neg", "same"):
        return numbers[0] if op == "same" else f"-{numbers[0]}"
    sign = _OPERATORS.get(op)
    return f"{numbers[0]} {sign} {numbers[1]}" if sign else f"{op}_({', '.join(numbers)})"


_OPERATORS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "=="}


def function(head: str, lines: Iterable[str]) -> str:
    """A function without a result.

    Args:
        head: its name and arguments.
        lines: what it does.
    """
    return f"NOINLINE void {head} {{\n{indented(lines, 2)}}}\n"


def indented(lines: Iterable[str], indent: int) -> str:
    """Lines as text."""
    return "".join(f"{' ' * indent}{line}\n" for line in lines)


@lru_cache(maxsize=1)
def template() -> tuple[str, str]:
    """``template.cpp``, before its namespace and that, with ``narrow.cpp`` in it."""
    text = file("template.cpp").replace("// LANES\n", file("narrow.cpp"))
    head, mark, block = text.partition("namespace {\nnamespace NAME {")
    return head, mark + block


@lru_cache
def file(name: str) -> str:
    """A file of this folder."""
    return Path(__file__).with_name(name).read_text()

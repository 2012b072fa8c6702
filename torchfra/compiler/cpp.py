"""C++ of a step, for a GPU and for use without torch."""

from __future__ import annotations

import keyword
import math
import re
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path

from torchfra.compiler.expressions import Expressions, Routine
from torchfra.compiler.plan import Access, Plan
from torchfra.compiler.routines import called_by
from torchfra.compiler.schedule import Piece

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


_ALWAYS = "V* s, V* left, const Port* in, const Port* out, const Block& at"
"""What a function takes that is called at every step."""


class Writer:
    """Writes the functions of a step.

    Args:
        plan: how the step is computed.
        in_step: whether the threads of a GPU's block wait for each other at each step, so that they go through the same
            instructions at the same time: a long step does not fit into the cache of instructions.
    """

    def __init__(self, plan: Plan, in_step: bool = False) -> None:
        self.plan, self._step, self._book, self._in_step = plan, plan.step, plan.book, in_step
        self._before, self._steps, self._frame, self._behind = plan.before, plan.steps, plan.frame, plan.behind

    def texts(self) -> dict[str, str]:
        """What takes the place of each word of the template."""
        functions = {**_routines(self._book, self._step.live), **self._begin()}
        before, calls = ["begin(s, left, in, at);"], ["__syncthreads();"] if self._in_step else []
        for k, piece in enumerate(self._before):
            functions[f"before{k}(V* s, const Port* in, const Block& at)"] = self._body(piece)
            before.append(f"before{k}(s, in, at);")
        stored = set[int]()
        for k, piece in enumerate(self._steps):
            if piece.guard is None:
                functions[f"piece{k}({_ALWAYS})"] = self._body(piece, stored)
                calls.append(f"piece{k}(s, left, in, out, at);")
            else:
                functions[f"piece{k}(V* s)"] = self._body(piece, stored)
                mask, value = piece.guard
                calls.append(
                    f"if (truth(s[{self._frame.places[mask]}]) == {'true' if value else 'false'}) piece{k}(s);"
                )
        functions |= self._turn(stored) | self._end()
        calls.append("turn(s, left, in, out, at);")
        return {
            "SIZE": str(self._frame.own),
            "UNREAD": str(self.plan.unread),
            "// PIECES\n": "".join(function(head, lines) for head, lines in functions.items()),
            "  // FIXED\n": indented(before, 2),
            "    // STEP\n": indented(calls, 4),
        }

    def _body(self, piece: Piece, stored: set[int] | None = None) -> list[str]:
        """The lines of a piece's function; ``stored``, if given, grows by what it writes."""
        body: list[str] = []
        late: list[str] = []
        opened: dict[str, str] = {}
        known = set(piece.numbers)
        named = ""
        for number in piece.numbers:
            access = self._step.loads.get(number)
            for arg in self._book.nodes[number][1]:
                if arg not in known and arg not in self._book.values:
                    body.append(self._taken(arg))
                    known.add(arg)
            if access is None:
                origin = self._book.origin[number]
                if origin not in ("", named):
                    body.append(f"// {origin}")
                    named = origin
                body += statement(self._book, number)
            else:
                opened[access.name] = access.opened
                body.append(declared(self._book, number, f"{access.how}({access.name}, {access.entry})"))
            if number in self._frame.places or number in self._frame.left:
                (late if number in self._frame.late else body).append(self._put_aside(number))
            for other, access in self._behind[number] if stored is not None else ():
                opened[access.name] = access.opened
                if other not in known and other not in self._book.values:
                    body.append(self._taken(other))
                    known.add(other)
                body.append(self._written(other, access))
        if stored is not None:
            stored.update(other for number in piece.numbers for other, _ in self._behind[number])
        return [*opened.values(), *body, *late]

    def _taken(self, number: int) -> str:
        """The line that takes a value from its place."""
        place = self._place(number)
        return declared(self._book, number, f"truth({place})" if self._book.is_bool(number) else place)

    def _put_aside(self, number: int) -> str:
        name = called(self._book, number)
        return f"{self._place(number)} = {f'kept({name})' if self._book.is_bool(number) else name};"

    def _place(self, number: int) -> str:
        """The place of a value."""
        place = self._frame.places.get(number)
        return f"left[{self._frame.left[number]}]" if place is None else f"s[{place}]"

    def _written(self, number: int, access: Access) -> str:
        value = (as_truth if access.how == "mark" else as_number)(self._book, number)
        return f"{access.how}({access.name}, {access.entry}, {value});"

    def _begin(self) -> dict[str, list[str]]:
        """The function that reads what is carried."""
        opened = dict.fromkeys(access.opened for access in self._step.first.values())
        reads = [f"{self._place(i)} = get({access.name}, {access.entry});" for i, access in self._step.first.items()]
        return {"begin(V* s, V* left, const Port* in, const Block& at)": [*opened, *reads]}

    def _turn(self, stored: set[int]) -> dict[str, list[str]]:
        """The function that ends a step: it writes what no piece has computed, and moves what is carried on."""
        stores = [(i, access) for i, access in self._step.stores if i not in stored]
        opened = dict.fromkeys(access.opened for _, access in stores)
        numbers = dict.fromkeys([*(i for i, _ in stores), *(i for i, _ in self._frame.moves)])
        taken = [self._taken(i) for i in numbers if i not in self._book.values]
        writes = [self._written(i, access) for i, access in stores]
        moves = [f"s[{place}] = {as_number(self._book, i)};" for i, place in self._frame.moves]
        return {f"turn({_ALWAYS})": [*opened, *taken, *writes, *moves]}

    def _end(self) -> dict[str, list[str]]:
        """The function that writes what the last step has carried."""
        opened = dict.fromkeys(access.opened for _, access in self._step.end)
        writes = [
            f"put({access.name}, {access.entry}, {self._place(i) if i in self._step.carried else 'all(0)'});"
            for i, access in self._step.end
        ]
        return {"end(V* s, V* left, const Port* out, const Block& at)": [*opened, *writes]}


def _routines(book: Expressions, live: Iterable[int]) -> dict[str, list[str]]:
    """By name and arguments, the lines of all routines that these expressions call; each before those that call it."""
    return {f"{routine.name}(const V* a, V* r)": _lines(routine) for routine in called_by(book, live)}


def _lines(routine: Routine) -> list[str]:
    book, computed = routine.book, set(routine.live)
    lines = [f"const V {called(book, i)} = a[{k}];" for k, i in enumerate(routine.inputs)]
    named = ""
    for number in routine.live:
        if book.origin[number] not in ("", named):
            named = book.origin[number]
            lines.append(f"// {named}")
        lines += statement(book, number)
    return lines + [f"r[{k}] = {called(book, i)};" for k, i in enumerate(routine.outputs) if i in computed]

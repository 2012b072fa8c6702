"""C++ for a loop over time whose step is expressions: one track, or blocks of them side by side in vector registers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import torch

from torchfra.kernel.build import check
from torchfra.kernel.expressions import ZERO, Expressions

SCALARS = {torch.float64: "double", torch.float32: "float"}
"""The dtypes that kernels compute in, and what C++ calls them."""


@dataclass
class Port:
    """A tensor that a kernel reads or writes: the expressions of its entries, for one track (and one step)."""

    ids: list[int]
    shape: torch.Size
    """Of the entries of a track (and step)."""
    timed: bool = False
    """Whether each step has its own entries."""
    packed: bool = False
    """Whether the same entry of neighbouring tracks lies side by side, as in what kernels write."""
    truth: bool = False
    """Whether it holds truth values."""
    late: bool = False
    """Whether there is room behind the last step, for what nothing later says of it."""
    double: bool = False
    """Whether it is read in double precision, whatever the arithmetic is in."""


@dataclass
class Scan:
    """A loop over time.

    Args:
        book: the expressions.
        carry: what goes from step to step, before a step; entries that are 0 stay 0.
        after: the same after the step.
        reads: what else a step reads.
        writes: what each step writes.
        backwards: from the last step to the first.
        dtype: of the arithmetic.

    The kernel reads ``carry`` and ``reads``, and writes ``after`` (once) and ``writes``, in this order.
    """

    book: Expressions
    carry: list[Port]
    after: list[Port]
    reads: list[Port]
    writes: list[Port]
    backwards: bool = False
    dtype: torch.dtype = torch.float64

    def live(self) -> list[int]:
        """The expressions that are needed, in an order in which they can be computed."""
        needed: set[int] = set()
        todo = [i for port in [*self.after, *self.writes] for i in port.ids]
        while todo:
            number = todo.pop()
            if number not in needed:
                needed.add(number)
                todo += self.book.nodes[number][1]
        return sorted(needed)

    def source(self, narrow: bool = False) -> str:
        """The translation unit, whose function is ``run``.

        Args:
            narrow: whether for one track, in plain C++ that needs no headers of torch; or for many, in vectors.

        Raises:
            CompileError: the step has too many operations.
        """
        return "".join((*self.parts(narrow), _file("run.cpp")))

    def parts(self, narrow: bool) -> tuple[str, str]:
        """What any scan of this dtype needs, and the function ``block`` of this one.

        Raises:
            CompileError: the step has too many operations.
        """
        live = self.live()
        check(len(live))
        varying, needed = self._varying(live), set(live)
        carried = [(p, e, i) for p, port in enumerate(self.carry) for e, i in enumerate(port.ids) if i != ZERO]
        before_loop = [f"V c{p}_{e} = get(in[{p}], {e}, at);" for p, e, _ in carried]
        before_loop += self._loads(False, needed) + [_statement(self.book, i) for i in live if i not in varying]
        step = [f"const V v{i} = c{p}_{e};" for p, e, i in carried if i in needed]
        step += self._loads(True, needed) + [_statement(self.book, i) for i in live if i in varying]
        step += self._stores()
        step += [f"c{p}_{e} = {_number(self.book, self.after[p].ids[e])};" for p, e, _ in carried]
        after_loop = [f"put(out[{p}], {e}, {f'c{p}_{e}' if i != ZERO else 'all(0)'}, at);"
                      for p, port in enumerate(self.carry) for e, i in enumerate(port.ids)]  # fmt: skip
        head, block = (text.replace("SCALAR", SCALARS[self.dtype]) for text in _template(narrow))
        block = block.replace("TIME", "steps - 1 - k" if self.backwards else "k")
        for mark, lines in {"FIXED": before_loop, "STEP": step, "END": after_loop}.items():
            block = block.replace(f"    // {mark}\n", "".join(f"    {line}\n" for line in lines if line))
        return head, block

    def _varying(self, live: list[int]) -> set[int]:
        """The expressions that change from step to step; all others are computed once, before the loop."""
        ports = [*self.carry, *(port for port in self.reads if port.timed)]
        varying = {i for port in ports for i in port.ids if i != ZERO}
        for number in live:
            if varying.intersection(self.book.nodes[number][1]):
                varying.add(number)
        return varying

    def _loads(self, timed: bool, needed: set[int]) -> list[str]:
        return [
            f"const V v{i} = {'load' if port.packed else 'get<double>' if port.double else 'get'}(in[{p}], {e}, at);"
            for p, port in enumerate(self.reads, len(self.carry))
            if port.timed == timed
            for e, i in enumerate(port.ids)
            if i in needed and i != ZERO
        ]

    def _stores(self) -> list[str]:
        return [
            f"mark(out[{p}], {e}, {_mask(self.book, i)}, at);"
            if port.truth
            else f"put(out[{p}], {e}, {_number(self.book, i)}, at);"
            for p, port in enumerate(self.writes, len(self.carry))
            for e, i in enumerate(port.ids)
        ]


def _number(book: Expressions, number: int) -> str:
    """An expression where a vector of numbers is wanted."""
    value = book.values.get(number)
    if value is None:
        return f"v{number}"
    if math.isnan(value):
        return "all(NAN)"
    return f"all({value!r})" if math.isfinite(value) else f"all({'-' if value < 0 else ''}INFINITY)"


def _mask(book: Expressions, number: int) -> str:
    """An expression where a vector of truth values is wanted."""
    if number in book.values:
        return "(all(1.0) > all(0.0))" if book.values[number] else "(all(0.0) > all(1.0))"
    return f"v{number}"


def _statement(book: Expressions, number: int) -> str:
    """The line that computes an expression; empty for constants and inputs."""
    op, args = book.nodes[number]
    if op in ("constant", "input"):
        return ""
    truth = book.is_bool(number)
    if op in ("and", "or", "not"):
        masks = [_mask(book, i) for i in args]
        text = f"!{masks[0]}" if op == "not" else f"{masks[0]} {'&' if op == 'and' else '|'} {masks[1]}"
    elif op == "select":
        mask, *choices = args
        yes, no = (_mask(book, i) if truth else _number(book, i) for i in choices)
        text = f"{_mask(book, mask)} ? {yes} : {no}"
    else:
        numbers = [_number(book, i) for i in args]
        sign = _OPERATORS.get(op)
        text = f"{numbers[0]} {sign} {numbers[1]}" if sign else f"{op}_({', '.join(numbers)})"
        text = f"-{numbers[0]}" if op == "neg" else text
    return f"const {'M' if truth else 'V'} v{number} = {text};"


_OPERATORS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "=="}

_FUNCTIONS = {"sqrt": 1, "abs": 1, "exp": 1, "expm1": 1, "log": 1, "log1p": 1, "erf": 1, "sin": 1, "cos": 1, "tan": 1,
              "asin": 1, "acos": 1, "atan": 1, "sinh": 1, "cosh": 1, "tanh": 1, "round": 1, "floor": 1, "ceil": 1,
              "trunc": 1, "atan2": 2, "hypot": 2, "pow": 2}  # fmt: skip
"""Functions of torch's vectors and of C++, with the number of their arguments."""

_VECTORS = {
    1: "inline V {0}_(const V& a) {{ return raw(vec(a).{0}()); }}\n",
    2: "inline V {0}_(const V& a, const V& b) {{ return raw(vec(a).{0}(vec(b))); }}\n",
}
_NUMBERS = {
    1: "inline V {0}_(V a) {{ return std::{0}(a); }}\n",
    2: "inline V {0}_(V a, V b) {{ return std::{0}(a, b); }}\n",
}


@lru_cache(maxsize=2)
def _template(narrow: bool) -> tuple[str, str]:
    """``template.cpp``, before its function and that, with ``narrow.cpp`` or ``wide.cpp`` and the functions in it."""
    forms = _NUMBERS if narrow else _VECTORS
    functions = "".join(forms[count].format(name) for name, count in _FUNCTIONS.items())
    if narrow:
        functions = functions.replace("std::round(", "std::nearbyint(")  # halves to the even neighbour, as torch does
    lanes = _file("narrow.cpp" if narrow else "wide.cpp").replace("// FUNCTIONS\n", functions)
    head, mark, block = _file("template.cpp").replace("// LANES\n", lanes).partition("namespace {\nvoid block(")
    return head, mark + block


@lru_cache
def _file(name: str) -> str:
    return Path(__file__).with_name(name).read_text()

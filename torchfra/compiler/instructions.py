"""Instructions of LLVM, written one after the other, on values of all lanes of a pack of tracks."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import NamedTuple

import torch


class Lanes(NamedTuple):
    """How the tracks of a pack lie side by side in registers.

    Args:
        width: how many; one is a number by itself.
        dtype: of the arithmetic.
        registers: ``"avx512"``, ``"avx2"`` or ``""`` for any others.
    """

    width: int
    dtype: torch.dtype
    registers: str = ""

    @property
    def bits(self) -> int:
        """Bits of a number."""
        return 8 * self.dtype.itemsize

    @property
    def scalar(self) -> str:
        """The type of a number."""
        return "double" if self.bits == 64 else "float"

    def of(self, scalar: str) -> str:
        """The type of one such scalar in each lane."""
        return scalar if self.width == 1 else f"<{self.width} x {scalar}>"

    @property
    def size(self) -> int:
        """Bytes of a number in each lane."""
        return self.width * self.dtype.itemsize

    @property
    def suffix(self) -> str:
        """What the names of LLVM's functions of such numbers end in."""
        return f"f{self.bits}" if self.width == 1 else f"v{self.width}f{self.bits}"


class Code:
    """A function that is being written.

    Args:
        lanes: of its values.
        head: its result, name and arguments.
        how: its attributes.
    """

    def __init__(self, lanes: Lanes, head: str, how: str = "noinline nounwind") -> None:
        self.lanes, self._head, self._how = lanes, head, how
        self.numbers, self.truths, self.integers = lanes.of(lanes.scalar), lanes.of("i1"), lanes.of(f"i{lanes.bits}")
        self.lines: list[str] = []
        self.places: list[str] = []
        self.block, self._count = "entry", 0
        self.declared: set[str] = set()

    def text(self) -> str:
        """The function."""
        return "\n".join([f"{self._head} {self._how} {{", "entry:", *self.places, *self.lines, "}\n"])

    def new(self, text: str) -> str:
        """The name of what an instruction gives."""
        self._count += 1
        name = f"%t{self._count}"
        self.lines.append(f"{name} = {text}")
        return name

    def op(self, op: str, a: str | int, b: str | int) -> str:
        """An operation on two whole numbers, the same for all lanes."""
        return self.new(f"{op} i64 {a}, {b}")

    def do(self, text: str) -> None:
        """An instruction that gives nothing."""
        self.lines.append(text)

    def place(self, type: str, count: int = 1) -> str:
        """Memory of the function for so many of a type."""
        self._count += 1
        self.places.append(f"%m{self._count} = alloca {type}, i64 {count}, align 64")
        return f"%m{self._count}"

    def call(self, result: str, name: str, *args: tuple[str, str]) -> str:
        """What a function that is declared elsewhere gives for arguments: types and values."""
        types = ", ".join(type for type, _ in args)
        self.declared.add(f"declare {result} @{name}({types})")
        text = f"call {result} @{name}({', '.join(f'{type} {value}' for type, value in args)})"
        if result != "void":
            return self.new(text)
        self.do(text)
        return ""

    def at(self, start: str, type: str, number: str | int) -> str:
        """The address of a number of a type, counted from a start."""
        return start if number == 0 else self.new(f"getelementptr inbounds {type}, ptr {start}, i64 {number}")

    def field(self, type: str, start: str, number: int, at: str | int = 0) -> str:
        """The address of a field of a structure, ``at`` which place in a row of them."""
        return self.new(f"getelementptr inbounds {type}, ptr {start}, i64 {at}, i32 {number}")

    def load(self, type: str, address: str, align: int = 8) -> str:
        """The value that lies there."""
        return self.new(f"load {type}, ptr {address}, align {align}")

    def store(self, type: str, value: str, address: str, align: int = 8) -> None:
        """Puts a value there."""
        self.do(f"store {type} {value}, ptr {address}, align {align}")

    def start(self, block: str) -> None:
        """What follows is a block of this name."""
        self.do(f"{block}:")
        self.block = block

    def named(self, word: str) -> str:
        """A new name for a block."""
        self._count += 1
        return f"{word}{self._count}"

    @contextmanager
    def where(self, condition: str, likely: bool | None = None) -> Iterator[str]:
        """What is done only if a truth value holds; gives the name of the block behind it."""
        inside, behind = self.named("then"), self.named("behind")
        weight = "" if likely is None else ", !prof !0" if likely else ", !prof !1"
        self.do(f"br i1 {condition}, label %{inside}, label %{behind}{weight}")
        self.start(inside)
        yield behind
        self.do(f"br label %{behind}")
        self.start(behind)

    @contextmanager
    def loop(self, count: str | int, first: str | int = 0, by: str | int = 1) -> Iterator[str]:
        """What is done for each number from ``first`` until before ``count``."""
        name = self.named("loop")
        number, before = f"%{name}.k", self.block
        self.do(f"br label %{name}")
        self.start(name)
        self.do(f"{number} = phi i64 [ {first}, %{before} ], [ {number}.next, %{name}.end ]")
        self.do(f"{number}.more = icmp slt i64 {number}, {count}")
        self.do(f"br i1 {number}.more, label %{name}.inside, label %{name}.behind")
        self.start(f"{name}.inside")
        yield number
        self.do(f"br label %{name}.end")
        self.start(f"{name}.end")
        self.do(f"{number}.next = add i64 {number}, {by}")
        self.do(f"br label %{name}")
        self.start(f"{name}.behind")

    def every(self, scalar: str, value: str | float) -> str:
        """The same constant in each lane."""
        return value if self.lanes.width == 1 else f"splat ({scalar} {value})"  # type: ignore[return-value]

    def constant(self, value: float) -> str:
        """A number in each lane."""
        return self.every(self.lanes.scalar, literal(value, self.lanes.bits))

    def spread(self, scalar: str, value: str) -> str:
        """A vector with one scalar in each lane."""
        if self.lanes.width == 1:
            return value
        type = self.lanes.of(scalar)
        first = self.new(f"insertelement {type} poison, {scalar} {value}, i64 0")
        return self.new(f"shufflevector {type} {first}, {type} poison, <{self.lanes.width} x i32> zeroinitializer")

    @cached_property
    def lane(self) -> str:
        """The number of each lane, as whole numbers."""
        if self.lanes.width == 1:
            return "0"
        return f"<{', '.join(f'i{self.lanes.bits} {k}' for k in range(self.lanes.width))}>"

    def truth(self, number: str, value: bool = True) -> str:
        """Truth values: whether a number in a place, of which all bits or none are set, stands for this value."""
        integer = self.new(f"bitcast {self.numbers} {number} to {self.integers}")
        return self.new(
            f"icmp {'ne' if value else 'eq'} {self.integers} {integer}, {self.every(f'i{self.lanes.bits}', '0')}"
        )

    def any(self, truth: str) -> str:
        """Whether it holds in a lane."""
        if self.lanes.width == 1:
            return truth
        return self.new(f"icmp ne i{self.lanes.width} {self.which(truth)}, 0")

    def which(self, truth: str) -> str:
        """A bit for each lane."""
        return truth if self.lanes.width == 1 else self.new(f"bitcast {self.truths} {truth} to i{self.lanes.width}")

    def number(self, value: str | float) -> Number:
        """A value as a number to calculate with."""
        return Number(self, value if isinstance(value, str) else self.constant(value))


def literal(value: float, bits: int) -> str:
    """A number as LLVM writes it: exactly."""
    if math.isnan(value):
        return "0x7FF8000000000000"
    if bits == 32:
        value = struct.unpack(">f", struct.pack(">f", value))[0]
    return f"0x{struct.pack('>d', value).hex().upper()}"


class Number:
    """A number in each lane, which Python's operators calculate with."""

    def __init__(self, code: Code, name: str) -> None:
        self.code, self.name = code, name

    def _of(self, other: Number | float) -> str:
        return other.name if isinstance(other, Number) else self.code.constant(other)

    def _new(self, text: str) -> Number:
        return Number(self.code, self.code.new(text))

    def _with(self, op: str, a: str, b: str) -> Number:
        return self._new(f"{op} contract {self.code.numbers} {a}, {b}")

    def __add__(self, other: Number | float) -> Number:
        return self._with("fadd", self.name, self._of(other))

    def __radd__(self, other: float) -> Number:
        return self._with("fadd", self._of(other), self.name)

    def __sub__(self, other: Number | float) -> Number:
        return self._with("fsub", self.name, self._of(other))

    def __rsub__(self, other: float) -> Number:
        return self._with("fsub", self._of(other), self.name)

    def __mul__(self, other: Number | float) -> Number:
        return self._with("fmul", self.name, self._of(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Number | float) -> Number:
        return self._with("fdiv", self.name, self._of(other))

    def __lt__(self, other: Number | float) -> Truth:
        return self.compared("olt", other)

    def __gt__(self, other: Number | float) -> Truth:
        return self.compared("ogt", other)

    def equals(self, other: Number | float) -> Truth:
        """Truth values: whether both are the same number."""
        return self.compared("oeq", other)

    def compared(self, how: str, other: Number | float) -> Truth:
        """Truth values of a comparison of LLVM."""
        return Truth(self.code, self.code.new(f"fcmp {how} {self.code.numbers} {self.name}, {self._of(other)}"))


class Truth:
    """A truth value in each lane."""

    def __init__(self, code: Code, name: str) -> None:
        self.code, self.name = code, name

    def _with(self, op: str, other: str) -> Truth:
        return Truth(self.code, self.code.new(f"{op} {self.code.truths} {self.name}, {other}"))

    def __and__(self, other: Truth) -> Truth:
        return self._with("and", other.name)

    def __or__(self, other: Truth) -> Truth:
        return self._with("or", other.name)

    def __invert__(self) -> Truth:
        return self._with("xor", self.code.every("i1", "true"))

    def choose(self, yes: Number | float, no: Number | float) -> Number:
        """One number where it holds, and another where it does not."""
        code, kind = self.code, self.code.numbers
        names = [x.name if isinstance(x, Number) else code.constant(x) for x in (yes, no)]
        return Number(code, code.new(f"select {code.truths} {self.name}, {kind} {names[0]}, {kind} {names[1]}"))


def phi(code: Code, type: str, incoming: Sequence[tuple[str, str]]) -> str:
    """A value that depends on the block before: values and blocks."""
    return code.new(f"phi {type} {', '.join(f'[ {value}, %{block} ]' for value, block in incoming)}")

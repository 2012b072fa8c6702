"""Elementary functions in instructions: what steps call often is written where it is used, others are called."""

from __future__ import annotations

import ctypes
import math
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from torchfra.compiler.instructions import Code, Lanes, Number, phi


def applied(code: Code, name: str, args: Sequence[str]) -> str:
    """The value of a function of numbers, by its name in an expression."""
    numbers = [Number(code, arg) for arg in args]
    written = _WRITTEN.get(name)
    if written is not None:
        return written(*numbers).name
    if name in _LLVM:
        return _instruction(code, _LLVM[name], numbers[0]).name
    return _called(code, name, args)


_LLVM = {"sqrt": "sqrt", "abs": "fabs", "floor": "floor", "ceil": "ceil", "trunc": "trunc", "round": "roundeven"}
"""Functions that LLVM has for vectors, and what it calls them."""
_OFF = {"erfc": "15", "hypot": "05"}
"""By how many tenths of the last place a function of SLEEF is off; 10 for others."""


def _instruction(code: Code, name: str, x: Number) -> Number:
    return Number(code, code.call(code.numbers, f"llvm.{name}.{code.lanes.suffix}", (code.numbers, x.name)))


def _called(code: Code, name: str, args: Sequence[str]) -> str:
    """By SLEEF, which torch has inside for the registers of AVX; elsewhere by the mathematics of C, lane by lane."""
    lanes = code.lanes
    if lanes.width > 1:
        sleef = f"Sleef_{name}{'d' if lanes.bits == 64 else 'f'}{lanes.width}_u{_OFF.get(name, '10')}"
        if address(sleef):
            return code.call(code.numbers, sleef, *((code.numbers, arg) for arg in args))
    function = name + ("f" if lanes.bits == 32 else "")
    if lanes.width == 1:
        return code.call(lanes.scalar, function, *((lanes.scalar, arg) for arg in args))
    result = "poison"
    for k in range(lanes.width):
        each = [(lanes.scalar, code.new(f"extractelement {code.numbers} {arg}, i64 {k}")) for arg in args]
        value = code.call(lanes.scalar, function, *each)
        result = code.new(f"insertelement {code.numbers} {result}, {lanes.scalar} {value}, i64 {k}")
    return result


@lru_cache
def address(name: str) -> int:
    """Address of a function of torch or of the mathematics of C; 0 where there is none of this name."""
    for library in _libraries():
        try:
            return ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0
        except AttributeError:
            continue
    return 0


@lru_cache(maxsize=1)
def _libraries() -> list[Any]:
    """Torch's own library, and the mathematics of C."""
    folder = Path(torch.__file__).parent / "lib"
    names = {"win32": ["torch_cpu.dll"], "darwin": ["libtorch_cpu.dylib"]}.get(sys.platform, ["libtorch_cpu.so"])
    found: list[Any] = [ctypes.CDLL(str(folder / name)) for name in names if (folder / name).exists()]
    return [*found, ctypes.CDLL("ucrtbase" if sys.platform == "win32" else None)]


def _largest(a: Number, b: Number) -> Number:
    return ((a > b) | a.compared("uno", a)).choose(a, b)


def _smallest(a: Number, b: Number) -> Number:
    return ((a < b) | a.compared("uno", a)).choose(a, b)


def _sum_of_squares(numbers: Sequence[Number]) -> Number:
    """Four at a time: none waits for all that come before it."""
    if len(numbers) < 4:
        total = numbers[0] * numbers[0]
        for x in numbers[1:]:
            total = total + x * x
        return total
    a, b, c, d = numbers[:4]
    four: Number = (a * a + b * b) + (c * c + d * d)
    return four + _sum_of_squares(numbers[4:]) if numbers[4:] else four


def _outside(x: Number, least: float, most: float) -> str:
    """Whether a lane is outside; NaN is not."""
    return x.code.any(((x < least) | (x > most)).name)


def _norm(*numbers: Number) -> Number:
    """The Euclidean norm, scaled where that is needed: hardly ever.

    Sums of squares from ``least`` to ``most`` have lost nothing to under- or overflow; outside, factors bring them
    there.  Other lanes keep what they have without scaling, to the bit.
    """
    code = numbers[0].code
    double = code.lanes.bits == 64
    least, most, lowest = (2.0**-960, 2.0**1000, 2.0**-1022) if double else (2.0**-100, 2.0**120, 2.0**-126)
    up, down = (2.0**600, 2.0**-600) if double else (2.0**90, 2.0**-90)
    squares = _sum_of_squares(numbers)
    plain = _instruction(code, "sqrt", squares)
    before = code.block
    with code.where(_outside(squares, least, most), likely=False):
        small, large = squares < least, squares > most
        factor = small.choose(up, large.choose(down, 1.0))
        norm = _instruction(code, "sqrt", _sum_of_squares([x * factor for x in numbers])) / factor
        scaled = (~(small | large)).choose(plain, (norm < lowest).choose(0.0, norm))  # its inverse would be infinite
        inside = code.block
    return Number(code, phi(code, code.numbers, [(scaled.name, inside), (plain.name, before)]))


def _signed_as(size: Number, sign: Number) -> Number:
    code, kind = size.code, size.code.numbers
    return Number(code, code.call(kind, f"llvm.copysign.{code.lanes.suffix}", (kind, size.name), (kind, sign.name)))


_ARC = (
    -0.3333333333333333, 0.19999999999995516, -0.14285714284665682, 0.11111111015187018, -0.09090904575306488,
    0.07692183125376885, -0.06664510525508843, 0.058581409048656254, -0.050854078345862384, 0.039230447784709195,
    -0.01917540471101196,
)  # fmt: skip
"""Of (atan(t) / t - 1) / t^2 by powers of t^2, the best of degree 10 for t within pi/8: off by 3e-17 at most."""


def _polynomial(of: Number, terms: Sequence[float]) -> Number:
    """A polynomial in pairs of pairs, so that few products wait for others."""
    square = of * of
    pairs = [terms[k] + terms[k + 1] * of if terms[k + 1 : k + 2] else terms[k] for k in range(0, len(terms), 2)]
    fours = [a + b * square if b is not None else a for a, b in _by_two(pairs)]
    fourth = square * square
    total: Number = fours[-1]
    for four in fours[-2::-1]:
        total = four + total * fourth
    return total


def _by_two(values: Sequence[Any]) -> list[tuple[Any, Any]]:
    return [(values[k], values[k + 1] if k + 1 < len(values) else None) for k in range(0, len(values), 2)]


def _atan2(y: Number, x: Number) -> Number:
    """The arc tangent to 4e-16 of its size: a polynomial within pi/8, to which one division brings the first octant."""
    code = y.code
    tangent, quarter, top = 0.41421356237309503, math.pi / 4, 1e300 if code.lanes.bits == 64 else 1e37
    a, b = _instruction(code, "fabs", x), _instruction(code, "fabs", y)
    steep = b > a
    low, high = steep.choose(a, b), steep.choose(b, a)
    before = code.block
    with code.where(_outside(high, 1 / top, top), likely=False):  # only their ratio counts
        factor = (high > top).choose(1 / top, (high < 1 / top).choose(top, 1.0))
        infinite = high.equals(math.inf)
        low_in = infinite.choose(low.equals(math.inf).choose(1.0, low * 0.0), low * factor)
        high_in = infinite.choose(1.0, high.equals(0.0).choose(1.0, high * factor))
        inside = code.block
    low, high = (
        Number(code, phi(code, code.numbers, [(new.name, inside), (old.name, before)]))
        for new, old in ((low_in, low), (high_in, high))
    )
    beyond = low > tangent * high
    t = beyond.choose(low - high, low) / beyond.choose(low + high, high)
    s = t * t
    octant = (t + t * s * _polynomial(s, _ARC)) + beyond.choose(quarter, 0.0)
    quadrant = steep.choose(2 * quarter - octant, octant)
    behind = _signed_as(code.number(1.0), x) < 0.0  # of x = -0 too
    return _signed_as(behind.choose(4 * quarter - quadrant, quadrant), y)


_WRITTEN: dict[str, Callable[..., Number]] = {"max": _largest, "min": _smallest, "norm": _norm, "atan2": _atan2}
SHARED = "atan2"
"""The function of many instructions that a long step calls: written once for all of its uses."""


def shared(lanes: Lanes, name: str) -> Code:
    """The function ``SHARED`` by itself, to be called by ``name``."""
    numbers = lanes.of(lanes.scalar)
    code = Code(lanes, f"define internal {numbers} @{name}({numbers} %y, {numbers} %x)")
    code.do(f"ret {numbers} {applied(code, SHARED, ('%y', '%x'))}")
    return code

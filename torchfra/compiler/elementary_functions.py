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

from torchfra.compiler.instructions import Code, Integer, Lanes, Number, Truth, phi


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
    return _signed_as(x.integer().negative().choose(4 * quarter - quadrant, quadrant), y)


def _split(code: Code) -> tuple[int, float, float, float]:
    """Binary digits behind the first, ln(2) in two parts, and a number that rounds what is added to it.

    Integer multiples of the first part are exact; what is rounded is in the last bits of the sum.
    """
    if code.lanes.bits == 64:
        return 52, float.fromhex("0x1.62e42feep-1"), float.fromhex("0x1.a39ef35793c76p-33"), 1.5 * 2.0**52
    return 23, float.fromhex("0x1.62e4p-1"), float.fromhex("0x1.7f7d1cf79abcap-20"), 1.5 * 2.0**23


def _exp(x: Number) -> Number:
    """To a rounding: a power of two times a Taylor polynomial within ln(2) / 2, off by 5e-18 at most."""
    code = x.code
    digits, high, low, rounder = _split(code)
    smallest, largest = (-746.0, 710.0) if code.lanes.bits == 64 else (-104.0, 89.0)  # beyond: 0 or infinite
    a = (x < smallest).choose(smallest, x)
    a = (a > largest).choose(largest, a)
    shifted = a * 1.4426950408889634 + rounder
    k = shifted - rounder
    r = (a - k * high) - k * low
    p = 1.0 + (r + r * r * _polynomial(r, [1 / math.factorial(n) for n in range(2, 14)]))
    if code.lanes.registers == "avx512" and code.lanes.width > 1:
        kind, bits = code.numbers, "i8" if code.lanes.bits == 64 else "i16"
        name = f"llvm.x86.avx512.mask.scalef.p{'d' if code.lanes.bits == 64 else 's'}.512"
        zero = "zeroinitializer"
        return Number(
            code, code.call(kind, name, (kind, p.name), (kind, k.name), (kind, zero), (bits, "-1"), ("i32", "4"))
        )
    power = shifted.integer() - code.number(rounder).integer()
    half = power >> 1  # in halves: the power alone may be out of range

    def of_two(exponent: Integer) -> Number:
        return ((exponent << digits) + code.number(1.0).integer()).number()

    return p * of_two(half) * of_two(power - half)


_LOG = (
    0.6666666666666735130, 0.3999999999940941908, 0.2857142874366239149, 0.2222219843214978396, 0.1818357216161805012,
    0.1531383769920937332, 0.1479819860511658591,
)  # fmt: skip


def _log(x: Number) -> Number:
    """To a rounding, as in FDLIBM (Sun Microsystems, 1993): exponent and fraction, and of that a rational function."""
    code = x.code
    digits, high, low, rounder = _split(code)
    more, lowest = (54, 2.0**-1022) if code.lanes.bits == 64 else (25, 2.0**-126)
    tiny = x < lowest
    bits = tiny.choose(x * 2.0**more, x).integer()
    exponent = (bits - code.number(0.70710678118654752).integer()) >> digits
    k = (exponent + code.number(rounder).integer()).number() - tiny.choose(rounder + more, rounder)
    f = (bits - (exponent << digits)).number() - 1.0
    s = f / (2.0 + f)
    z = s * s
    half = 0.5 * f * f
    p = z * _polynomial(z, _LOG)
    found = k * high + (f - (half - (s * (half + p) + k * low)))
    extreme = (x < 0.0).choose(math.nan, x.equals(0.0).choose(-math.inf, x))
    usual: Truth = (x > 0.0) & (x < math.inf)
    return usual.choose(found, extreme)


_WRITTEN: dict[str, Callable[..., Number]] = {
    "max": _largest, "min": _smallest, "norm": _norm, "atan2": _atan2, "exp": _exp, "log": _log,
}  # fmt: skip

SHARED = {"atan2": 2, "exp": 1, "log": 1}
"""Functions of many instructions that a long step calls, and their arguments: written once for all of its uses."""


def function(lanes: Lanes, name: str, of: str) -> Code:
    """A function of ``SHARED`` by itself, to be called by ``name``."""
    numbers = lanes.of(lanes.scalar)
    args = [f"%x{k}" for k in range(SHARED[of])]
    code = Code(lanes, f"define internal {numbers} @{name}({', '.join(f'{numbers} {arg}' for arg in args)})")
    code.do(f"ret {numbers} {applied(code, of, args)}")
    return code

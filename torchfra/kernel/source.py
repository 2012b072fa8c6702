"""C++ for a loop over time whose step is expressions: blocks of tracks side by side in vector registers."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from torchfra.kernel.build import check
from torchfra.kernel.expressions import ZERO, Expressions

SCALARS = {torch.float64: "double", torch.float32: "float"}


@dataclass
class Port:
    """A tensor that a kernel reads or writes: its entries for one track (and one step) by number."""

    ids: list[int]
    shape: torch.Size
    """Of a track's (and step's) entries."""
    timed: bool = False
    """Whether each step has entries of its own."""
    packed: bool = False
    """Whether the same entry of neighbouring tracks lies side by side, as in what kernels write."""
    truth: bool = False
    """Whether it holds truth values."""


@dataclass
class Scan:
    """A loop over time.

    Args:
        book: where all expressions stand.
        carry: what goes from step to step, as a step sees it; entries that are 0 stay so.
        after: the same when the step is done.
        reads: what else a step knows.
        writes: what each step leaves behind.
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
        """All that is needed, in an order in which it can be computed."""
        needed: set[int] = set()
        todo = [i for port in [*self.after, *self.writes] for i in port.ids]
        while todo:
            number = todo.pop()
            if number not in needed:
                needed.add(number)
                todo += self.book.nodes[number][1]
        return sorted(needed)

    def source(self) -> str:
        """The whole translation unit."""
        live = self.live()
        check(len(live))
        varies = {i for port in [*self.carry, *(r for r in self.reads if r.timed)] for i in port.ids if i != ZERO}
        for number in live:
            if varies.intersection(self.book.nodes[number][1]):
                varies.add(number)
        wanted, first = set(live), len(self.carry)
        fixed = self._loads(False, wanted) + [self._statement(i) for i in live if i not in varies]
        step = self._loads(True, wanted) + [self._statement(i) for i in live if i in varies]
        held = [(p, e, i) for p, port in enumerate(self.carry) for e, i in enumerate(port.ids) if i != ZERO]
        begin = [f"V c{p}_{e} = get(in[{p}], {e}, at);" for p, e, _ in held]
        body = [f"const V v{i} = c{p}_{e};" for p, e, i in held if i in wanted] + step
        for p, port in enumerate(self.writes, first):
            for e, i in enumerate(port.ids):
                body.append(
                    f"mark(out[{p}], {e}, {self._mask(i)}, at);"
                    if port.truth
                    else f"put(out[{p}], {e}, {self._value(i)}, at);"
                )
        body += [f"c{p}_{e} = {self._value(self.after[p].ids[e])};" for p, e, _ in held]
        end = [f"put(out[{p}], {e}, {f'c{p}_{e}' if i != ZERO else 'all(0)'}, at);"
               for p, port in enumerate(self.carry) for e, i in enumerate(port.ids)]  # fmt: skip
        functions = "".join((_UNARY if count == 1 else _BINARY).format(name) for name, count in _FUNCTIONS.items())
        text = (
            _TEMPLATE.replace("FUNCTIONS", functions)
            .replace("SCALAR", SCALARS[self.dtype])
            .replace("TIME", "steps - 1 - k" if self.backwards else "k")
        )
        for name, group in {"FIXED": begin + fixed, "STEP": body, "END": end}.items():
            text = text.replace(f"    // {name}\n", "".join(f"    {line}\n" for line in group if line))
        return text

    def _loads(self, timed: bool, wanted: set[int]) -> list[str]:
        return [
            f"const V v{i} = {'load' if port.packed else 'get'}(in[{p}], {e}, at);"
            for p, port in enumerate(self.reads, len(self.carry))
            if port.timed == timed
            for e, i in enumerate(port.ids)
            if i in wanted and i != ZERO
        ]

    def _value(self, number: int) -> str:
        if number in self.book.values:
            value = self.book.values[number]
            text = (
                repr(value)
                if math.isfinite(value)
                else "NAN"
                if math.isnan(value)
                else f"{'-' if value < 0 else ''}INFINITY"
            )
            return f"all({text})"
        return f"v{number}"

    def _mask(self, number: int) -> str:
        if number in self.book.values:
            return "(all(1.0) > all(0.0))" if self.book.values[number] else "(all(0.0) > all(1.0))"
        return f"v{number}"

    def _statement(self, number: int) -> str:
        op, args = self.book.nodes[number]
        if op in ("constant", "input"):
            return ""
        truth = self.book.is_bool(number)
        if op in ("and", "or", "not"):
            a = [self._mask(i) for i in args]
            text = f"~{a[0]}" if op == "not" else f"{a[0]} {'&' if op == 'and' else '|'} {a[1]}"
        elif op == "select":
            a = [self._mask(args[0])] + [self._mask(i) if truth else self._value(i) for i in args[1:]]
            text = f"{a[0]} ? {a[1]} : {a[2]}"
        else:
            a = [self._value(i) for i in args]
            sign = _OPERATORS.get(op)
            text = f"{a[0]} {sign} {a[1]}" if sign else f"-{a[0]}" if op == "neg" else f"{op}_({', '.join(a)})"
        return f"const {'M' if truth else 'V'} v{number} = {text};"


_OPERATORS = {"add": "+", "sub": "-", "mul": "*", "div": "/", "lt": "<", "le": "<=", "eq": "=="}

_FUNCTIONS = {"sqrt": 1, "abs": 1, "exp": 1, "expm1": 1, "log": 1, "log1p": 1, "erf": 1, "sin": 1, "cos": 1, "tan": 1,
              "asin": 1, "acos": 1, "atan": 1, "sinh": 1, "cosh": 1, "tanh": 1, "round": 1, "floor": 1, "ceil": 1,
              "trunc": 1, "atan2": 2, "hypot": 2, "pow": 2}  # fmt: skip
"""What torch's vectors can do, with the number of their arguments."""

_UNARY = "inline V {0}_(const V& a) {{ return raw(vec(a).{0}()); }}\n"
_BINARY = "inline V {0}_(const V& a, const V& b) {{ return raw(vec(a).{0}(vec(b))); }}\n"
_TEMPLATE = """\
#if defined(__AVX512F__) && defined(__AVX512BW__) && defined(__AVX512DQ__) && defined(__AVX512VL__)
#define CPU_CAPABILITY_AVX512
#elif defined(__AVX2__) && defined(__FMA__)
#define CPU_CAPABILITY_AVX2
#endif
#include <ATen/cpu/vec/vec.h>
#include <cmath>
#include <cstdint>

namespace {
using Scalar = SCALAR;
using Vec = at::vec::Vectorized<Scalar>;
constexpr int64_t W = Vec::size();
typedef Scalar V __attribute__((vector_size(W * sizeof(Scalar))));
typedef decltype(V() < V()) M;

// A tensor: where it is, and how far it is to the next track, the next step, the next entry.
struct Port { char* data; int64_t track, time, entry; };
// A block of tracks at a step; those beyond the last are the last once more.
struct Block { int64_t first, lanes, step; };

template <class T> inline T* at_(const Port& p, int64_t entry, const Block& at) {
  return reinterpret_cast<T*>(p.data) + at.first * p.track + at.step * p.time + entry * p.entry;
}
inline V all(Scalar a) { return V{} + a; }
__attribute__((noinline)) V get(const Port& p, int64_t entry, const Block& at) {
  const Scalar* from = at_<Scalar>(p, entry, at);
  if (p.track == 0) return all(*from);
  V v;
  for (int64_t i = 0; i < W; i++) v[i] = from[(i < at.lanes ? i : at.lanes - 1) * p.track];
  return v;
}
inline V load(const Port& p, int64_t entry, const Block& at) {
  if (at.lanes < W) return get(p, entry, at);
  V v;
  __builtin_memcpy(&v, at_<Scalar>(p, entry, at), sizeof v);
  return v;
}
inline void put(const Port& p, int64_t entry, const V& v, const Block& at) {
  __builtin_memcpy(at_<Scalar>(p, entry, at), &v, at.lanes < W ? at.lanes * sizeof(Scalar) : sizeof v);
}
inline void mark(const Port& p, int64_t entry, const M& v, const Block& at) {
  bool* to = at_<bool>(p, entry, at);
  for (int64_t i = 0; i < at.lanes; i++) to[i] = v[i] != 0;
}
inline Vec vec(const V& a) { return Vec::loadu(&a); }
inline V raw(const Vec& a) { V r; a.store(&r); return r; }
FUNCTIONSinline V max_(const V& a, const V& b) { return (a > b) | (a != a) ? a : b; }
inline V min_(const V& a, const V& b) { return (a < b) | (a != a) ? a : b; }

void block(const Port* in, const Port* out, int64_t steps, Block at) {
    // FIXED
  for (int64_t k = 0; k < steps; k++) {
    at.step = TIME;
    // STEP
  }
  at.step = 0;
    // END
}
}  // namespace

extern "C" void run(int64_t tracks, int64_t steps, int threads, const Port* in, const Port* out) {
#pragma omp parallel for num_threads(threads) schedule(static)
  for (int64_t first = 0; first < tracks; first += W)
    block(in, out, steps, Block{first, tracks - first < W ? tracks - first : W, 0});
}
"""

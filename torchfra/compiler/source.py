"""A loop over time whose step is expressions: as instructions of LLVM, or as C++."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch

from torchfra.compiler.cpp import file, template, texts
from torchfra.compiler.expressions import ZERO, Expressions
from torchfra.compiler.instructions import Lanes
from torchfra.compiler.llvm import lanes_of
from torchfra.compiler.native import Native
from torchfra.compiler.pages import PAST
from torchfra.compiler.plan import Access, Loop, Plan
from torchfra.compiler.rewrites import with_choices_last, with_masked, with_quotients
from torchfra.compiler.schedule import Condition, conditions, regions
from torchfra.compiler.sharing import kernel, module
from torchfra.compiler.tensor_entries import functions

SCALARS = {torch.float64: "double", torch.float32: "float"}
"""The dtypes that kernels compute in, and what C++ calls them."""
THREADS = 128
"""Threads of a block on a GPU."""
_PART = 1500
"""Expressions of a function in C++ for a CPU, about."""
_PIECE, _LONG = 6000, 20_000
"""Expressions of a function there, about; and those of a step whose functions are called: one of all takes too long to
compile."""


@dataclass
class Port:
    """A tensor that a kernel reads or writes: the expressions of its entries, for one track (and one step)."""

    ids: list[int]
    shape: torch.Size
    """Shape of the entries of a track (and step)."""
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
        rare: conditions that few tracks meet: what is 0 unless they do is computed for those alone.

    The kernel reads ``carry`` and ``reads``, and writes ``after`` (once) and ``writes``, in this order.
    """

    book: Expressions
    carry: list[Port]
    after: list[Port]
    reads: list[Port]
    writes: list[Port]
    backwards: bool = False
    dtype: torch.dtype = torch.float64
    rare: Collection[Condition] = ()

    def live(self) -> list[int]:
        """The expressions that are needed, in an order in which they can be computed."""
        return self.book.needed([*self._carried().values(), *(i for port in self.writes for i in port.ids)])

    def regions(self) -> set[Condition]:
        """The conditions of what only some tracks need."""
        live, ends = self.live(), [*self._carried().values(), *(i for port in self.writes for i in port.ids)]
        guards = regions(self.book, live, conditions(self.book, live, ends)).values()
        return {guard for guard in guards if guard is not None}

    def native(self, lanes: Lanes, name: str = "") -> Native:
        """The functions of a block of tracks, in instructions; their names begin with ``name``."""
        return Native(self.loop(), lanes, self.backwards, name)

    def source(self, narrow: bool = False) -> str:
        """The module of LLVM, whose function is ``run``; ``narrow``: for one track, in numbers."""
        lanes = lanes_of(self.dtype, narrow)
        block, (common, declared) = self.native(lanes), functions(lanes)
        run, more = kernel(lanes, block.block, block.plan.packs, block.written, PAST)
        return module([*common, *block.texts, *run], declared | block.declared | more)

    def cuda(self) -> str:
        """The same in C++ for a GPU: a thread for each track, whose tensors come as an argument by value."""
        plan = Plan(self.loop(), True, _PIECE)
        length = sum(len(piece.numbers) for piece in plan.steps)
        counts = {
            "INPUTS": len(self.carry + self.reads),
            "OUTPUTS": len(self.after + self.writes),
            "THREADS": THREADS,
            "BLOCKS": 3 if length > _PIECE // 2 else 2,
        }
        run = file("cuda.cpp")
        for word, count in counts.items():
            run = run.replace(word, str(count))
        return "".join(
            ("#define LONG\n" if length > _LONG else "", *self._parts("step", plan, length > _PIECE // 2), run)
        )

    def parts(self, name: str) -> tuple[str, str]:
        """In C++ for one track: what any scan of this dtype needs, and the namespace of this one with ``block``."""
        return self._parts(name, Plan(self.loop(), True, _PART))

    def _parts(self, name: str, plan: Plan, in_step: bool = False) -> tuple[str, str]:
        head, block = (text.replace("SCALAR", SCALARS[self.dtype]) for text in template())
        block = block.replace("TIME", "steps - 1 - k" if self.backwards else "k").replace("NAME", name)
        for word, text in texts(plan, in_step).items():
            block = block.replace(word, text)
        return head, block

    def loop(self) -> Loop:
        """The step as its writer needs it, without what it need not compute each time."""
        carry = [(i, p, e) for p, port in enumerate(self.carry) for e, i in enumerate(port.ids)]
        stores = self._stores()
        written = [*self._carried().values(), *(i for i, _ in stores)]
        book, live = with_masked(self.book, self.live(), self.rare, written)
        varying, same = self._varying(book, live), self._same(live)
        carried = {i: j for i, j in self._carried().items() if i not in same}
        outputs = [*carried.values(), *(i for i, _ in stores)]
        book, live = with_choices_last(*with_quotients(book, live, varying, outputs), varying, outputs)
        return Loop(
            book,
            live,
            varying.intersection(live),
            carried,
            {i: Access("in", p, e) for i, p, e in carry if i in carried},
            self._loads(),
            stores,
            [(same.get(i, i), Access("out", p, e)) for i, p, e in carry],
        )

    def _carried(self) -> dict[int, int]:
        """What goes from step to step, with what takes its place after the step."""
        pairs = zip(self.carry, self.after, strict=True)
        return {i: j for old, new in pairs for i, j in zip(old.ids, new.ids, strict=True) if i != ZERO}

    def _same(self, live: Sequence[int]) -> dict[int, int]:
        """What no step reads and what after each step is the same: it is not carried itself."""
        read, carried = set(live), self._carried()
        others = {j: i for i, j in sorted(carried.items(), key=lambda pair: pair[0] in read)}
        return {i: others[j] for i, j in carried.items() if i not in read and others[j] != i}

    def _varying(self, book: Expressions, live: Sequence[int]) -> set[int]:
        """The expressions that change from step to step; all others are computed once, before the loop."""
        ports = [*self.carry, *(port for port in self.reads if port.timed)]
        varying = {i for port in ports for i in port.ids if i != ZERO}
        for number in live:
            if varying.intersection(book.nodes[number][1]):
                varying.add(number)
        return varying

    def _loads(self) -> dict[int, Access]:
        return {
            i: Access("in", p, e, "double" if port.double else "Scalar", port.packed)
            for p, port in enumerate(self.reads, len(self.carry))
            for e, i in enumerate(port.ids)
            if i != ZERO
        }

    def _stores(self) -> list[tuple[int, Access]]:
        return [
            (i, Access("out", p, e, "bool" if port.truth else "Scalar"))
            for p, port in enumerate(self.writes, len(self.carry))
            for e, i in enumerate(port.ids)
        ]

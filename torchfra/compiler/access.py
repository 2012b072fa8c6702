"""What a step computes, reads and writes."""

from __future__ import annotations

from typing import NamedTuple

from torchfra.compiler.expressions import Expressions


class Access(NamedTuple):
    """An entry of a tensor that is read or written."""

    port: str
    type: str
    """Type of the entries."""
    how: str
    """The function that does it."""
    entry: int
    step: str = "step"
    """Field of ``Block``: ``step``, or ``before`` for the step before."""

    @property
    def name(self) -> str:
        """Name of the tensor in a function."""
        return self.port.replace("[", "").replace("]", "").replace("out", "late" if self.step == "before" else "out")

    @property
    def opened(self) -> str:
        """The line that declares the tensor."""
        return f"const Entries<{self.type}> {self.name}({self.port}, at, at.{self.step});"


class Step(NamedTuple):
    """What is computed, read and written.

    Args:
        book: the expressions.
        live: those that are needed, arguments first.
        varying: those of them that change from step to step.
        carried: what goes from step to step, with what takes its place after a step.
        first: how the carried is read before the first step.
        loads: how inputs are read.
        stores: what is written at each step.
        end: what is carried out of the last step; 0 where nothing is carried.
    """

    book: Expressions
    live: list[int]
    varying: set[int]
    carried: dict[int, int]
    first: dict[int, Access]
    loads: dict[int, Access]
    stores: list[tuple[int, Access]]
    end: list[tuple[int, Access]]

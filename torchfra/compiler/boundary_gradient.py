"""The gradient pass before and after the steps of a track: gradients of the last state, and of the prior."""

from __future__ import annotations

from collections.abc import Sequence

from torchfra.compiler.boundary import LAST, PRIOR, Boundary, Traced
from torchfra.compiler.entries import Entries, as_entries, entry_ids
from torchfra.compiler.source import Port, Scan
from torchfra.compiler.step import pullback
from torchfra.linalg.tracing import elementary
from torchfra.tree import flatten


def after_back(boundary: Boundary, needed: Sequence[str], graded: Sequence[int]) -> Scan | None:
    """From the gradients of what ends the records ``graded`` to those of the last state and of ``needed`` inputs.

    Reads the values among the inputs, the last state and the gradients.  None where that is nothing.
    """
    if not graded:
        return None
    at = boundary.traced(LAST, *needed)
    made = dict(zip(boundary.places, flatten(at.made), strict=True))
    last = [as_entries(at.book, made[place][1]) for place in graded]
    grads = [Entries.inputs(at.book, x.shape, boundary.step.dtype) for x in last]
    sources = [*at.after, *(at.inputs[name] for name in needed)]
    if not any(x.requires_grad for x in last):
        return None
    with elementary():
        pulled = pullback(at.book, last, grads, sources)
    return _scan(boundary, at, [*at.after, *grads], pulled)


def begin_back(boundary: Boundary, needed: Sequence[str], prior: Sequence[str]) -> Scan | None:
    """From the gradients of the first state to those of ``prior`` (out of ``PRIOR``) and ``needed`` inputs.

    Reads the values among the inputs, the prior, the gradients of the state and what is known already of those of the
    inputs, to which it adds.  None where none of them matters to the first state.
    """
    at = boundary.traced(*prior, *needed)
    if not any(x.requires_grad for x in at.begun):
        return None
    grads = [Entries.inputs(at.book, x.shape, boundary.step.dtype) for x in at.begun]
    sums = [Entries.inputs(at.book, at.inputs[name].shape, boundary.step.dtype) for name in needed]
    chosen = [x for name, x in zip(PRIOR, at.prior, strict=True) if name in prior]
    count, sources = len(chosen), [*chosen, *(at.inputs[name] for name in needed)]
    with elementary():
        pulled = pullback(at.book, at.begun, grads, sources)
    totals = [as_entries(at.book, a + b) for a, b in zip(sums, pulled[count:], strict=True)]
    return _scan(boundary, at, [*at.prior, *grads, *sums], [*pulled[:count], *totals])


def _scan(boundary: Boundary, at: Traced, reads: Sequence[Entries], writes: Sequence[Entries]) -> Scan:
    """A loop of one step, which reads the values among the inputs first."""
    inputs = boundary.step.inputs.items()
    values = [Port(entry_ids(at.inputs[name]), x.shape, double=x.double) for name, x in inputs if x.value]
    ports, written = ([Port(entry_ids(x), x.shape) for x in tensors] for tensors in (reads, writes))
    return Scan(at.book, [], [], [*values, *ports], written, dtype=boundary.step.dtype)

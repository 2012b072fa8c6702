"""Functions of a choice between values that stay are choices between functions, which are computed before the steps."""

import torch

from torchfra.compiler.expressions import Expressions
from torchfra.compiler.program import Program
from torchfra.compiler.rewrites import with_choices_last
from torchfra.compiler.source import Port, Scan


def step():
    """``log(m ? a : 1) + (m ? 1 : 0) / (m ? a : 1)``: ``m = x != 2``, ``x`` is of each step, and ``a`` stays."""
    book = Expressions()
    x, a, one = book.input(), book.input(), book.constant(1.0)
    mask = book.apply("not", book.apply("eq", x, book.constant(2.0)))
    scale, seen = book.apply("select", mask, a, one), book.apply("select", mask, one, book.constant(0.0))
    end = book.apply("add", book.apply("log", scale), book.apply("div", seen, scale))
    reads = [Port([x], torch.Size([]), timed=True), Port([a], torch.Size([]))]
    return Scan(book, [], [], reads, [Port([end], torch.Size([]), timed=True)])


def test_no_step_computes_what_stays():
    scan = step()
    x, end = scan.reads[0].ids[0], scan.writes[0].ids[0]
    varying = {i for i in scan.live() if depends(scan.book, i, x)}
    book, live = with_choices_last(scan.book, scan.live(), varying, [end])
    each = [book.nodes[i][0] for i in live if depends(book, i, x)]
    assert sorted(each) == ["eq", "input", "select"]
    assert scan.book.nodes[end][0] == "add"  # the book that was given has not changed


def test_values_are_the_same():
    a, x = torch.tensor([0.5, 3.0]).double(), torch.tensor([[1.0, 2.0, torch.nan], [2.0, 0.0, 5.0]]).double()
    (found,) = Program(step())(torch.Size([2]), 3, [x, a])
    expected = torch.where(x != 2, a.log().unsqueeze(-1) + 1 / a.unsqueeze(-1), 0.0)
    torch.testing.assert_close(found.mT, expected, rtol=1e-14, atol=0)


def depends(book, number, on):
    """Whether an expression depends on another one."""
    return number == on or any(depends(book, i, on) for i in book.nodes[number][1])

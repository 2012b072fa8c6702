"""What only some tracks need is computed for those alone, and no result shows it."""

import copy
import math
import operator
import random

import pytest
import torch
from alike import both, close
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra.compiler import schedule
from torchfra.compiler.expressions import ZERO, Expressions, Routine
from torchfra.compiler.plan import Plan, frame, needs
from torchfra.compiler.program import Program
from torchfra.compiler.rewrites import with_masked, with_merged
from torchfra.compiler.schedule import cut, pieces
from torchfra.compiler.source import Port, Scan

OPERATORS = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "neg": operator.neg, "abs": abs, "max": max,
    "lt": operator.lt, "le": operator.le, "and": lambda a, b: bool(a and b), "or": lambda a, b: bool(a or b),
    "not": operator.not_, "select": lambda mask, yes, no: yes if mask else no, "norm": math.hypot, "same": lambda x: x,
}  # fmt: skip
NUMBERS, TESTS, LOGIC = ("add", "sub", "mul", "neg", "abs", "norm"), ("lt", "le"), ("and", "or", "not")


def a_routine():
    """From two numbers to their sum and the product of it with the first."""
    book = Expressions()
    inputs = [book.input(), book.input()]
    total = book.apply("add", *inputs)
    return Routine("both_r0", book, inputs, [total, book.apply("mul", total, inputs[0])], [total, total + 1], 2)


ROUTINE = a_routine()


def make_small(change):
    change(schedule, "_WORTH", 1)
    change(schedule, "_SHARE", 0.0)
    change(schedule, "_PIECE", 6)


def random_step(seed, length=120):
    """A step of random operations, many of them choices: the book, what it carries (before, after), reads, writes."""
    draw, book = random.Random(seed), Expressions()
    carried, read = [book.input() for _ in range(3)], [book.input() for _ in range(4)]
    numbers, truths = [*carried, *read, book.constant(0.5)], []
    for _ in range(length):
        kind = draw.choice(["number", "number", "number", "test", "logic", "select", "select", "call"])
        if kind == "number" or not truths:
            op = draw.choice(NUMBERS)
            made = book.apply(op, *draw.choices(numbers, k=1 if op in ("neg", "abs") else 2))
            numbers.append(made)
            truths += [] if truths else [book.apply("lt", *draw.choices(read, k=1), made)]
        elif kind == "call":
            numbers += book.call(ROUTINE, draw.choices(numbers, k=2))
        elif kind == "select":
            numbers.append(book.apply("select", draw.choice(truths), *draw.choices(numbers[-12:], k=2)))
        else:
            op, among = (draw.choice(TESTS), numbers) if kind == "test" else (draw.choice(LOGIC), truths)
            truths.append(book.apply(op, *draw.choices(among[-12:], k=1 if op == "not" else 2)))
    after = [book.apply("max", book.apply("min", i, book.constant(1.0)), book.constant(-1.0)) for i in numbers[-3:]]
    return book, carried, after, read, [i for i in numbers[-6:] if i not in carried]


def scan_of(seed, length=120):
    book, carried, after, read, written = random_step(seed, length)

    def port(ids, timed):
        return Port(ids, torch.Size([len(ids)]), timed)

    return Scan(book, [port(carried, False)], [port(after, False)], [port(read, True)], [port(written, True)])


def evaluated(book, values, numbers):
    """Values of expressions, each computed from those it acts on; ``values`` has the inputs, and grows."""
    for number in numbers:
        op, args = book.nodes[number]
        if op == "constant":
            values[number] = book.values[number]
        elif op == "call":
            routine = book.calls[number]
            inner = evaluated(
                routine.book, dict(zip(routine.inputs, (values[i] for i in args), strict=True)), routine.live
            )
            values[number] = [inner[i] for i in routine.outputs]
        elif op == "result":
            values[number] = values[args[0]][book.places[number]]
        elif op != "input":
            known = [values[i] for i in args]
            values[number] = min(known) if op == "min" else OPERATORS[op](*known)
    return values


@settings(max_examples=150, deadline=None)
@given(st.integers(0, 10**9), st.lists(st.floats(-2, 2), min_size=7, max_size=7))
def test_pieces_and_places_lose_nothing_that_a_track_needs(seed, inputs):
    """A step by its pieces, where a track that fails the guard finds rubbish, is the step computed straight."""
    book, carried, after, read, written = random_step(seed)
    step = scan_of(seed)
    live, next_one = step.live(), dict(zip(carried, after, strict=True))
    expected = evaluated(book, dict(zip([*carried, *read], inputs, strict=True)), live)
    stepped = [i for i in live if i not in carried and i not in book.values]
    with pytest.MonkeyPatch.context() as patch:
        make_small(patch.setattr)
        ends = [*after, *written]
        parts = pieces(book, stepped, ends)
        book, parts, merged = with_merged(book, parts)
    layout = frame(book, [], parts, next_one, ends, merged)
    at = {i: ("left", place) for i, place in layout.left.items()} | {i: ("s", k) for i, k in layout.places.items()}
    assert max(layout.places.values()) < layout.size
    memory = {at[i]: value for i, value in zip(carried, inputs, strict=False)}
    found = {}
    guard = None
    for part in parts:
        if part.guard != guard and guard is not None:  # by now other packs have used the places of all
            memory = {place: value for place, value in memory.items() if place[0] == "left" or place[1] < layout.own}
        guard = part.guard
        values = {i: memory.get(("s", layout.places[i]), math.nan) for i in needs(book, part)} | book.values
        if part.guard is not None and bool(values[part.guard[0]]) != part.guard[1]:
            continue  # what lies in the places of its results stays
        values |= {i: expected[i] for i in part.numbers if i in read}
        evaluated(book, values, part.numbers)
        for late in (False, True):
            memory |= {at[i]: values[i] for i in part.numbers if i in at and (i in layout.late) == late}
        found |= {i: values[i] for i in part.numbers if i in written}
    sources = {i: memory[at[i]] for i, _ in layout.moves if i in at} | book.values
    found |= {i: memory[at[i]] for i in written if i in merged.values()}
    memory |= {("s", place): sources[i] for i, place in layout.moves}
    assert all(found[i] == expected[i] for i in written if i in found)
    for old, new in next_one.items():
        assert memory[at[old]] == expected[new]


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 10**9), st.lists(st.floats(-2, 2), min_size=7, max_size=7))
def test_masking_changes_no_value(seed, inputs):
    draw = random.Random(seed)
    book, carried, _, read, written = random_step(seed)
    truths = [i for i in book.truths if i not in book.values]
    rare = [(draw.choice(truths), draw.random() < 0.5) for _ in range(3)]
    known = [i for i in range(len(book.nodes)) if not book.is_bool(i) and i not in book.calls]
    numbers = [book.apply("select", mask, *((i, ZERO) if value else (ZERO, i)))
               for mask, value in rare for i in draw.choices(known, k=3)]  # fmt: skip
    for _ in range(30):
        numbers.append(book.apply(draw.choice(("add", "sub", "mul")), draw.choice(numbers), draw.choice(numbers[-9:])))
    ends = [*written, *numbers[-9:]]
    live, values = book.needed(ends), dict(zip([*carried, *read], inputs, strict=True))
    new, order = with_masked(book, live, rare, ends)
    found, expected = evaluated(new, {**values}, order), evaluated(book, {**values}, live)
    assert all(found[i] == expected[i] or not math.isfinite(expected[i]) for i in ends)


def test_cutting_keeps_every_expression_and_no_piece_is_long():
    book, *_ = random_step(1, 9000)
    numbers = list(range(len(book.nodes)))
    parts = cut(book, numbers)
    assert [i for part in parts for i in part] == numbers
    assert max(map(len, parts)) <= schedule._PIECE * 3 // 2
    assert cut(book, []) == []


@pytest.mark.parametrize("tracks", [1, 37, 500])
def test_kernels_with_and_without_regions_say_the_same(tracks, monkeypatch):
    """37 and 500 tracks: no multiple of a register; most packs have tracks on both sides of each choice."""
    draw = torch.Generator().manual_seed(0)
    tensors = [torch.rand(tracks, *shape, dtype=torch.float64, generator=draw) * 4 - 2 for shape in ((3,), (5, 4))]
    whole = program(tracks)
    assert "@guarded" not in scan_of(7, 400).source()
    make_small(monkeypatch.setattr)
    assert scan_of(7, 400).source().count("@guarded") > 3
    parts = program(tracks)
    for a, b in zip(*(p(torch.Size([tracks]), 5, tensors) for p in (whole, parts)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def program(tracks):
    return Program(scan_of(7, 400), narrow=tracks == 1)


# ---------------------------------------------------------------- filters


@pytest.mark.parametrize("gate", [1e9, 1.0, 1e-9], ids=["all normal", "some abnormal", "all abnormal"])
def test_a_filter_that_forks_is_the_same_however_many_steps_are_abnormal(make, scenario, gate):
    f = make("fra", gate=gate)
    fast = copy.deepcopy(f).compile()
    for runs in (1, 13, 150):
        t = scenario.simulate(runs, 1)
        z = t.z[:, :8].clone()
        z[:, 4, 0] = z[0, 6] = torch.nan
        expected, found = f(z, t.prior, u=t.u[:8]), fast(z, t.prior, u=t.u[:8])
        close(expected, found)
        share = expected.info.abnormal.double().mean()
        assert share == 0 if gate > 1e8 else share > (0.8 if gate < 1e-8 else 0.2)


@pytest.mark.slow
def test_gradients_through_a_choice_are_the_same(make, tracks):
    f = make("fra", gate=1.0, learn=("threshold",))
    gradients = []
    for g in (f, copy.deepcopy(f).compile()):
        g(tracks.z, tracks.prior, u=tracks.u).mean.square().mean().backward()
        gradients.append([p.grad for p in g.parameters()])
    close(*gradients)


@pytest.mark.slow
def test_the_gradient_of_a_branch_is_computed_where_the_branch_is(make, tracks, monkeypatch):
    shares, source = [], Scan.source

    def planned(scan, narrow=False):
        shares.append(Plan(scan.loop(), narrow).guarded)
        return source(scan, narrow)

    monkeypatch.setattr(Scan, "source", planned)
    make("fra", learn=("threshold",)).compile()(tracks.z, tracks.prior, u=tracks.u).mean.sum().backward()
    assert len(shares) == 2  # the filter and its gradient
    assert min(shares) > 0.5


def test_a_track_that_fails_in_its_branch_leaves_its_neighbours_alone(make, scenario):
    f, t = make("fra", gate=1.0), scenario.simulate(16, 2)
    z = t.z[:, :6].clone()
    z[3, 2] = torch.inf
    expected, found = both(f, z, t.prior, u=t.u[:6])
    others = [i for i in range(16) if i != 3]
    assert (expected.failure.step >= 0).tolist() == (found.failure.step >= 0).tolist() == [i == 3 for i in range(16)]
    close(expected.mean[others], found.mean[others])
    close(expected.scale_tril[others], found.scale_tril[others])

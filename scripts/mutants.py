"""Mutation score: how many small errors, put into the code one at a time, some test finds.

An operator, comparison, number, call or statement is changed, and the tests that run the changed function are tried
until one fails.  What survives is a missing test, a redundant line, or a change that makes no difference.  No file is
changed: each mutant lives in a process of its own, forked after the tests were collected, and needs no imports.
"""

from __future__ import annotations

import argparse
import ast
import copy
import gc
import hashlib
import json
import os
import random
import resource
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from types import CodeType, FunctionType
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("linalg", "gaussian", "robust", "adaptive", "motion", "sensors", "association", "steps", "filters")
TESTS = """
    linalg gaussian robust motion sensors association filters presets alarms failed_steps certainty hessian check_model
    late_scans numbers compile divisions long_tracks processors ready_gradients ready_steps regions second_order
    tangents written_functions poses
"""
"""Folders and files of tests about what a filter computes; others reach these rooms through them."""
PATIENCE = 10
"""A test that takes so many times as long as without the mutant, and as many seconds more, hangs."""

SWAPPED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE,
    ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn,
    ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
REVERSED = {ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt}
CALLS = {"amax": "amin", "amin": "amax", "all": "any", "any": "all", "clamp_min": "clamp_max", "clamp_max": "clamp_min",
         "max": "min", "min": "max", "minimum": "maximum", "maximum": "minimum", "logsumexp": "sum"}  # fmt: skip
UNDONE = {"detach", "abs", "sqrt", "square", "exp", "log", "tril", "triu"}
"""Methods without which a call is what they were called on."""

UNCHANGED = ("annotation", "returns", "decorator_list", "bases", "keywords")


def variants(node: ast.AST) -> Iterator[ast.AST]:
    """What takes the place of a part of the code, one mutant each."""
    match node:
        case ast.BinOp(op=op) | ast.AugAssign(op=op) | ast.BoolOp(op=op) if type(op) in SWAPPED:
            yield changed(node, op=SWAPPED[type(op)]())
        case ast.Compare(ops=[op]):
            yield changed(node, ops=[SWAPPED[type(op)]()])
            if type(op) in REVERSED:
                yield changed(node, ops=[REVERSED[type(op)]()])
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            yield node.operand
        case ast.Constant(value=bool(value)):
            yield changed(node, value=not value)
        case ast.Constant(value=int(value)):
            yield changed(node, value=value + 1)
        case ast.Constant(value=float(value)):
            yield changed(node, value=2 * value if value else 1.0)
        case ast.Call(func=ast.Attribute(attr="where"), args=[condition, first, second]):
            yield changed(node, args=[condition, second, first])
        case ast.Call(func=ast.Attribute(attr=name) as function) if name in CALLS:
            yield changed(node, func=changed(function, attr=CALLS[name]))
        case ast.Call(func=ast.Attribute(value=on, attr=name), args=[] | [ast.Constant()]) if name in UNDONE:
            if getattr(on, "id", "") not in ("math", "torch"):
                yield on
        case ast.Attribute(attr="mT", value=on):
            yield on
        case ast.IfExp(test=test) | ast.If(test=test):
            yield changed(node, test=ast.copy_location(ast.UnaryOp(ast.Not(), test), test))
        case ast.Return(value=value) if value is not None:
            yield changed(node, value=ast.copy_location(ast.Constant(None), value))
        case ast.Raise() | ast.AugAssign() | ast.Continue() | ast.Break() | ast.Expr(value=ast.Call()):
            yield ast.copy_location(ast.Pass(), node)
    if isinstance(node, ast.AugAssign):
        yield ast.copy_location(ast.Pass(), node)


def changed(node: ast.AST, **fields: object) -> ast.AST:
    """The same node with other fields."""
    other = copy.copy(node)
    for name, value in fields.items():
        setattr(other, name, value)
    return other


class Mutant(NamedTuple):
    """One change of one file."""

    path: Path
    line: int
    text: str
    tree: ast.Module
    """The whole file, without the change."""
    put: Callable[[], None]
    """Changes the tree, for good."""
    function: tuple[int, str] | None
    """First line and name of the function around the change; None for a value of a module or class."""
    lines: range
    """Of the statement that is changed, without those of its body."""

    @property
    def where(self) -> str:
        """File and line."""
        return f"{self.path.relative_to(ROOT)}:{self.line}"


def mutants(path: Path) -> Iterator[Mutant]:
    """All mutants of a file."""
    tree = ast.parse(path.read_text(encoding="utf-8"))

    def within(node: ast.AST, around: ast.FunctionDef | None, statement: ast.stmt | None) -> Iterator[Mutant]:
        for field, value in ast.iter_fields(node):
            if field in UNCHANGED and not isinstance(node, ast.Call):
                continue
            for i, part in enumerate(value if isinstance(value, list) else [value]):
                if not isinstance(part, ast.AST) or is_text(part):
                    continue
                inner = part if isinstance(part, ast.FunctionDef) else around
                whole = part if isinstance(part, ast.stmt) else statement
                for other in variants(part):
                    text = f"{short(part)}  ->  {short(other)}"
                    change = partial(place, node, field, i, other)
                    yield Mutant(path, part.lineno, text, tree, change, inner and key(inner), header(whole, part))  # type: ignore[attr-defined]
                if not isinstance(part, (ast.Raise, ast.Assert, ast.JoinedStr)):
                    yield from within(part, inner, whole)

    yield from within(tree, None, None)


def key(function: ast.FunctionDef) -> tuple[int, str]:
    """First line, decorators included, and name of a function, as its code has them."""
    return min([function.lineno, *(d.lineno for d in function.decorator_list)]), function.name


def header(statement: ast.stmt, part: ast.AST) -> range:
    """The lines of a statement up to those of a part in front of its body; all of a function, whose values it has."""
    last = getattr(part, "test", part) if hasattr(statement, "body") else statement
    last = statement if isinstance(statement, ast.FunctionDef) else last
    return range(statement.lineno, (getattr(last, "end_lineno", None) or statement.lineno) + 1)


def place(node: ast.AST, field: str, i: int, part: ast.AST) -> None:
    """Puts a part into a field of a node, or into the list there."""
    if isinstance(getattr(node, field), list):
        getattr(node, field)[i] = part
    else:
        setattr(node, field, part)


def is_text(node: ast.AST) -> bool:
    """Whether this is a docstring, an import, the list of public names or an assertion that lists are as long."""
    if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
        return True
    if isinstance(node, ast.keyword) and node.arg == "strict":
        return True
    is_string = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return is_string or isinstance(node, (ast.Import, ast.ImportFrom))


def short(node: ast.AST) -> str:
    """The first line of the code of a node."""
    return " ".join(ast.unparse(ast.fix_missing_locations(node)).split())[:100]


# ---------------------------------------------------------------- a mutant in the place of the code


def put_in(mutant: Mutant, known: dict[str, list[FunctionType]]) -> None:
    """Changes this process: code and defaults of all functions of the file, values of its module and classes."""
    file = str(mutant.path)
    mutant.put()
    code = compile(ast.fix_missing_locations(mutant.tree), file, "exec")
    new = {(c.co_firstlineno, c.co_name): c for c in codes(code)}
    for function in known[file]:
        code = new.get((function.__code__.co_firstlineno, function.__code__.co_name), function.__code__)
        if code.co_freevars == function.__code__.co_freevars:
            function.__code__ = code
        elif (code.co_firstlineno, code.co_name) == mutant.function:
            raise ValueError(f"line {mutant.line}: expected the same variables of outer functions, received others")
    module = next(m for m in list(sys.modules.values()) if getattr(m, "__file__", None) == file)
    by_key = {(f.__code__.co_firstlineno, f.__code__.co_name): f for f in known[file]}
    for node in ast.walk(mutant.tree):
        if isinstance(node, ast.FunctionDef):
            function = by_key.get(key(node))
            if function is not None and "<locals>" not in function.__qualname__:
                function.__defaults__ = tuple(value(x, module) for x in node.args.defaults) or None
                named = zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
                function.__kwdefaults__ = {a.arg: value(x, module) for a, x in named if x is not None} or None
    if mutant.function is None:
        assign(mutant, module)


def assign(mutant: Mutant, module: object) -> None:
    """Gives the names of a module or class that the changed line assigns their new values, wherever they were taken."""
    owners = [(mutant.tree, module)]
    owners += [(c, getattr(module, c.name)) for c in mutant.tree.body if isinstance(c, ast.ClassDef)]
    done = False
    for owner, target in owners:
        for node in owner.body:
            if isinstance(node, (ast.Assign, ast.AnnAssign)) and node.lineno <= mutant.line <= (node.end_lineno or 0):
                name = node.targets[0] if isinstance(node, ast.Assign) else node.target
                old = getattr(target, name.id)  # type: ignore[attr-defined]
                for other in [target, *(m for n, m in list(sys.modules.items()) if n.startswith("torchfra"))]:
                    if getattr(other, name.id, None) is old:  # type: ignore[attr-defined]
                        setattr(other, name.id, value(node.value, module))  # type: ignore[attr-defined]
                        done = True
    if not done:
        raise ValueError(f"line {mutant.line}: expected the value of a name, received something else")


def value(node: ast.expr, module: object) -> object:
    """What an expression at the top of a module is."""
    return eval(compile(ast.Expression(node), "<mutant>", "eval"), vars(module))


def codes(code: CodeType) -> Iterator[CodeType]:
    """All code within some."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from codes(constant)


@cache
def lines_of(code: CodeType) -> frozenset[int]:
    """The lines of a function that are run one by one."""
    return frozenset(n for *_, n in code.co_lines() if n is not None and n != code.co_firstlineno)


def functions_of(paths: list[Path]) -> dict[str, list[FunctionType]]:
    """The functions that now exist of these files."""
    gc.unfreeze()
    found: dict[str, list[FunctionType]] = {str(path): [] for path in paths}
    for x in gc.get_objects():
        if type(x) is FunctionType and x.__code__.co_filename in found:
            found[x.__code__.co_filename].append(x)
    return found


# ---------------------------------------------------------------- tests in a process of their own


class Test(NamedTuple):
    """What one test did without mutants."""

    name: str
    seconds: float
    ran: dict[str, list[int]]
    """The lines that it ran, by file."""


class Mutants:
    """The plugin that takes the place of pytest's loop over tests."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.failed = options, False
        self.screen = os.fdopen(os.dup(1), "w", buffering=1)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remembers that a test failed."""
        self.failed |= report.failed

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Tries all mutants."""
        paths = [p for room in self.options.rooms for p in sorted((ROOT / "torchfra" / room).rglob("*.py"))]
        paths = [p for p in paths if p.parent.name not in self.options.without]
        known = functions_of(paths)
        items = {item.nodeid: item for item in session.items}
        tests = [t for t in self.watched(list(items.values())) if t.name in items]
        every = [m for path in paths for m in mutants(path)]
        chosen = random.Random(self.options.seed).sample(every, min(self.options.sample or len(every), len(every)))
        if self.options.again:
            left = json.loads(Path(self.options.again).read_text())["survivors"]
            left = {(x["where"], x["change"]) for x in left}
            chosen = [m for m in every if (m.where, m.text) in left]
        kills: Counter[tuple[str, str]] = Counter()
        tries: Counter[tuple[str, str]] = Counter()
        counts: Counter[str] = Counter()
        survivors = []
        start = time.monotonic()
        for number, mutant in enumerate(chosen):
            if self.options.minutes and time.monotonic() - start > 60 * self.options.minutes:
                break
            around = [f"{mutant.path}{mutant.function}", str(mutant.path), ""]
            covering = self.covering(mutant, tests)
            cost = {}
            for t in covering:  # seconds for each mutant found: by what was found here, in this file and anywhere
                found, tried = (sum(of[x, t.name] / 5**i for i, x in enumerate(around)) for of in (kills, tries))
                cost[t.name] = t.seconds * (tried + 1) / (found + 0.2)
            covering.sort(key=lambda t, cost=cost: cost[t.name])
            verdict, by, number_run = self.tried(mutant, covering, items, known)
            counts[verdict] += 1
            kills.update((x, by) for x in around)
            tries.update((x, t.name) for x in around for t in covering[:number_run])
            if verdict not in ("found", "hangs", "cannot be put in"):
                here = {"where": mutant.where, "change": mutant.text}
                survivors.append(here | {"verdict": verdict, "tests": len(covering)})
                self.say(f"{number + 1}: {mutant.where}: {mutant.text} ({verdict}, {len(covering)} tests)")
        found = counts["found"] + counts["hangs"]
        tried = sum(counts.values()) - counts["cannot be put in"]
        share = 100 * found / max(tried, 1)
        self.say(f"{found} of {tried} found, {share:.1f} %; there are {len(every)}; {dict(counts)}")
        if self.options.json:
            result = {"rooms": self.options.rooms, "seed": self.options.seed, "of": len(every), "tried": tried}
            Path(self.options.json).write_text(json.dumps(result | {"found": found, "survivors": survivors}, indent=1))
        return True

    def say(self, line: str) -> None:
        """Writes a line, past what pytest captures."""
        print(line, file=self.screen)

    def covering(self, mutant: Mutant, tests: list[Test]) -> list[Test]:
        """The tests that run a changed statement, or anything of the file where it is in no function."""
        file, within = str(mutant.path.relative_to(ROOT)), set(mutant.lines)
        if mutant.function is None:
            return [t for t in tests if file in t.ran]
        return [t for t in tests if not within.isdisjoint(t.ran.get(file, ()))]

    def watched(self, items: list[pytest.Item]) -> list[Test]:
        """What each test runs, and how long it takes; kept in a file, as long as the code is the same."""
        files = {str(p): str(p.relative_to(ROOT)) for room in ROOMS for p in (ROOT / "torchfra" / room).rglob("*.py")}
        digest = hashlib.sha256(b"".join(Path(p).read_bytes() for p in sorted(files))).hexdigest()
        kept = self.options.map and Path(self.options.map)
        known: list[Test] = []
        if kept and kept.exists():
            of, tests = json.loads(kept.read_text())
            known = [Test(*t) for t in tests] if of == digest else []
        items = [item for item in items if item.nodeid not in {t.name for t in known}]

        def watch() -> list[Test]:
            tests = []
            for item, after in zip(items, [*items[1:], None], strict=True):
                ran: dict[CodeType, set[int]] = {}

                def call(frame, event, argument, ran=ran):
                    code = frame.f_code
                    if code.co_filename not in files:
                        return None
                    lines = ran.setdefault(code, set())

                    def line(frame, event, argument):
                        lines.add(frame.f_lineno)
                        return line

                    return None if lines >= lines_of(code) else line

                self.failed, began = False, used()
                sys.settrace(call)
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
                sys.settrace(None)
                if self.failed:
                    self.say(f"{item.nodeid} fails without any mutant: left out")
                elif ran:
                    by_file: dict[str, set[int]] = {}
                    for code, lines in ran.items():
                        by_file.setdefault(files[code.co_filename], set()).update(lines)
                    tests.append(Test(item.nodeid, used() - began, {k: sorted(v) for k, v in by_file.items()}))
            return tests

        more = forked(watch)
        if not isinstance(more, list):
            raise SystemExit("mutants: the tests did not end without any mutant")
        tests = known + [Test(*t) for t in more]
        self.say(f"{len(tests)} tests, {sum(t.seconds for t in tests):.0f} s of processor time")
        if kept:
            kept.write_text(json.dumps([digest, tests]))
        return tests

    def tried(
        self, mutant: Mutant, tests: list[Test], items: dict[str, pytest.Item], known: dict[str, list[FunctionType]]
    ) -> tuple[str, str, int]:
        """What became of a mutant, the name of the test that found it, and how many tests were run."""
        if not tests:
            return "no test runs it", "", 0

        def run() -> tuple[str, str, int]:
            began = used()
            try:
                put_in(mutant, known)
            except Exception:  # a value of an Enum, say
                return "cannot be put in", "", 0
            order = [items[t.name] for t in tests]
            for i, (t, item, after) in enumerate(zip(tests, order, [*order[1:], None], strict=True)):
                if used() - began > self.options.seconds:
                    return "survived, not all tests run", "", i
                signal.setitimer(signal.ITIMER_PROF, PATIENCE * (t.seconds + 1))
                self.failed = False
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
                if self.failed:
                    return "found", t.name, i + 1
            return "survived", "", len(tests)

        result = forked(run)
        return ("hangs", "", 0) if result is None else (result[0], result[1], result[2])


def used() -> float:
    """Processor time of this process, in seconds."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def forked(work: Callable[[], object]) -> object:
    """What a function returns in a process of its own; None where that ended otherwise."""
    there, here = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(there)
        nothing = os.open(os.devnull, os.O_RDWR)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        try:
            with os.fdopen(here, "w") as file:
                json.dump(work(), file)
        finally:
            os._exit(0)
    os.close(here)
    with os.fdopen(there) as file:
        text = file.read()
    os.waitpid(child, 0)
    return json.loads(text) if text else None


def main(argv: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=list(ROOMS), help="packages whose code is changed")
    parser.add_argument("--without", nargs="+", default=[], metavar="NAME", help="packages in them that are left out")
    parser.add_argument(
        "--tests", nargs="+", metavar="NAME", default=TESTS.split(), help="folders NAME and files test_NAME.py"
    )
    parser.add_argument("--sample", type=int, metavar="N", help="so many mutants, drawn at random (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="of the draw (default: %(default)s)")
    parser.add_argument("--minutes", type=float, help="end after so long, with those tried until then")
    parser.add_argument("--seconds", type=float, default=40, help="of processor time for each (default: %(default)s)")
    parser.add_argument("--map", metavar="FILE", help="which test runs what: read from there, or written to it")
    parser.add_argument("--again", metavar="FILE", help="only the survivors that --json wrote to a file")
    parser.add_argument("--json", metavar="FILE", help="write the figures and the survivors to a file")
    options = parser.parse_args(argv)
    places = [path.relative_to(ROOT) for path in ROOT.glob("tests/*/test_*.py")]
    there = {path.stem.removeprefix("test_"): str(path) for path in places}
    there |= {path.parent.name: str(path.parent) for path in places}
    if missing := [name for name in options.tests if name not in there]:
        parser.error(f"tests: expected folders of tests and files test_NAME.py in them, received {', '.join(missing)}")
    os.environ["OMP_NUM_THREADS"] = "1"
    os.chdir(ROOT)
    files = [there[name] for name in options.tests]
    plugins = [f"-pno:{name}" for name in ("terminal", "logging", "cacheprovider", "xdist")]
    given = [*files, "-m", "not slow", "-o", "addopts=--strict-markers", *plugins]
    return int(pytest.main(given, plugins=[Mutants(options)]))


if __name__ == "__main__":
    sys.exit(main())

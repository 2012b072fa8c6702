"""Imports of the library run downwards only, and matplotlib is imported by what draws alone."""

import ast
import importlib.util
from pathlib import Path

import pytest

import torchfra
import train

LIBRARY, RECIPES = Path(torchfra.__file__).parent, Path(train.__file__).parent
LEVELS = [
    {"version"}, {"loading"}, {"tables"}, {"suggestions"}, {"angles"}, {"numbers"}, {"tree"}, {"linalg"}, {"types"},
    {"pictures"}, {"hyper"}, {"entries"}, {"state_files"}, {"running"}, {"coordinates"}, {"geodesy"}, {"readers"},
    {"losses"}, {"metrics"}, {"motion"}, {"sensors"}, {"gaussian"}, {"robust"}, {"adaptive"}, {"association"},
    {"steps"}, {"compiler"}, {"filters"}, {"register"}, {"stream"}, {"targets"}, {"testing"},
    {"presets"},
    {"scenarios"}, {"catalogue"}, {"adapters"}, {"plotting"}, {"evaluation"}, {"fitting"}, {"cleaning"},
    {"cli"}, {"__init__", "__main__"},
]  # fmt: skip
"""Lower first: a module or package imports those below it, and within a package there is no circle."""
APART = {
    ("scenarios", "filters"),
    ("scenarios", "presets"),
    ("adapters", "readers"),
    ("evaluation", "readers"),
    ("fitting", "readers"),
    ("plotting", "readers"),
}
"""The first never imports the second, although it lies below."""
OPTIONAL = {"train": (), "matplotlib": ("plotting", "cleaning.figures")}
"""Packages from outside, and the parts of the library that may import them."""


# ---------------------------------------------------------------- the checker


def modules_of(root):
    """All modules below a folder by their dotted names, packages by the names of their folders."""
    names = {path: (root.name, *path.relative_to(root).with_suffix("").parts) for path in sorted(root.rglob("*.py"))}
    return {".".join(name).removesuffix(".__init__"): path for path, name in names.items()}


def imports_of(name, modules):
    """The modules that a module imports, anywhere in its file and whichever way it is written."""
    path = modules[name]
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            source = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            for alias in node.names:
                inside = f"{source}.{alias.name}"
                yield inside if inside in modules else source
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def part(name):
    """The part of the package that a module belongs to: the second component of its name."""
    return [*name.split("."), "__init__"][1]


def upward_imports(root, levels, apart=(), optional=()):
    """What is imported although it does not lie below, in words."""
    modules, level = modules_of(root), {name: i for i, names in enumerate(levels) for name in names}
    yield from (f"{name} has no level" for name in modules if part(name) not in level)
    for name in modules:
        for other in sorted(set(imports_of(name, modules))):
            top, here = other.split(".")[0], f"{name} imports {other}"
            if top != root.name:
                if top in optional and not name.startswith(tuple(f"{root.name}.{place}" for place in optional[top])):
                    yield here
            elif other not in modules:
                yield f"{here}, which does not exist"
            elif part(name) != part(other) and (
                (part(name), part(other)) in apart or level.get(part(other), 0) >= level.get(part(name), 0)
            ):
                yield here


def circles(root):
    """Modules that import themselves through others, each circle once, in words."""
    modules = modules_of(root)
    graph = {name: sorted(set(imports_of(name, modules)) & modules.keys()) for name in modules}
    done, going = set(), []

    def visit(name):
        if name in going:
            yield " imports ".join([*going[going.index(name) :], name])
        elif name not in done:
            going.append(name)
            for other in graph[name]:
                yield from visit(other)
            going.pop()
            done.add(name)

    for name in graph:
        yield from visit(name)


# ---------------------------------------------------------------- the library


def test_imports_run_downwards_only():
    assert list(upward_imports(LIBRARY, LEVELS, APART, OPTIONAL)) == []


def test_no_module_imports_itself_through_others():
    assert [circle for root in (LIBRARY, RECIPES) for circle in circles(root)] == []


def test_every_folder_is_a_package():
    assert {path.parent for path in LIBRARY.rglob("*.py")} == {path.parent for path in LIBRARY.rglob("__init__.py")}


# ---------------------------------------------------------------- the checker sees what it must


@pytest.fixture
def package(tmp_path):
    """Writes a small package: low < middle < high, with the source of some of its modules."""

    def build(**sources):
        root = tmp_path / "tiny"
        (root / "high").mkdir(parents=True)
        files = {"__init__": "", "low": "", "middle": "from tiny.low import x", "high/__init__": "", "high/a": "",
                 "high/b": "from tiny.high.a import x"}  # fmt: skip
        for name, source in (files | sources).items():
            (root / f"{name}.py").write_text(source)
        return root

    return build


TINY = [{"low"}, {"middle"}, {"high"}, {"__init__"}]


def test_a_package_in_order_is_not_complained_of(package):
    root = package(**{"high/__init__": "from tiny.high.b import x\nfrom tiny import low, middle"})
    assert list(upward_imports(root, TINY)) == []
    assert list(circles(root)) == []


@pytest.mark.parametrize("source", [
    "from tiny import high", "from tiny.high import a", "from tiny.high.a import x", "import tiny.high.a",
    "import tiny.high.a as a", "from . import high", "from .high import a", "from .high.a import x",
    "def f():\n    from tiny import high", "def f():\n    import tiny.high", "from tiny import low, high",
    "try:\n    from .high import a\nexcept ImportError:\n    pass", "if TYPE_CHECKING:\n    from tiny.high.a import x",
    "from tiny import something", "import tiny",
])  # fmt: skip
def test_an_import_upwards_is_seen_however_it_is_written(package, source):
    (complaint,) = upward_imports(package(low=source), TINY)
    assert complaint.startswith("tiny.low imports tiny")


@pytest.mark.parametrize(("files", "modules"), [
    ({"high/a": "from tiny.high.b import x"}, {"tiny.high.a", "tiny.high.b"}),
    ({"high/a": "from . import b"}, {"tiny.high.a", "tiny.high.b"}),
    ({"high/a": "def f():\n    from .b import x"}, {"tiny.high.a", "tiny.high.b"}),
    ({"high/a": "from tiny.high import x", "high/__init__": "from .b import x"},
     {"tiny.high", "tiny.high.a", "tiny.high.b"}),
])  # fmt: skip
def test_a_circle_inside_a_package_is_seen(package, files, modules):
    root = package(**files)
    (circle,) = circles(root)
    assert set(circle.split(" imports ")) == modules
    assert list(upward_imports(root, TINY)) == []

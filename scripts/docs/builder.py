"""What the documentation's build adds to Sphinx: mathematics without a network, and the links of included files."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
WORK = ROOT / "out" / "docs-work"
PAGES = {
    "README.md": "start", "CHANGELOG.md": "changelog", ".github/CONTRIBUTING.md": "contributing",
    "train/README.md": "learning",
    "scripts/results/README.md": "results", "torchfra/filters/README.md": "choosing",
    "scripts/results/papers.md": "results-papers",
    "scripts/results/regret.md": "results-regret",
    "scripts/results/field.md": "results-field",
    "scripts/results/recordings.md": "results-recordings",
    "scripts/results/learned.md": "results-learned",
    "scripts/results/targets.md": "results-targets",
    "scripts/results/cleaning.md": "results-cleaning",
    "torchfra/stream/README.md": "streaming", "torchfra/targets/README.md": "targets",
    "torchfra/cleaning/README.md": "cleaning", "torchfra/compiler/README.md": "performance",
    "scripts/examples": "gallery/examples/index", "torchfra/fitting/README.md": "fitting",
    "torchfra/evaluation/README.md": "comparing",
    "torchfra/adapters/README.md": "adapters", "torchfra/motion/README.md": "matrices",
    "torchfra/robust/README.md": "outliers",
}  # fmt: skip
"""The page that includes a file which others link to."""
SECTIONS = {
    "#the-presets": "presets",
    "#smoothing": "smoothing", "#your-own-motion": "models", "#your-own-sensor": "models", "#your-own-weight": "models",
}  # fmt: skip
"""Sections of the filters' file that have a page of their own."""


# ---------------------------------------------------------------- links of included files


def target(link: str, file: Path, page: str) -> str:
    """The link that stands in an included file, as the page that includes it has to write it."""
    name, mark, anchor = link.partition("#")
    path = os.path.relpath(file.parent / name if name else file, ROOT)
    if path == "torchfra/filters/README.md" and mark + anchor in SECTIONS:
        return f"/{SECTIONS[mark + anchor]}.md"
    if path in PAGES:
        return f"/{PAGES[path]}.md{mark}{anchor}" if (HERE / f"{PAGES[path]}.md").exists() else f"/{PAGES[path]}.rst"
    if path.startswith("scripts/examples/"):
        return f"/gallery/examples/{Path(path).stem}.rst"
    return os.path.relpath(ROOT / path, (HERE / page).parent)


def rewrite(app: Any, relative: Path, page: str, content: list[str]) -> None:
    """Rewrites the links of a Markdown file from outside as the page that includes it needs them."""
    file = (HERE / relative).resolve()
    if file.suffix != ".md" or HERE in file.parents:
        return
    content[0] = re.sub(
        r"\]\((?![a-z]+:)([^)\s]+)\)", lambda found: f"]({target(found[1], file, f'{page}.md')})", content[0]
    )


# ---------------------------------------------------------------- mathematics


def mathml(visitor: Any, node: Any, display: str) -> None:
    """Writes a formula as MathML, which browsers draw by themselves."""
    text = convert(node.astext(), display=display)
    if display == "inline":
        visitor.body.append(text)
    else:
        number = f'<span class="eqno">({node["number"]})</span>' if node.get("number") else ""
        visitor.body.append(f'<div class="formula">{text}{number}</div>')
    raise nodes.SkipNode


# ---------------------------------------------------------------- the gallery


def programs(folder: Path, title: str, words: str) -> str:
    """A copy of a folder of programs as the gallery wants them: with a title, and a heading in each docstring."""
    copy = WORK / folder.name
    copy.mkdir(parents=True, exist_ok=True)
    (copy / "README.txt").write_text(f"{title}\n{'=' * len(title)}\n\n{words}\n")
    for path in sorted(folder.glob("*.py")):
        _, docstring, code = path.read_text().split('"""', 2)
        head, _, rest = docstring.partition("\n")
        rest = re.sub(r"\n\n(    \S)", r"\n\n::\n\n\1", rest)  # lines set in are what is typed
        head = head.removesuffix(".")
        text = f'r"""\n{head}\n{"=" * len(head)}\n{rest}"""{code}'
        if not (made := copy / path.name).exists() or made.read_text() != text:
            made.write_text(text)
    return str(copy)


def arguments(conf: Any, variables: dict[str, Any]) -> list[str]:
    """The arguments that an example is run with: it draws where it can."""
    (WORK / "drawn").mkdir(parents=True, exist_ok=True)
    source = Path(variables["src_file"])
    return ["--plot", f"../drawn/{source.stem}.png"] if '"--plot"' in source.read_text() else []


def scraper(block: Any, variables: dict[str, Any], conf: dict[str, Any]) -> str:
    """The pictures of a block: figures that pyplot does not know, and files that the example has written."""
    made = variables["example_globals"]
    seen = made.setdefault("__pictures__", set())
    names = []
    for figure in _new(made, seen):
        names.append(next(variables["image_path_iterator"]))
        figure.savefig(names[-1], dpi=conf.get("dpi", 110), bbox_inches="tight")
    for file in sorted((WORK / "drawn").glob("*.png")):
        names.append(next(variables["image_path_iterator"]))
        shutil.move(file, names[-1])
    return figure_rst(names, conf["src_dir"])


def _new(made: dict[str, Any], seen: set[int]) -> list[Figure]:
    """Figures among an example's names that have not been shown, but for those of pyplot, which has its own scraper."""
    new = {id(x): x for x in made.values() if isinstance(x, Figure) and id(x) not in seen}
    seen.update(new)
    return [x for x in new.values() if x not in map(plt.figure, plt.get_fignums())]


# ---------------------------------------------------------------- docstrings


def tidy(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Takes out what Python writes by itself, and makes words with a colon at the end of a docstring stand out."""
    if lines and lines[0].startswith("Alias for field number"):
        lines[:] = []
    lines[:] = [re.sub(r"^(\s*)(Source|Differs):", r"\1**\2:**", line) for line in lines]


def forget_modules_without_source(app: Any) -> list[Any]:
    """Takes modules that have no page of their source, such as ``builtins``, out of the list of those pages."""
    modules = getattr(app.env, "_viewcode_modules", {})
    for name in [name for name, source in modules.items() if not source]:
        del modules[name]
    return []


def setup(app: Any) -> dict[str, Any]:
    """Called by Sphinx."""
    app.connect("html-collect-pages", forget_modules_without_source, priority=100)  # before those pages are made
    app.add_html_math_renderer(
        "mathml", (lambda self, node: mathml(self, node, "inline"), None),
        (lambda self, node: mathml(self, node, "block"), None),
    )  # fmt: skip
    app.connect("include-read", rewrite)
    app.connect("autodoc-process-docstring", tidy, priority=100)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}

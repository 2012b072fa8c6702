"""What networks in front of a filter buy, by the code of the page on layers itself.

    python scripts/layer.py --json out/layer.json
    python scripts/layer.py --steps 3 --tracks 8 --teachers truth

The first blocks of ``scripts/docs/layer.md`` say what the tracks, the head and the encoder are.  Each network learns by
Adam in so many steps on 32 tracks of 50 steps: from the truth, from the likelihood of the measurements, or from that of
measurements which are hidden from the smoother.  Errors are root mean squares of positions, m, on other tracks.
"""

from __future__ import annotations

import argparse
import ast
import re
import sys
from pathlib import Path
from typing import Any

import torch
from lists import check_list
from torch import nn

from torchfra import losses, presets
from torchfra.cli.command import add_output_options, check_files, check_least, exit_status, make_parser
from torchfra.motion import ConstantVelocity
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.sensors import Position
from torchfra.tables import text_table

PAGE = Path(__file__).parent / "docs" / "layer.md"
LEARNED_FROM, LENGTH, SCALE = 32, 50, 10.0
"""Tracks of a step of descent, steps of a track, and the error from which on it counts less, m."""
TEACHERS = ("truth", "likelihood", "hidden")
JUDGES = 10_000
"""Added to the seed for the tracks that judge."""


def main(argv: list[str] | None = None) -> int:
    """Runs the command."""
    p = make_parser(__doc__)
    p.add_argument("--steps", type=int, default=100, metavar="K", help="of descent (default: 100)")
    p.add_argument("--tracks", type=int, default=200, metavar="N", help="that judge (default: 200)")
    p.add_argument("--teachers", default=",".join(TEACHERS), metavar="A,B", help=f"of {','.join(TEACHERS)} (all)")
    p.add_argument("--seed", type=int, default=0, metavar="S", help="of the first tracks (default: 0)")
    add_output_options(p)
    options = p.parse_args(argv)
    check_list(p, "teachers", options.teachers, TEACHERS)
    return exit_status("layer", lambda: compare(options))


def compare(options: argparse.Namespace) -> None:
    """All errors, and their table.

    Raises:
        ValueError: no steps, or no tracks.
    """
    check_files({"json": options.json})
    check_least(options, steps=1, tracks=1)
    page = code_of(PAGE.read_text(encoding="utf-8"))
    z, features, truth, prior = page["simulate"](options.tracks, LENGTH, JUDGES + options.seed)
    found = {}

    def judge(name: str, f: nn.Module, *given: Any, **options: Any) -> None:
        with torch.no_grad():
            estimate, smoothed = f(*given, **options), getattr(f, "filter", f).smooth(*given, **options)
        found[name] = [float((x.mean - truth)[..., :2].square().sum(-1).mean().sqrt()) for x in (estimate, smoothed)]

    for name in ("srckf", "rsrckf"):
        judge(name, getattr(presets, name)(ConstantVelocity(q=0.1), Position(page["STD"])), z, prior)
    ways = [(network, teacher) for network in ("perceptron", "encoder") for teacher in options.teachers.split(",")]
    for network, teacher in progress_bar(ways, "network", not options.quiet):
        model = learned(page, network, teacher, options)
        with torch.no_grad():
            std, bias = model.head(features)
        judge(f"{network}, {teacher}", model.filter, z - bias, prior, std=std)
    if not options.quiet:
        rows = [[name, *(f"{x:.2f}" for x in errors)] for name, errors in found.items()]
        print(text_table(["", "on line m", "smoothed m"], rows))
    settings = {name: getattr(options, name) for name in ("steps", "tracks", "teachers", "seed")}
    write_results(options.json, {**settings, "errors": found})


def code_of(page: str) -> dict[str, Any]:
    """What the page defines: its imports, classes, functions and constants, without what it runs as an example."""
    scope: dict[str, Any] = {}
    definitions = ast.Import, ast.ImportFrom, ast.ClassDef, ast.FunctionDef
    for block in re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE):
        code = ast.parse(block)
        code.body = [
            x for x in code.body if isinstance(x, definitions) or isinstance(getattr(x, "value", None), ast.Constant)
        ]
        exec(compile(code, str(PAGE), "exec"), scope)
    return scope


def learned(page: dict[str, Any], network: str, teacher: str, options: argparse.Namespace) -> Any:
    """A layer after its steps of descent."""
    model = page["layer"](presets.srckf(ConstantVelocity(q=0.1), Position(page["STD"])))
    if network == "encoder":
        torch.manual_seed(0)
        model = page["Layer"](page["Head"](page["Encoder"](8, 32), 32, 2, page["STD"], bias=20.0), model.filter)
    optimiser = torch.optim.Adam(model.parameters(), lr=0.02)
    for step in range(options.steps):
        z, features, truth, prior = page["simulate"](LEARNED_FROM, LENGTH, options.seed + step)
        if teacher == "hidden":
            loss = page["hidden_nll"](model, z, features, prior)
        elif teacher == "likelihood":
            loss = losses.innovation_nll(model(z, features, prior))
        else:
            loss = losses.robust_mse(model(z, features, prior).mean, truth, slice(0, 2), scale=SCALE)
        optimiser.zero_grad()
        loss.mean().backward()
        optimiser.step()
    return model


if __name__ == "__main__":
    sys.exit(main())

"""Writes one step of a filter as C++ that needs no library, builds it, and compares it with the filter.

    python scripts/export.py                                         srckf: header, source, CMakeLists.txt, example
    python scripts/export.py --filter fra --inputs std --precision single
    python scripts/export.py --filter gpb --scenario adsb-turns --tracks 1000

For a filter of your own call torchfra.compiler.export.export, which returns the texts of the files.
"""

from __future__ import annotations

import argparse
import math
import os
import shlex
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from lists import check_list
from torch import Tensor

from torchfra.catalogue import SCENARIOS, scenario_filter, track_filters
from torchfra.cli.command import IncompleteError, check_folder, exit_status, make_parser
from torchfra.compiler.export import export
from torchfra.filters import Filter
from torchfra.running.atomic_write import write_text
from torchfra.scenarios import Scenario
from torchfra.tables import printable
from torchfra.types import CompileError, Gaussian

PRECISIONS = {"double": torch.float64, "single": torch.float32}
FLAGS = "-O2 -std=c++17 -march=native -fno-math-errno -fno-trapping-math"
"""Those of the CMakeLists.txt."""


def main(arguments: list[str] | None = None) -> int:
    """Runs the example; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("--filter", default="srckf", help=f"one of {', '.join(track_filters())} (default: srckf)")
    p.add_argument("--scenario", default="bearings-outliers", choices=sorted(SCENARIOS),
                   help="whose models it has (default: bearings-outliers)")  # fmt: skip
    p.add_argument("--inputs", choices=("std", "noise"), help="what else comes with each measurement")
    p.add_argument("--precision", choices=PRECISIONS, default="double", help="of all numbers (default: double)")
    p.add_argument("--tracks", type=int, default=10, help="simulated, to compare on (default: 10)")
    p.add_argument("--out", type=Path, metavar="FOLDER", help="for the files (default: out/FILTER)")

    def work() -> None:
        options = p.parse_args(arguments)
        check_list(p, "filter", options.filter, track_filters())
        if options.tracks < 1:
            p.error(f"--tracks: expected a whole number of 1 or more, received {options.tracks}")
        example(options)

    return exit_status("export", work)


def example(options: argparse.Namespace) -> None:
    """Writes the files, builds them, and runs tracks through the program and through the filter.

    Raises:
        IncompleteError: they differ by a number that is not finite.
    """
    folder = options.out or Path("out") / options.filter
    check_folder("out", folder)
    scenario, dtype = SCENARIOS[options.scenario](), PRECISIONS[options.precision]
    f, tracks = scenario_filter(options.filter, scenario), scenario.simulate(options.tracks, 0)
    u = 0 if tracks.u is None else tracks.u.shape[-1]
    extra = () if options.inputs is None else (options.inputs,)
    files = export(f, options.filter, u=u, inputs=extra, dtype=dtype)
    prior = Gaussian(*(x.to(dtype) for x in tracks.prior))
    inputs = data(scenario, tracks.z.to(dtype), tracks.u, options.inputs)
    with TemporaryDirectory() as place:
        found, timing = run(compiled(files, options.filter, Path(place)), prior, inputs)
    difference = compare(stepped(f, prior, inputs), found, f.motion.size)
    for name, text in files.items():
        write_text(folder / name, text)
    print(
        f"{printable(str(folder))}: {timing}, largest relative difference from the filter {difference:.1e}", flush=True
    )
    if not math.isfinite(difference):
        raise IncompleteError(f"{options.filter}: a step is not finite")


def data(scenario: Scenario, z: Tensor, u: Tensor | None, extra: str | None) -> dict[str, Tensor]:
    """What goes into the steps ``(B, T, ...)``, with noise that changes from step to step where it is an input."""
    inputs = {"z": z, "dt": z.new_full(z.shape[:2], scenario.dt)}
    if u is not None:
        inputs["u"] = u.to(z).expand(*z.shape[:2], -1)
    scale = scenario.sensor.std(z) * (1 + torch.arange(z.shape[-1]).to(z))
    std = scale * (1 + torch.rand(z.shape, generator=torch.Generator().manual_seed(0)).to(z))
    if extra == "std":
        inputs["std"] = std
    elif extra == "noise":
        inputs["noise"] = torch.diag_embed(std) + 0.1 * std.unsqueeze(-1).expand(*std.shape, std.shape[-1]).tril(-1)
    return inputs


def compiled(files: dict[str, str], name: str, folder: Path) -> Path:
    """The example program, built in a folder by the compiler alone.

    Raises:
        CompileError: there is no compiler, or it fails.
    """
    for file, text in files.items():
        (folder / file).write_text(text)
    program = folder / "example"
    flags = [*FLAGS.split(), *shlex.split(os.environ.get("CXXFLAGS", ""))]
    command = [*shlex.split(os.environ.get("CXX", "g++")), *flags, f"{name}.cpp", "example.cpp", "-o", str(program)]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    except OSError as error:
        raise CompileError(f"export: expected a C++ compiler, {command[0]} does not run ({error}): set CXX") from None
    if done.returncode:
        raise CompileError(f"export: {shlex.join(command)} failed:\n{done.stderr[-2000:]}")
    return program


def run(program: Path, prior: Gaussian, inputs: dict[str, Tensor]) -> tuple[Tensor, str]:
    """What the program writes of tracks ``(B, T, ...)``, one row for each step, and what it tells of the time."""
    count, steps = inputs["z"].shape[:2]
    roots = prior.scale_tril.expand(count, *prior.scale_tril.shape[-2:])
    columns = torch.cat([x.reshape(count, steps, -1) for x in inputs.values()], -1).flatten(1)
    numbers = torch.cat([columns.new_full((count, 1), steps), prior.mean, roots.flatten(1), columns], 1)
    text = "\n".join(" ".join(map(repr, row)) for row in numbers.tolist())
    done = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    rows = [[float(x) for x in line.split()] for line in done.stdout.splitlines()]
    return torch.tensor(rows, dtype=torch.float64).reshape(count, steps, -1), done.stderr.strip()


@torch.no_grad()
def stepped(f: Filter, prior: Gaussian, inputs: dict[str, Tensor]) -> Tensor:
    """The same of the filter, all tracks at once."""
    count, steps = inputs["z"].shape[:2]
    state, rows = f.init(Gaussian(prior.mean, prior.scale_tril.expand(count, *prior.scale_tril.shape[-2:]))), []
    for k in range(steps):
        now = {name: x[:, k] for name, x in inputs.items()}
        state, innovation = f.step(state, now.pop("z"), **now)
        parts = (*state.belief, innovation.nis.unsqueeze(-1), innovation.log_likelihood.unsqueeze(-1))
        rows.append(torch.cat([x.reshape(count, -1) for x in parts], -1).double())
    return torch.stack(rows, 1)


def compare(expected: Tensor, found: Tensor, n: int) -> float:
    """The largest difference of means, roots and scores, each relative to its size (of scores, where above 1)."""
    gaps = [gap(*(x[..., part] for x in (expected, found))) for part in (slice(n), slice(n, n + n * n))]
    scores = [x[..., n + n * n :].unsqueeze(-1) for x in (expected, found)]
    gaps.append((scores[1] - scores[0]).abs().amax(-1) / scores[0].abs().amax(-1).clamp(min=1.0))
    return max(x.max().item() for x in gaps)


def gap(expected: Tensor, found: Tensor) -> Tensor:
    """The largest difference of the last dimension, relative to its largest entry."""
    return (found - expected).abs().amax(-1) / expected.abs().amax(-1)


if __name__ == "__main__":
    sys.exit(main())

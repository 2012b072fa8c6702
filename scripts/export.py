"""Exports one step of a filter as a package that C++ can load, and runs a track through it.

    python scripts/export.py                          SRCKF, one track
    python scripts/export.py --filter fra --out fra.pt2

The package (torch.export, AOTInductor) holds machine code for one step of one track: state and measurement in, next
state and innovation out.  Python loads it with torch._inductor.aoti_load_package, C++ with
torch::inductor::AOTIModelPackageLoader.  For streaming from Python, Filter.compile() is simpler.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from benchmarks.clock import once
from torch import Tensor, nn

from torchfra.app.atomic_write import write
from torchfra.app.command import IncompleteError, check_files, check_list, exit_status, make_parser
from torchfra.catalogue import SCENARIOS, scenario_filter, track_filters
from torchfra.filters import Filter
from torchfra.scenarios import Scenario
from torchfra.tables import printable
from torchfra.tree import flatten, unflatten
from torchfra.types import Gaussian


class Step(nn.Module):
    """One step, from tensors to tensors.

    Args:
        f: the filter.
        state: any state of it, whose structure all states have.
    """

    def __init__(self, f: Filter, state: Any) -> None:
        super().__init__()
        self.filter, self.like = f, state

    def forward(self, leaves: list[Tensor], z: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """From the leaves of the state, ``z (m,)`` and the stations ``u (k,)`` to those of the next, and ``nis``."""
        state, innovation = self.filter.step(unflatten(self.like, iter(leaves)), z, u=u)
        return (*flatten(state), innovation.nis)


def main(arguments: list[str] | None = None) -> int:
    """Runs the example; returns its exit status: see ``torchfra.app.command.exit_status``."""
    p = make_parser(__doc__)
    p.add_argument("--filter", default="srckf", help=f"one of {', '.join(track_filters())} (default: srckf)")
    p.add_argument("--out", type=Path, metavar="FILE", help="the package (default: out/FILTER.pt2)")

    def work() -> None:
        options = p.parse_args(arguments)
        check_list(p, "filter", options.filter, track_filters())
        example(options)

    return exit_status("export", work)


def example(options: argparse.Namespace) -> None:
    """Writes the package, and compares it with the filter along a track.

    Raises:
        IncompleteError: they differ by a number that is not finite.
    """
    path = options.out or Path("out") / f"{options.filter}.pt2"
    check_files({"out": path})
    scenario = SCENARIOS["bearings-outliers"]()
    f = scenario_filter(options.filter, scenario)
    with TemporaryDirectory() as folder:
        package = export(f, scenario, Path(folder) / "step.pt2")
        seconds, difference = compare(f, torch._inductor.aoti_load_package(str(package)), scenario)
        data = package.read_bytes()
    print(f"{printable(str(path))}: {len(data) / 1024:.0f} kB, {seconds * 1e6:.0f} us per step, "
          f"relative difference from the filter {difference:.1e}", flush=True)  # fmt: skip
    write(path, lambda file: file.write(data))
    if not math.isfinite(difference):
        raise IncompleteError(f"{options.filter}: a step is not finite")


def export(f: Filter, scenario: Scenario, path: Path) -> Path:
    """Makes the package of one step of one track."""
    state = f.init(scenario.prior)
    z = torch.zeros(f.sensor.size, dtype=torch.float64)
    u = torch.zeros(4, dtype=torch.float64)
    with torch.no_grad():
        program = torch.export.export(Step(f, state), ([x.clone() for x in flatten(state)], z, u))
        return Path(torch._inductor.aoti_compile_and_package(program, package_path=str(path)))


@torch.no_grad()
def compare(f: Filter, step: Any, scenario: Scenario) -> tuple[float, float]:
    """Median seconds of an exported step, and the largest difference of its means relative to their size."""
    tracks = scenario.simulate(1, 0)
    state = f.init(Gaussian(tracks.prior.mean[0], tracks.prior.scale_tril))
    leaves, gaps, seconds = flatten(state), [], []
    for z, u in zip(tracks.z[0], tracks.u, strict=True):
        state, _ = f.step(state, z, u=u)
        seconds.append(once(lambda leaves=leaves, z=z, u=u: step(leaves, z, u)))
        *leaves, _ = step(leaves, z, u)
        gaps.append((leaves[0] - state.belief.mean).abs().max() / state.belief.mean.abs().max())
    return statistics.median(seconds), torch.stack(gaps).max().item()


if __name__ == "__main__":
    sys.exit(main())

"""Exports one step of a filter as a package that C++ can load, and runs a track through it.

    python scripts/export.py                          SRCKF, one track
    python scripts/export.py --filter fra --out fra.pt2

The package (torch.export, AOTInductor) holds machine code for one step of one track: state and measurement in, next
state and innovation out.  Python loads it with torch._inductor.aoti_load_package, C++ with
torch::inductor::AOTIModelPackageLoader.  For streaming from Python, Filter.compile() is simpler.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path
from typing import Any

import torch
from benchmarks.clock import once
from torch import Tensor, nn

from torchfra.app.command import check_list, exit_status, make_parser
from torchfra.catalogue import SCENARIOS, scenario_filter, track_filters
from torchfra.filters import Filter
from torchfra.scenarios import Scenario
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
    """Runs the example; returns 0, or 2 after one line on standard error if an argument was wrong."""
    p = make_parser(__doc__)
    p.add_argument("--filter", default="srckf", help=f"one of {', '.join(track_filters())} (default: srckf)")
    p.add_argument("--out", type=Path, metavar="FILE", help="the package (default: out/FILTER.pt2)")
    options = p.parse_args(arguments)
    check_list(p, "filter", options.filter, track_filters())
    return exit_status("export", lambda: example(options))


def example(options: argparse.Namespace) -> None:
    """Writes the package, and compares it with the filter along a track."""
    scenario = SCENARIOS["bearings-outliers"]()
    f = scenario_filter(options.filter, scenario)
    path = export(f, scenario, options.out or Path("out") / f"{options.filter}.pt2")
    seconds, difference = compare(f, torch._inductor.aoti_load_package(str(path)), scenario)
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB, {seconds * 1e6:.0f} us per step, "
          f"relative difference from the filter {difference:.1e}")  # fmt: skip


def export(f: Filter, scenario: Scenario, path: Path) -> Path:
    """Writes the package of one step of one track."""
    state = f.init(scenario.prior)
    z = torch.zeros(f.sensor.size, dtype=torch.float64)
    u = torch.zeros(4, dtype=torch.float64)
    with torch.no_grad():
        program = torch.export.export(Step(f, state), ([x.clone() for x in flatten(state)], z, u))
        path.parent.mkdir(parents=True, exist_ok=True)
        return Path(torch._inductor.aoti_compile_and_package(program, package_path=str(path)))


@torch.no_grad()
def compare(f: Filter, step: Any, scenario: Scenario) -> tuple[float, float]:
    """Median seconds of an exported step, and the largest difference of its means relative to their size."""
    tracks = scenario.simulate(1, 0)
    state = f.init(Gaussian(tracks.prior.mean[0], tracks.prior.scale_tril))
    leaves, difference, seconds = flatten(state), 0.0, []
    for z, u in zip(tracks.z[0], tracks.u, strict=True):
        state, _ = f.step(state, z, u=u)
        seconds.append(once(lambda leaves=leaves, z=z, u=u: step(leaves, z, u)))
        *leaves, _ = step(leaves, z, u)
        gap = (leaves[0] - state.belief.mean).abs().max() / state.belief.mean.abs().max()
        difference = max(difference, gap.item())
    return statistics.median(seconds), difference


if __name__ == "__main__":
    sys.exit(main())

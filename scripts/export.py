"""Exports one step of a filter as a package that C++ can load, and runs a track through it.

    python scripts/export.py                          SRCKF, one track
    python scripts/export.py --filter fra --out fra.pt2

The package (torch.export, AOTInductor) holds machine code for one step of one track: state and measurement in, next
state and innovation out.  Python loads it with torch._inductor.aoti_load_package, C++ with
torch::inductor::AOTIModelPackageLoader.  For streaming from Python, Filter.compile() is as good and simpler.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path

import torch
from torch import Tensor, nn

from torchfra.catalogue import SCENARIOS, scenario_filters, track_filters
from torchfra.filters import Filter
from torchfra.scenarios import Scenario
from torchfra.tree import flatten, unflatten
from torchfra.types import Gaussian


class Step(nn.Module):
    """One step, from tensors to tensors."""

    def __init__(self, f: Filter, state: tuple) -> None:
        super().__init__()
        self.filter, self.like = f, state

    def forward(self, leaves: list[Tensor], z: Tensor, u: Tensor) -> tuple[Tensor, ...]:
        """Leaves of the state, a measurement and where the stations are; leaves of the next state, then ``nis``."""
        state, innovation = self.filter.step(unflatten(self.like, iter(leaves)), z, u=u)
        return (*flatten(state), innovation.nis)


def export(f: Filter, scenario: Scenario, path: Path) -> Path:
    """Writes the package of one step of one track."""
    state = f.init(scenario.prior)
    z = torch.zeros(f.sensor.size, dtype=torch.float64)
    u = torch.zeros(4, dtype=torch.float64)
    with torch.no_grad():
        program = torch.export.export(Step(f, state), ([x.clone() for x in flatten(state)], z, u))
        path.parent.mkdir(parents=True, exist_ok=True)
        return Path(torch._inductor.aoti_compile_and_package(program, package_path=str(path)))


def main(arguments: list[str] | None = None) -> int:
    """Runs the example."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("--filter", default="srckf", help=f"one of {', '.join(track_filters())} (default: srckf)")
    parser.add_argument("--out", type=Path, metavar="FILE", help="the package (default: out/FILTER.pt2)")
    options = parser.parse_args(arguments)
    if options.filter not in track_filters():
        parser.error(f"--filter: expected one of {', '.join(track_filters())}, received {options.filter!r}")
    scenario = SCENARIOS["bearings-outliers"]()
    f = scenario_filters([options.filter], scenario)[options.filter]
    path = export(f, scenario, options.out or Path("out") / f"{options.filter}.pt2")
    step = torch._inductor.aoti_load_package(str(path))
    tracks = scenario.simulate(1, 0)
    state = f.init(Gaussian(tracks.prior.mean[0], tracks.prior.scale_tril))
    leaves, worst, seconds = flatten(state), 0.0, []
    with torch.no_grad():
        for z, u in zip(tracks.z[0], tracks.u, strict=True):
            state, _ = f.step(state, z, u=u)
            start = time.perf_counter()
            *leaves, _ = step(leaves, z, u)
            seconds.append(time.perf_counter() - start)
            scale = state.belief.mean.abs().max()
            worst = max(worst, ((leaves[0] - state.belief.mean).abs().max() / scale).item())
    print(f"{path}: {path.stat().st_size / 1024:.0f} kB, {statistics.median(seconds) * 1e6:.0f} us per step, "
          f"relative difference from the filter {worst:.1e}")  # fmt: skip
    return 0


if __name__ == "__main__":
    sys.exit(main())

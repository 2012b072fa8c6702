"""One track, one measurement at a time."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from typing import Any

from benchmarks.timing import Row, calls, timed
from torchfra.catalogue import make_scenario, scenario_filter
from torchfra.filters import Filter
from torchfra.scenarios import Tracks
from torchfra.types import Gaussian


def step(options: argparse.Namespace) -> list[Row]:
    """``Filter.step`` of each filter, eager and compiled."""
    scenario = make_scenario(options.scenario, initial=options.initial)
    data = scenario.simulate(1, 0)
    systems: dict[str, Callable[[], Any]] = {}
    for name in options.filters.split(","):
        f = scenario_filter(name, scenario)
        for mode in options.modes.split(","):
            g = copy.deepcopy(f).compile() if mode == "compiled" else f
            systems[f"{name}.step, {mode}"] = lambda g=g: stream(g, data)
    return timed(calls(systems), options.passes, scenario.steps)


def stream(f: Filter, data: Tracks) -> None:
    """The first track through a filter, step by step."""
    assert data.u is not None
    state = f.init(Gaussian(data.prior.mean[0], data.prior.scale_tril))
    for z, u in zip(data.z[0], data.u, strict=True):
        state, _ = f.step(state, z, u=u)

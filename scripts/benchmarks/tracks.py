"""Filters, eager and compiled: on batches of tracks beside other libraries, step by step, and in space."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch

from benchmarks.elsewhere import Peer, start_peers
from benchmarks.timing import Row, calls, timed
from torchfra import presets, scenarios
from torchfra.catalogue import FILTERS, make_scenario, scenario_filter
from torchfra.evaluation import run
from torchfra.filters import Filter
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.scenarios import Scenario, Tracks
from torchfra.sensors import Position
from torchfra.tree import map_tensors
from torchfra.types import Gaussian

WEAVING = slice(60, 80)
"""Steps of ``scenarios.level_then_weave`` around the begin of the manoeuvre."""
SIMULATED = 256
"""Different tracks in space; larger batches repeat them."""


def tracks(options: argparse.Namespace) -> list[Row]:
    """Of each batch size: the filters, and with ``--peers`` the others in the same passes."""
    scenario, rows = make_scenario(options.scenario, initial=options.initial), list[Row]()
    for batch in map(int, (options.batch or "1,1000,10000").split(",")):
        data = map_tensors(lambda x: x.to(options.device), scenario.simulate(batch, 0))
        rows += beside_peers(scenario, data, options, batch=batch)
    return rows


def step(options: argparse.Namespace) -> list[Row]:
    """``Filter.step`` of each filter on one track, one measurement at a time."""
    scenario = make_scenario(options.scenario, initial=options.initial)
    data = scenario.simulate(1, 0)
    systems: dict[str, Callable[[], Any]] = {}
    for name in options.filters.split(","):
        for mode, f in in_modes(scenario_filter(name, scenario), options):
            systems[f"{name}.step, {mode}"] = lambda f=f: stream(f, data)
    return timed(calls(systems), options.passes, scenario.steps)


def stream(f: Filter, data: Tracks) -> None:
    """The first track through a filter, step by step."""
    assert data.u is not None
    state = f.init(Gaussian(data.prior.mean[0], data.prior.scale_tril))
    for z, u in zip(data.z[0], data.u, strict=True):
        state, _ = f.step(state, z, u=u)


def positions(options: argparse.Namespace) -> list[Row]:
    """The alpha-beta bank on 100,000 tracks in space (or ``--batch``), in float64 and float32."""
    batch = int(options.batch or 100_000)
    tracks = scenarios.level_then_weave().simulate(SIMULATED, 0).z[:, WEAVING]
    rows: list[Row] = []
    for dtype in (torch.float64, torch.float32):
        z = tracks.repeat(-(-batch // SIMULATED), 1, 1)[:batch].to(options.device, dtype)
        systems = calls(bank_calls(z, options), options.device)
        rows += timed(systems, options.passes, batch * z.shape[1], batch=batch, dtype=str(dtype).removeprefix("torch."))
    return rows


def bank_calls(z: torch.Tensor, options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """Systems by number of gains and mode."""
    systems: dict[str, Callable[[], Any]] = {}
    for label, motion in (("two gains", ConstantVelocity(1.0, 3)), ("three gains", ConstantAcceleration(4.0, 3))):
        prior = Gaussian(torch.zeros(motion.size).to(z), torch.eye(motion.size).to(z))
        bank = presets.alphabeta(motion, Position(20.0, dims=3)).to(options.device)
        for mode, f in in_modes(bank, options):
            systems[f"alphabeta, {label}, {mode}"] = lambda f=f, prior=prior: f(z, prior)
    return systems


def in_modes(f: Filter, options: argparse.Namespace) -> Iterator[tuple[str, Filter]]:
    """The filter in each mode that is asked for."""
    asked = options.modes.split(",")
    if "compiled" in asked:
        yield "compiled", copy.deepcopy(f).compile()
    if "eager" in asked:
        yield "eager", f


def beside_peers(scenario: Scenario, data: Tracks, options: argparse.Namespace, **labels: Any) -> list[Row]:
    """The filters on these tracks, and with ``--peers`` the others in the same passes; ratios are to the first."""
    systems, count = calls(filter_calls(scenario, data, options), options.device), data.z.shape[:2].numel()
    with start_peers(scenario, data) if options.peers else nullcontext({}) as peers:  # type: ignore[attr-defined]
        rows = timed({**systems, **peers}, options.passes, count, next(iter(systems)), **labels)
        report_differences(scenario, data, peers)
    return rows


def filter_calls(scenario: Scenario, data: Tracks, options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """Systems by name of the filter and mode."""
    systems: dict[str, Callable[[], Any]] = {}
    for name in options.filters.split(","):
        f = copy.deepcopy(scenario_filter(name, scenario)).to(options.device)
        for mode, g in in_modes(f, options):
            systems[f"{name}, {mode}"] = lambda g=g: run(g, scenario, data)
        if FILTERS[name].gated and not FILTERS[name].bank:
            share = run(f, scenario, data).info.abnormal.double().mean().item()
            print(f"{name}: {share:.0%} of the steps abnormal")
    return systems


def report_differences(scenario: Scenario, data: Tracks, peers: dict[str, Peer]) -> None:
    """Prints how far the last positions of each peer are from those of ``srckf``."""
    reference = run(presets.srckf(scenario.motion, scenario.sensor), scenario, data).mean[:, -1].cpu().numpy()
    for name, peer in peers.items():
        means = peer.means()
        if means is not None:
            apart = np.median(np.abs(means - reference)[:, :2].max(-1))
            print(f"{name}: its last positions differ from those of srckf by {apart:.1e} m in the median")

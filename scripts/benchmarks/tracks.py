"""Batches of tracks through filters, eager and compiled, and through what one would use instead."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch

from benchmarks.elsewhere import Peer, start_peers
from benchmarks.timing import Row, calls, timed
from torchfra import presets
from torchfra.catalogue import FILTERS, make_scenario, scenario_filter
from torchfra.evaluation import run
from torchfra.scenarios import Scenario, Tracks


def tracks(options: argparse.Namespace) -> list[Row]:
    """Of each batch size: the filters, and with ``--peers`` the others in the same passes."""
    scenario, rows = make_scenario(options.scenario, initial=options.initial), list[Row]()
    for batch in map(int, (options.batch or "1,1000,10000").split(",")):
        rows += beside_peers(scenario, on_device(scenario.simulate(batch, 0), options.device), options, batch=batch)
    return rows


def beside_peers(scenario: Scenario, data: Tracks, options: argparse.Namespace, **labels: Any) -> list[Row]:
    """The filters on these tracks, and with ``--peers`` the others in the same passes; ratios are to the first."""
    systems, count = calls(filter_calls(scenario, data, options), options.device), data.z.shape[:2].numel()
    with start_peers(scenario, data) if options.peers else nullcontext({}) as peers:
        rows = timed({**systems, **peers}, options.passes, count, next(iter(systems)), **labels)
        report_differences(scenario, data, peers)
    return rows


def filter_calls(scenario: Scenario, data: Tracks, options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """By name of the filter and mode."""
    systems: dict[str, Callable[[], Any]] = {}
    for name in options.filters.split(","):
        f = copy.deepcopy(scenario_filter(name, scenario)).to(options.device)
        for mode in ("compiled", "eager"):
            if mode in options.modes:
                g = copy.deepcopy(f).compile() if mode == "compiled" else f
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


def on_device(x: Any, device: str) -> Any:
    """Tuples of tensors on another device."""
    if x is None or isinstance(x, torch.Tensor):
        return x if x is None else x.to(device)
    return type(x)(*(on_device(y, device) for y in x))

"""The alpha-beta bank on positions in space, with two and with three gains."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from typing import Any

import torch

from benchmarks.timing import Row, calls, timed
from torchfra import presets, scenarios
from torchfra.motion import ConstantAcceleration, ConstantVelocity
from torchfra.sensors import Position
from torchfra.types import Gaussian

STEPS = slice(60, 80)
"""Of ``scenarios.level_then_weave``, around the begin of the manoeuvre."""
SIMULATED = 256
"""Different tracks; larger batches repeat them."""


def positions(options: argparse.Namespace) -> list[Row]:
    """100,000 tracks (or ``--batch``) in float64 and float32."""
    batch = int(options.batch or 100_000)
    tracks = scenarios.level_then_weave().simulate(SIMULATED, 0).z[:, STEPS]
    rows: list[Row] = []
    for dtype in (torch.float64, torch.float32):
        z = tracks.repeat(-(-batch // SIMULATED), 1, 1)[:batch].to(options.device, dtype)
        systems = calls(bank_calls(z, options), options.device)
        rows += timed(systems, options.passes, batch * z.shape[1], batch=batch, dtype=str(dtype).removeprefix("torch."))
    return rows


def bank_calls(z: torch.Tensor, options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """By number of gains and mode."""
    systems: dict[str, Callable[[], Any]] = {}
    for label, motion in (("two gains", ConstantVelocity(1.0, 3)), ("three gains", ConstantAcceleration(4.0, 3))):
        prior = Gaussian(torch.zeros(motion.size).to(z), torch.eye(motion.size).to(z))
        f = presets.alphabeta(motion, Position(20.0, dims=3)).to(options.device)
        for mode in options.modes.split(","):
            g = copy.deepcopy(f).compile() if mode == "compiled" else f
            systems[f"alphabeta, {label}, {mode}"] = lambda g=g, prior=prior: g(z, prior)
    return systems

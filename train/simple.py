"""Learns hyperparameters of a filter: one script to copy and to change, read from top to bottom.

    python -m train.simple               # threshold and weakening of fra, a minute; writes out/simple.pt
    python -m train.simple --resume      # goes on after an interruption, to the same values

The last lines say what was learned, and the error on tracks that neither learning nor validation has seen.
"""

from __future__ import annotations

import argparse
import math
import os
from pathlib import Path
from typing import Any

import torch

from torchfra import losses, metrics, presets, scenarios
from torchfra.filters import Filter
from torchfra.scenarios import Tracks

# ---- settings: what learns, from which tracks, and how

LEARN = ("threshold", "weakening")  # names as print(filter) says them, or "all"
SCENARIO = scenarios.bearings_outliers("std")  # or a simulator of your own, or recorded tracks: see fresh() below
LEARN_SEED, VALIDATION_SEED, TEST_SEED = 0, 1, 2  # tracks of different seeds have nothing in common
BATCH = 64  # tracks of an iteration
RATE = 0.1  # of Adam, in unconstrained values: a step changes a threshold by some 10 %; falls to a tenth
CLIP = 1.0  # the largest norm of a gradient: a batch with a track that is nearly lost has a huge one
SCALE = 100.0  # m: the error above which a track counts less, so that one that is lost does not outweigh all others
VALIDATE_EVERY, PATIENCE = 10, 5  # iterations between validations; validations without improvement before the end
VALIDATION_RUNS, TEST_RUNS = 256, 500


def fresh(runs: int, seed: int, first: int = 0) -> Tracks:
    """Tracks to learn from or to judge by: measurements z (runs, T, m), their truth, prior and inputs u."""
    return SCENARIO.simulate(runs, seed, first=first)  # run i of a seed is always the same track


def loss_of(f: Filter, tracks: Tracks) -> torch.Tensor:
    """One number; without a truth, losses.innovation_nll(estimate) needs the measurements alone."""
    estimate = f(tracks.z, tracks.prior, u=tracks.u)
    return losses.robust_mse(estimate.mean, tracks.truth, SCENARIO.position, SCALE).mean()


def error(f: Filter, tracks: Tracks) -> float:
    """Position RMSE, mean over time, m."""
    with torch.no_grad():
        mean = f(tracks.z, tracks.prior, u=tracks.u).mean
    return metrics.rmse(mean, tracks.truth, SCENARIO.position).mean().item()


def main(arguments: list[str] | None = None) -> None:
    """Learns, and prints what was learned."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=100, help="at most (default: 100)")
    parser.add_argument("--out", type=Path, default=Path("out/simple.pt"), help="checkpoint (default: out/simple.pt)")
    parser.add_argument("--resume", action="store_true", help="continue from the checkpoint")
    parser.add_argument("--no-compile", action="store_true", help="interpret the filter: many times slower")
    options = parser.parse_args(arguments)
    options.out.parent.mkdir(parents=True, exist_ok=True)

    # ---- the filter: decisions stay hard while it learns, as nothing that learns here rests on them

    f = presets.fra(SCENARIO.motion, SCENARIO.sensor, learn=LEARN)
    f = f if options.no_compile else f.compile()  # of an nn.Module only the way it is run changes
    print(f)
    test = fresh(TEST_RUNS, TEST_SEED)
    before = error(f, test)
    validation = fresh(VALIDATION_RUNS, VALIDATION_SEED)
    optimiser = torch.optim.Adam(f.parameters(), lr=RATE)
    run: dict[str, Any] = {"iteration": 0, "best": float("inf"), "improved": 0}
    best = {name: x.clone() for name, x in f.state_dict().items()}

    # ---- from where it stopped

    if options.resume and options.out.exists():
        kept = torch.load(options.out, weights_only=True)
        f.load_state_dict(kept["values"])
        optimiser.load_state_dict(kept["optimiser"])
        run, best = kept["run"], kept["best"]

    # ---- iterations, each on tracks that were never seen before

    while run["iteration"] < options.iterations and run["iteration"] - run["improved"] < VALIDATE_EVERY * PATIENCE:
        i = run["iteration"]
        loss = loss_of(f, fresh(BATCH, LEARN_SEED, first=i * BATCH))
        optimiser.zero_grad()
        loss.backward()
        optimiser.param_groups[0]["lr"] = RATE * (0.55 + 0.45 * math.cos(math.pi * i / options.iterations))
        if torch.nn.utils.clip_grad_norm_(f.parameters(), CLIP).isfinite():  # else this batch teaches nothing
            optimiser.step()
        run["iteration"] = i + 1
        if (i + 1) % VALIDATE_EVERY == 0 or i + 1 == options.iterations:
            with torch.no_grad():
                score = loss_of(f, validation).item()
            print(f"iteration {i + 1}: loss {loss.item():.4f}, validation {score:.4f}")
            if score < run["best"]:
                run |= {"best": score, "improved": i + 1}
                best = {name: x.clone() for name, x in f.state_dict().items()}
            state = {"values": f.state_dict(), "optimiser": optimiser.state_dict(), "run": run, "best": best}
            torch.save(state, beside := options.out.with_suffix(".new"))
            os.replace(beside, options.out)  # whole or not at all, whenever it is interrupted

    # ---- the values of the best validation

    f.load_state_dict(best)
    print(f)
    print(f"position RMSE on {TEST_RUNS} unseen tracks: {before:.1f} m before, {error(f, test):.1f} m after")


if __name__ == "__main__":
    main()

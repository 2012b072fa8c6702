"""Gradients through 1 to 1000 steps of a filter, of a chaotic and of a stable system, and what tames them.

    python scripts/gradients.py --runs 100 --seed 1 --json out/gradients.json --figure out/gradients.png
    python scripts/gradients.py --steps 1,10,100 --filters srckf --no-compile

The systems are the attractor of Lorenz (``scripts/learned/lorenz.py``) and the same equations with rho 10, where every
path ends at a point; 5 % of the measurements are outliers of ten times the standard deviation.  Measurements come at
every step, at every 50th, or never.  The tables:

- how far back an estimate looks: the norm of the gradient of the last one with respect to the start;
- the gradient with respect to the noise of motion and sensor, unconstrained: the norm of its mean over tracks, its
  standard deviation over tracks (the root of the trace of their covariance) and the largest of a single track;
- what truncation and clipping make of that: also the cosine between its mean and the slope by differences of the loss
  of other tracks, and that between the means of two halves of the tracks; both are 1 where a batch of this size knows
  the direction;
- the slope of the error of ``fra`` in the logarithm of its gate, by soft decisions and by differences of hard ones;
- what checkpoints keep for the backward pass.

Losses are mean squared errors over all steps and components, in units of the variance of the measurement noise.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from learned.lorenz import DT, Setting, Tracks, models, simulate
from lists import check_list, numbers_in
from matplotlib.figure import Figure
from torch import Tensor
from torch.autograd.graph import saved_tensors_hooks

from torchfra import learnable, plotting
from torchfra.catalogue import make_filter
from torchfra.cli import command
from torchfra.cli.compare_command import WORTHWHILE
from torchfra.cli.compiling import add_compile_option, choose, reporters
from torchfra.filters import Filter
from torchfra.fitting.descent import bounded
from torchfra.plotting.style import finish, line_styles
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.tables import formed_table, significant
from torchfra.tree import flatten
from torchfra.types import Estimate, Gaussian

Numbers = dict[str, float]
SYSTEMS = {"stable": 10.0, "chaotic": 28.0}
"""Rho of each."""
EVERY = {"at every step": 1, "at every 50th": 50, "never": sys.maxsize}
"""Steps between measurements."""
FILTERS = {"srckf": {}, "rsrckf": {}, "fra": {}, "fra, soft": {"temperature": 1.0}, "gpb": {}}
"""Options of each; the name of the preset is what stands before a comma."""
VALUES = ("q", "std")
"""Names of the learned values."""
BEFORE = 500
"""Steps of the system before the first one."""
CUTS = (1, 10, 100)
"""Steps of ``truncate``."""
TEMPERATURES = (0.1, 0.3, 1.0, 3.0, 10.0)
SHORT, STEP = 100, 0.2
"""Steps of tracks for the last two tables, and half a difference of an unconstrained value."""
OTHERS, GATE_TRACKS, OTHER_SEED = 5, 20, 1_000_000
"""Tracks for differences per track of the rest, and those for the gate; what is added to the seed for the former."""
CLIPS = (10.0, 1.0)
"""Largest norms of a track's gradient, in medians."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the tables; returns the exit status: see ``torchfra.cli.command.exit_status``."""
    p = command.make_parser(__doc__)
    names = ",".join(name for name in FILTERS if "," not in name)
    p.add_argument("--filters", metavar="A,B", default=names, help=f"whose values are learned (default: {names})")
    p.add_argument("--steps", metavar="A,B", default="1,10,100,1000", help="(default: 1,10,100,1000)")
    p.add_argument("--figure", type=Path, metavar="FILE", help="PNG: the tables as curves")
    add_compile_option(p, f"for {WORTHWHILE:,} steps or more of all tracks together")
    command.add_runs_options(p, 100, seed=1)
    command.add_output_options(p)

    def run() -> None:
        options = p.parse_args(arguments)
        check_list(p, "filters", options.filters, names.split(","))
        gradients(options)

    return command.exit_status("gradients", run)


def gradients(options: argparse.Namespace) -> None:
    """All tables, and the figure.

    Raises:
        ValueError: steps that are no whole numbers above 0, or fewer than 2 runs.
    """
    command.check_files({"json": options.json, "figure": options.figure})
    steps = numbers_in("steps", options.steps)
    if any(number % 1 for number in steps):
        raise ValueError(f"steps: expected whole numbers, received {options.steps!r}")
    command.check_least(options, runs=2)
    lengths = sorted(map(int, steps))
    tell, _ = reporters(options.compile, options.quiet)
    compiled = choose(options.compile, options.runs * lengths[-1] >= WORTHWHILE, tell)
    make = partial(made, compiled=compiled)
    names = [name for name in FILTERS if name.split(",")[0] in options.filters.split(",")]
    short, found = min(lengths[-1], SHORT), {}
    for system, rho in progress_bar(list(SYSTEMS.items()), "system", not options.quiet):
        tracks = started(rho, options.runs, lengths[-1], options.seed)
        others = started(rho, OTHERS * options.runs, lengths[-1], options.seed + OTHER_SEED)
        found[system] = of_system(make, rho, tracks, others, names, lengths)
        more = started(rho, GATE_TRACKS * options.runs, short, options.seed)
        found[system]["gate"] = slopes(make, rho, more, short)
    found["kept"] = kept(made("srckf", 28.0, VALUES), tracks, short)
    if not options.quiet:
        print("\n\n".join(tables(found)), flush=True)
    write_results(options.json, {"runs": options.runs, "seed": options.seed, "found": found})
    if options.figure is not None:
        plotting.save(figure(found), options.figure)


# ---------------------------------------------------------------- tracks, filters and their gradients


def started(rho: float, runs: int, steps: int, seed: int) -> Tracks:
    """Tracks of a system that has run for a while, from a start that is known as well as a measurement would tell."""
    every = simulate(Setting(steps=BEFORE + steps, outliers=True, rho=rho), 1.0, runs, seed)
    start = every.truth[:, BEFORE - 1]
    off = torch.randn(start.shape, generator=torch.Generator().manual_seed(seed), dtype=start.dtype)
    prior = Gaussian(start + off, torch.eye(3, dtype=start.dtype))
    return Tracks(every.truth[:, BEFORE:], every.z[:, BEFORE:], prior)


def made(name: str, rho: float, learn: tuple[str, ...], compiled: bool = False) -> Filter:
    """A filter of a system whose values learn; ``name`` is one of ``FILTERS``."""
    motion, sensor = models(Setting(rho=rho), 1.0)
    f = make_filter(name.split(",")[0], motion, sensor)
    for attribute, value in FILTERS[name].items():
        setattr(f, attribute, value)
    f = learnable(f, learn)
    return f.compile() if compiled else f


def estimated(
    f: Filter, tracks: Tracks, steps: int, every: int = 1, shift: Tensor | None = None, **options: Any
) -> tuple[Estimate, list[Tensor], Tensor]:
    """Estimates of the first ``steps``, and what they have gradients in: values ``(B, ...)`` of each track, the start.

    Args:
        f: the filter.
        tracks: with a measurement at each step.
        steps: how many.
        every: of so many measurements one counts.
        shift: ``(P,)`` of the values, unconstrained.
        options: of the filter's call.
    """
    z = tracks.z[:, :steps].clone()
    z[:, torch.arange(1, steps + 1) % every != 0] = torch.nan
    names, shared = zip(*f.named_parameters(), strict=True)
    raw = torch.cat([p.detach().reshape(-1) for p in shared])
    parts = (raw if shift is None else raw + shift).split([p.numel() for p in shared])
    own = [
        x.reshape(p.shape).expand(len(z), *p.shape).clone().requires_grad_() for x, p in zip(parts, shared, strict=True)
    ]
    mean = tracks.prior.mean.clone().requires_grad_()
    call = (z, Gaussian(mean, tracks.prior.scale_tril))
    estimate = torch.func.functional_call(f, dict(zip(names, own, strict=True)), call, {"dt": DT, **options})
    return estimate, own, mean


def of_tracks(f: Filter, tracks: Tracks, steps: int, every: int = 1, **options: Any) -> tuple[Tensor, Tensor]:
    """The loss ``(B,)`` of each track and its gradient ``(B, P)`` with respect to the values."""
    estimate, own, _ = estimated(f, tracks, steps, every, **options)
    losses = errors(estimate, tracks)
    found = torch.autograd.grad(losses.sum(), own)
    return losses.detach(), torch.cat([g.reshape(len(losses), -1) for g in found], 1)


def differences(f: Filter, tracks: Tracks, steps: int, every: int = 1) -> Tensor:
    """Slopes ``(B, P)`` of each track's loss in each value by differences, which see through what is chaotic."""
    count = sum(p.numel() for p in f.parameters())
    with torch.no_grad():
        found = [
            errors(estimated(f, tracks, steps, every, shift)[0], tracks)
            for shift in STEP * torch.cat([torch.eye(count), -torch.eye(count)]).double()
        ]
    return torch.stack([(high - low) / (2 * STEP) for high, low in zip(found[:count], found[count:], strict=True)], -1)


def errors(estimate: Estimate, tracks: Tracks) -> Tensor:
    """Mean squared error ``(B,)`` of each track."""
    return (estimate.mean - tracks.truth[:, : estimate.mean.shape[1]]).square().mean((-1, -2))


# ---------------------------------------------------------------- the tables


def of_system(
    make: Callable[..., Filter], rho: float, tracks: Tracks, others: Tracks, names: list[str], lengths: list[int]
) -> dict[str, Any]:
    """How far back estimates look, the gradients of filters, and what cuts make of them."""
    plain = make("srckf", rho, VALUES)
    reach = {words: {n: reach_of(plain, tracks, n, every) for n in lengths} for words, every in EVERY.items()}
    learned = {}
    for name in names:
        f = plain if name == "srckf" else make(name, rho, VALUES)
        for words in list(EVERY)[: 2 if f is plain else 1]:
            row = name if words == next(iter(EVERY)) else f"{name}, {words}"
            learned[row] = {n: spread(of_tracks(f, tracks, n, EVERY[words])[1]) for n in lengths}
    cures = {words: cut(plain, tracks, others, lengths[-1], EVERY[words]) for words in list(EVERY)[:2]}
    return {"reach": reach, "learned": learned, "cures": cures}


def reach_of(f: Filter, tracks: Tracks, steps: int, every: int) -> Numbers:
    """Norms of the gradient of the sum of the last estimate's components with respect to the start."""
    estimate, _, mean = estimated(f, tracks, steps, every)
    (gradient,) = torch.autograd.grad(estimate.mean[:, -1].sum(), mean)
    norm = gradient.norm(dim=-1)
    return {"median": float(norm.median()), "largest": float(norm.max())}


def spread(gradient: Tensor) -> Numbers:
    """Of gradients ``(B, P)``: the norm of the mean, the standard deviation over tracks, and the largest norm."""
    deviation = gradient.var(0).sum().sqrt()
    return {
        "mean": float(gradient.mean(0).norm()),
        "std": float(deviation),
        "largest": float(gradient.norm(dim=-1).max()),
    }


def cut(f: Filter, tracks: Tracks, others: Tracks, steps: int, every: int) -> dict[str, Numbers]:
    """Slopes by differences, the whole gradient, truncated ones and clipped ones, with their directions."""
    right = differences(f, others, steps, every)
    losses, whole = of_tracks(f, tracks, steps, every)
    found = {"differences": right, "whole": whole}
    for k in (k for k in CUTS if k < steps):
        found[f"truncate={k}"] = of_tracks(f, tracks, steps, every, truncate=k)[1]
    median = float(whole.norm(dim=-1).median())
    found |= {f"clip={clip:g}": bounded(losses, whole, clip * median)[0] for clip in CLIPS}
    return {
        name: {**spread(g), "right": cosine(g.mean(0), right.mean(0)), "halves": halves(g)} for name, g in found.items()
    }


def halves(gradient: Tensor) -> float:
    """Cosine between the means of the first and the second half of the tracks."""
    first, second = gradient.tensor_split(2)
    return cosine(first.mean(0), second.mean(0))


def cosine(a: Tensor, b: Tensor) -> float:
    """Cosine of the angle between two vectors."""
    return float(torch.nn.functional.cosine_similarity(a, b, dim=0, eps=0.0))


def slopes(make: Callable[..., Filter], rho: float, tracks: Tracks, steps: int) -> dict[str, Numbers]:
    """Slope of the error of ``fra`` in the logarithm of its gate, with its standard error."""
    f = make("fra", rho, ("gate",))
    found = {"hard, by differences": with_error(differences(f, tracks, steps).squeeze(-1))}
    for temperature in TEMPERATURES:
        f.temperature = temperature
        found[f"temperature {temperature:g}"] = with_error(of_tracks(f, tracks, steps)[1].squeeze(-1))
    return found


def with_error(each: Tensor) -> Numbers:
    """The mean of ``(B,)`` and its standard error."""
    return {"slope": float(each.mean()), "error": float(each.std() / len(each) ** 0.5)}


def kept(f: Filter, tracks: Tracks, steps: int) -> dict[str, Numbers]:
    """MB that are kept for the backward pass, without and with checkpoints, and by how much their gradients differ."""
    _, whole = of_tracks(f, tracks, steps)
    state = sum(x.nbytes for x in flatten(f.init(tracks.prior))[0]) / 1e6
    found = {"none": {"between": saved(f, tracks, steps, None), "at once": 0.0, "difference": 0.0}}
    for k in (k for k in CUTS if k < steps):
        between = saved(f, tracks, steps, k) + -(-steps // k) * state
        other = of_tracks(f, tracks, steps, checkpoint=k)[1]
        difference = float((other - whole).abs().max() / whole.abs().max())
        found[f"checkpoint={k}"] = {"between": between, "at once": saved(f, tracks, k, None), "difference": difference}
    return found


def saved(f: Filter, tracks: Tracks, steps: int, checkpoint: int | None) -> float:
    """MB of tensors that autograd keeps of a call."""
    sizes: dict[int, int] = {}

    def keep(x: Tensor) -> Tensor:
        sizes[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    with saved_tensors_hooks(keep, lambda x: x):
        estimate = estimated(f, tracks, steps, checkpoint=checkpoint)  # held, so that no memory is used twice
    del estimate
    return sum(sizes.values()) / 1e6


# ---------------------------------------------------------------- how they are shown


def tables(found: dict[str, Any]) -> list[str]:
    """All tables, a caption above each."""
    shown = []
    for system in SYSTEMS:
        of = found[system]
        shown.append(table(f"{system}: how far back, median / largest", of["reach"], ("median", "largest")))
        shown.append(table(f"{system}: mean / standard deviation / largest", of["learned"], ("mean", "std", "largest")))
        for words, cures in of["cures"].items():
            shown.append(flat(f"{system}, measured {words}", cures))
        shown.append(flat(f"{system}: slope in the gate", of["gate"]))
    return [*shown, flat("MB kept", found["kept"])]


def table(caption: str, rows: dict[str, dict[int, Numbers]], columns: tuple[str, ...]) -> str:
    """Rows by numbers of steps; a cell has several numbers."""
    lengths = list(next(iter(rows.values())))
    cells = [[name, *(" / ".join(brief(row[n][c]) for c in columns) for n in lengths)] for name, row in rows.items()]
    return f"{caption}\n{formed_table('markdown', ['steps', *map(str, lengths)], cells)}"


def flat(caption: str, rows: dict[str, Numbers]) -> str:
    """A column for each number."""
    header = ["", *next(iter(rows.values()))]
    return f"{caption}\n{formed_table('markdown', header, [[n, *map(brief, row.values())] for n, row in rows.items()])}"


def brief(value: float) -> str:
    """Two digits; large and small numbers by their exponents."""
    return significant(value, 2) if value == 0 or 1e-3 <= abs(value) < 1e4 else f"{value:.0e}"


def figure(found: dict[str, Any]) -> Figure:
    """How far back estimates look, spread of gradients, what cuts do, and slopes in the gate."""
    drawn = Figure(figsize=(10, 7.5), layout="constrained")
    reach, learned, cures, gate = drawn.subplots(2, 2).flat
    looks = line_styles(EVERY)
    for system, dashes in zip(SYSTEMS, ("--", "-"), strict=True):
        for words, row in found[system]["reach"].items():
            style = {**looks[words], "linestyle": dashes, "marker": "o", "markersize": 3}
            label = f"{words}, {system}"
            reach.plot(list(row), [x["median"] for x in row.values()], label=label, **style)
    rows = found["chaotic"]["learned"]
    for name, style in line_styles(rows).items():
        row = rows[name]
        learned.plot(list(row), [x["std"] for x in row.values()], label=name, marker="o", markersize=3, **style)
    names = [name for name in found["chaotic"]["cures"]["at every step"] if name != "differences"]
    for (words, of), shift in zip(found["chaotic"]["cures"].items(), (-0.2, 0.2), strict=True):
        cures.bar([i + shift for i in range(len(names))], [of[name]["right"] for name in names], 0.4, label=words)
    cures.set_xticks(range(len(names)), names, rotation=20)
    for system, style in line_styles(SYSTEMS).items():
        of = found[system]["gate"]
        soft = [of[f"temperature {t:g}"] for t in TEMPERATURES]
        bars = {"yerr": [2 * x["error"] for x in soft], "marker": "o", "markersize": 3}
        gate.errorbar(TEMPERATURES, [x["slope"] for x in soft], label=f"{system}, soft", **bars, **style)
        hard = of["hard, by differences"]["slope"]
        gate.axhline(hard, label=f"{system}, hard by differences", **{**style, "linestyle": ":"})
    reach.set(xlabel="steps", ylabel="gradient in the start, median", xscale="log", yscale="log", ylim=(1e-8, 1e4))
    learned.set(xlabel="steps", ylabel="standard deviation over tracks", xscale="log", yscale="log")
    cures.set(ylabel="cosine with the slope by differences, chaotic", ylim=(-1.05, 1.05))
    gate.set(xlabel="temperature", ylabel="slope in the logarithm of the gate", xscale="log", ylim=(-0.006, 0.006))
    for axes in (reach, learned, cures, gate):
        finish(axes)
        axes.legend(fontsize="x-small")
    return drawn


if __name__ == "__main__":
    sys.exit(main())

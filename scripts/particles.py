"""What better merging could gain: ``gpb`` against a particle filter over whole histories, with the same values.

    python scripts/particles.py --runs 20 --particles 2000 --json out/particles.json

Every particle is a history of regimes and outliers, and carries the Gaussian that belongs to it (Rao-Blackwell).  Each
step continues all of them in every way; the estimate is the mean over all continuations, of which so many are kept as
there are particles: likely ones for sure, the others by chance, so that no weight is biased.  Nothing is merged; with
many particles it is what the values of ``gpb`` imply, but for the cubature of a sensor that bends.

Cells: the first bearings experiment with a good prior and outliers in standard deviations; the turns of the second one
measured by position with outliers in covariance; and the first with bursts.

Source: Chen & Liu (2000), "Mixture Kalman Filters"; Fearnhead & Clifford (2003) for which continuations are kept.
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra import metrics, presets, scenarios
from torchfra.cli import command
from torchfra.filters import GPB
from torchfra.filters.gpb.filter import read
from torchfra.gaussian.inputs import Frame, Measurements, make_frames
from torchfra.gaussian.update import correct, density, down_weight, innovation
from torchfra.linalg.triangular import apply
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.scenarios import Tracks
from torchfra.sensors import Position
from torchfra.tables import text_table
from torchfra.tree import map_tensors
from torchfra.types import Gaussian, Whitened

POSITION_STD = 50.0
"""Standard deviation of the fixes of the second cell, m."""


class Particles(NamedTuple):
    """Histories of regimes and outliers, with the Gaussian of each."""

    belief: Gaussian
    """``mean (N, n)`` and root."""
    regime: Tensor
    """``(N,)`` number of the last regime."""
    outlier: Tensor
    """``(N,)`` bool: the last measurement was an outlier."""
    log_weight: Tensor
    """``(N,)`` logs of weights that sum to one."""


def particle_filter(f: GPB, z: Tensor, prior: Gaussian, u: Tensor | None, count: int, seed: int, dt: float) -> Tensor:
    """Estimates ``(T, n)`` of one track ``z (T, m)``, with the values of ``f``.

    Raises:
        ValueError: a bank, or a sensor of several blocks.
    """
    if len(f.bank) > 1 or len(f.outliers.blocks) > 1:
        raise ValueError("f: expected one motion, and a sensor of one block")
    rng = torch.Generator().manual_seed(seed)
    frames, _ = make_frames(Measurements(z, dt, u), f.motion, f.sensor, 0)
    particles, means = first(f, prior, count, rng), []
    for k, frame in enumerate(frames):
        mean, particles = step(f, particles, frame, count, rng, doubt=float(k == 0))
        means.append(mean)
    return torch.stack(means)


def first(f: GPB, prior: Gaussian, count: int, rng: torch.Generator) -> Particles:
    """Two particles for each regime: with the prior, and with the inflated prior."""
    mean, root = prior
    log_regimes, outlying = f.regimes.initial_distribution(mean[:1]).log(), f.prior_outlier(mean)
    regimes = len(log_regimes)
    roots = torch.stack([root, f.prior_inflation(mean).sqrt() * root]).repeat_interleave(regimes, 0)
    weights = (torch.stack([torch.log1p(-outlying), outlying.log()]).unsqueeze(-1) + log_regimes).flatten()
    regime = torch.arange(regimes).repeat(2)
    return Particles(Gaussian(mean.expand(2 * regimes, -1), roots), regime, torch.zeros_like(regime).bool(), weights)


def step(
    f: GPB, before: Particles, frame: Frame, count: int, rng: torch.Generator, *, doubt: float
) -> tuple[Tensor, Particles]:
    """The mean ``(n,)`` over all continuations, and those that are kept; ``doubt`` is 1 at the first step, then 0."""
    measured = frame.measured.sum() > 0
    beliefs = f.regimes.beliefs  # all of them are that of the particle
    mixed = Gaussian(*(x[None, None, None].expand(1, beliefs, 1, *x.shape) for x in before.belief))
    ahead, doubts = log_ahead(f, before, frame.dt, measured)[None, :, None], torch.full_like(before.log_weight, doubt)
    # An outlying prior is inflated as is said.
    every, _, _ = f.predict_regimes(mixed, ahead, frame, doubts, None, frame.dt)
    predicted, log_regimes = Gaussian(*(x[0, :, 0] for x in every.belief)), every.log_weight[0, :, 0]
    widest = f.regimes.widest
    compare = f.comparison(Gaussian(*(x[widest : widest + 1] for x in predicted)), frame)
    whitened = compare(read(predicted, frame), f.outliers.blocks[0])  # of (R, N)
    sizes = f.outliers.outlier_sizes(predicted.mean)
    sizes = torch.cat([torch.ones_like(sizes[:1]), sizes])[:, None, None].expand(-1, *whitened.residual.shape[:-1])
    sizes = f.outliers.adapted(sizes, whitened.residual, 1 - frame.measured).square()  # (C, R, N)
    rooted = [innovation(down_weight(whitened, (1 / s).unsqueeze(-1).expand_as(whitened.residual))) for s in sizes]
    log_density = torch.stack([density(*pair) for pair in rooted])  # (C, R, N)
    log_density = log_density - 0.5 * frame.measured.sum() * sizes.log()
    log_weight = before.log_weight + log_regimes + log_outlier(f, before, measured).unsqueeze(1) + log_density
    log_weight = (log_weight - log_weight.flatten().logsumexp(0)).nan_to_num(nan=-torch.inf)
    means = [posterior_mean(predicted, whitened, *pair, s) for s, pair in zip(sizes, rooted, strict=True)]
    estimate = (log_weight.exp().unsqueeze(-1) * torch.stack(means)).sum((0, 1, 2))
    chosen, kept = keep(log_weight.flatten(), count, rng)
    c, r, i = torch.unravel_index(chosen, log_weight.shape)
    belief = map_tensors(lambda x: x[r, i], predicted)
    own = map_tensors(lambda x: x[r, i], whitened._replace(reads=0))._replace(reads=whitened.reads)
    own = down_weight(own, (1 / sizes[c, r, i]).unsqueeze(-1).expand_as(own.residual))
    return estimate, Particles(correct(belief, own)[0], r, c > 0, kept)


def log_ahead(f: GPB, before: Particles, dt: Tensor, measured: Tensor) -> Tensor:
    """Logs ``(R, N)`` of the transition probabilities from the regimes of the particles."""
    like = before.belief.mean[:1, :1].expand(len(f.regimes.each), 1)
    return f.regimes.transition(like, dt, measured)[:, 0, before.regime]


def log_outlier(f: GPB, before: Particles, measured: Tensor) -> Tensor:
    """Logs ``(C, N)`` of the odds of no outlier, and of one of each size; of none they stay."""
    chain = f.outliers.outlier_transition(before.belief.mean[0])
    log_chain = torch.where(measured, chain, torch.eye(2).to(chain)).log()[before.outlier.long()]  # (N, 2)
    shares = f.outliers.outlier_shares(before.belief.mean[0]).log()
    return torch.cat([log_chain[:, :1], log_chain[:, 1:] + shares], -1).mT


def posterior_mean(predicted: Gaussian, whitened: Whitened, root: Tensor, normalised: Tensor, size: Tensor) -> Tensor:
    """Means ``(R, N, n)`` after a measurement whose noise is ``size (R, N)`` times as large, as a covariance."""
    gain = predicted.scale_tril[..., : whitened.reads] @ whitened.slope.mT / size.sqrt()[..., None, None]
    weighed = torch.linalg.solve_triangular(root.mT, normalised.unsqueeze(-1), upper=True).squeeze(-1)
    return predicted.mean + apply(gain, weighed)


def keep(log_weight: Tensor, count: int, rng: torch.Generator) -> tuple[Tensor, Tensor]:
    """The continuations that are kept, at most ``count``, and logs of their weights."""
    weight = log_weight.exp()
    if int((weight > 0).sum()) <= count:
        chosen = (weight > 0).nonzero().squeeze(-1)
        return chosen, log_weight[chosen]
    order = weight.argsort(descending=True)
    sure, least = threshold(weight[order], count)
    at = (torch.rand(1, dtype=weight.dtype, generator=rng) + torch.arange(count - sure)) * least
    rest = order[sure:]
    drawn = rest[torch.searchsorted(weight[rest].cumsum(0), at).clamp_max(len(rest) - 1)]
    kept = torch.cat([weight[order[:sure]], least.expand(len(drawn))])
    return torch.cat([order[:sure], drawn]), (kept / kept.sum()).log()


def threshold(ordered: Tensor, count: int) -> tuple[int, Tensor]:
    """How many of the largest weights are above ``c``, where ``sum_i min(1, w_i / c) = count``, and ``c``."""
    left = 1 - torch.cat([ordered.new_zeros(1), ordered.cumsum(0)[: count - 1]])
    least = left / (count - torch.arange(count))
    sure = int((ordered[:count] >= least).long().cumprod(0).sum())
    return sure, least[min(sure, count - 1)]


# ---------------------------------------------------------------- the cells


def cells(runs: int, seed: int) -> dict[str, tuple[GPB, Tracks]]:
    """By name the filter, whose levels of process noise share a belief as in each particle, and the tracks."""
    made = {}
    for name, outliers in (("1, good prior, std", "std"), ("1, good prior, bursts", "bursts")):
        scenario = scenarios.bearings_outliers(outliers, initial="truth")
        f = presets.gpb(scenario.motion, scenario.sensor, separate_levels=0, noise="stated", unreliable=0.0)
        made[name] = f, scenario.simulate(runs, seed)
    scenario = scenarios.bearings_manoeuvre("none")
    tracks, rng = scenario.simulate(runs, seed), torch.Generator().manual_seed(seed)
    noise = torch.randn(*tracks.truth.shape[:2], 2, dtype=torch.float64, generator=rng)
    wild = torch.rand(*noise.shape[:2], 1, generator=rng) < 0.1
    z = tracks.truth[..., :2] + POSITION_STD * torch.where(wild, 10**0.5, 1.0) * noise
    f = presets.gpb(scenario.motion, Position(POSITION_STD), separate_levels=0, noise="stated", unreliable=0.0)
    made["turns by position, covariance"] = f, tracks._replace(z=z, u=None)
    return made


def compare(f: GPB, tracks: Tracks, count: int, seed: int, *, progress: bool) -> dict[str, float]:
    """Mean position RMSE of ``gpb``, its lagged estimate, ``gpb`` whose levels share one belief, and particles."""
    default = presets.gpb(f.bank[0], f.sensor, noise="stated", unreliable=0.0)
    with torch.no_grad():
        own, shared = (each(tracks.z, tracks.prior, u=tracks.u) for each in (default, f))
        roots = tracks.prior.scale_tril.expand(len(tracks.z), *tracks.prior.scale_tril.shape[-2:])
        priors = (Gaussian(*x) for x in zip(tracks.prior.mean, roots, strict=True))
        each = [
            particle_filter(f, z, prior, tracks.u, count, seed + i, 1.0)
            for i, (z, prior) in enumerate(progress_bar(list(zip(tracks.z, priors, strict=True)), "run", progress))
        ]
    found = {"gpb": own.mean, "lagged": own.info.lagged.mean, "shared": shared.mean}
    found["particles"] = torch.stack(each)
    return {name: metrics.rmse(mean, tracks.truth, slice(0, 2)).mean().item() for name, mean in found.items()}


def main(arguments: list[str] | None = None) -> int:
    """Prints the table; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    p = command.make_parser(__doc__)
    p.add_argument("--particles", type=int, default=2000, metavar="N", help="histories kept (default: 2000)")
    command.add_runs_options(p, 20, seed=3)
    command.add_output_options(p)
    return command.exit_status("particles", lambda: particles(p.parse_args(arguments)))


def particles(options: argparse.Namespace) -> None:
    """All cells."""
    command.check_files({"json": options.json})
    command.check_least(options, particles=1, runs=1)
    results = {
        name: compare(*cell, options.particles, options.seed, progress=not options.quiet)
        for name, cell in cells(options.runs, options.seed).items()
    }
    if not options.quiet:
        rows = [[name, *(f"{x:.1f}" for x in of.values()), f"{of['gpb'] / of['particles'] - 1:+.1%}"]
                for name, of in results.items()]  # fmt: skip
        print(
            text_table(["cell", "gpb m", "lagged m", "one belief m", "particles m", "gpb above"], rows, align="<>>>>>"),
            flush=True,
        )
    settings = {"runs": options.runs, "seed": options.seed, "particles": options.particles}
    write_results(options.json, settings | {"cells": results})
    failures = command.Failures()
    failures.messages += [f"{name}: an error that is not finite" for name, of in results.items()
                          if not all(map(math.isfinite, of.values()))]  # fmt: skip
    failures.end()


if __name__ == "__main__":
    sys.exit(main())

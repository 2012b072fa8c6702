"""Filters of stated and of fitted noise beside a network that learns the gain, on the attractor of Lorenz.

    python scripts/lorenz.py --runs 200 --seed 1 --json out/lorenz.json
    python scripts/lorenz.py --settings '5 %% outliers' --filters srckf,gpb --variances 0.001 --fit ''

The system and its settings are those of KalmanNet (Revach et al. 2022): see ``scripts/learned/lorenz.py``.  Errors are
root mean squares per component over all tracks and steps, in units of the standard deviation of the measurement noise.
A fitted filter has learned process and measurement noise of each component from 200 other tracks (``torchfra.fit``):
from the likelihood of their measurements, or from squared errors with a truth, as the OKF of Greenberg et al. (2023).
The network has learned from batches of 64 tracks with their truth; where there are outliers, another one has learned
without.

In the setting "one step ahead" errors are not divided by anything, and those that filternet (Song et al.) has published
stand beside them: the best of its four networks for each variance.  There a Gaussian sum of ``ukf`` runs as well: see
``scripts/learned/gaussian_sum.py``.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial

import torch
from learned.gaussian_sum import followed
from learned.kalmannet import KalmanNet, trained
from learned.lorenz import DT, SETTINGS, Setting, Tracks, models, simulate
from lists import check_list, numbers_in

import torchfra
from torchfra.catalogue import make_filter, track_filters
from torchfra.cli import command
from torchfra.filters import Filter
from torchfra.motion import Motion
from torchfra.running.progress import progress_bar
from torchfra.running.versions import write_results
from torchfra.tables import formed_table, significant

FILTERS, FITTED = "ekf,ukf,srckf,ghckf,rsrckf,gpb", "srckf,rsrckf"
PUBLISHED = {1.0: 0.39873, 10.0: 0.82325, 100.0: 2.01605, 1000.0: 5.28136}
"""Root mean square errors per component by the variance of the measurement noise: filternet's table, its best row."""
LOSSES = {"fitted": "likelihood", "fitted to truth": "mse"}
"""What noise is fitted by; the likelihood of the measurements needs no truth."""
LEARNED_FROM, BATCH = 200, 64
"""Tracks of a fit, and of an iteration of the network."""
UNSEEN = "learned without outliers"
"""Said of a network that has seen no outliers where there are some."""
LEARNING = 1_000_000
"""Added to the seed for tracks to learn from."""


def main(arguments: list[str] | None = None) -> int:
    """Prints the tables; returns the exit status: see ``torchfra.cli.command.exit_status``."""
    p = command.make_parser(__doc__)
    names = ",".join(SETTINGS)
    p.add_argument(
        "--settings", metavar="A,B", default=names, help=f"which (default: all of {names})".replace("%", "%%")
    )
    p.add_argument("--filters", metavar="A,B", default=FILTERS, help=f"with stated noise (default: {FILTERS})")
    p.add_argument("--fit", metavar="A,B", default=FITTED, help=f"with fitted noise, or '' (default: {FITTED})")
    p.add_argument("--variances", metavar="A,B", default="1,0.001", help="of the measurement noise (default: 1,0.001)")
    p.add_argument("--network", type=int, default=200, metavar="N", help="iterations, or 0 (default: 200)")
    command.add_runs_options(p, 200, seed=1)
    command.add_output_options(p)

    def run() -> None:
        options = p.parse_args(arguments)
        check_list(p, "settings", options.settings, SETTINGS)
        check_list(p, "filters", options.filters, track_filters())
        check_list(p, "fit", options.fit, ["", *track_filters()])
        compare(options)

    return command.exit_status("lorenz", run)


def compare(options: argparse.Namespace) -> None:
    """All settings, and the tables when the last one is done.

    Raises:
        ValueError: variances that are no numbers above 0, fewer than 1 run or 0 iterations, or a filter that these
            models do not make.
    """
    command.check_files({"json": options.json})
    variances = numbers_in("variances", options.variances)
    command.check_least(options, runs=1, network=0)
    cells = [
        (name, variance)
        for name in options.settings.split(",")
        for variance in (PUBLISHED if SETTINGS[name].published else variances)
    ]
    first, variance = cells[0]
    for name in filter(None, f"{options.filters},{options.fit}".split(",")):
        make_filter(name, *models(SETTINGS[first], variance))  # which one cannot be made is said before the first run
    found: dict[str, dict[str, dict[str, float]]] = {}
    for name, variance in progress_bar(cells, "setting", not options.quiet):
        found.setdefault(name, {})[f"{variance:g}"] = of_setting(SETTINGS[name], variance, options)
    if not options.quiet:
        print(table(found), flush=True)
    kept = {"runs": options.runs, "seed": options.seed, "iterations": options.network}
    write_results(options.json, {**kept, "errors": found})


def of_setting(setting: Setting, variance: float, options: argparse.Namespace) -> dict[str, float]:
    """Errors of all filters in a setting, by their names."""
    motion, sensor = models(setting, variance)
    tracks = simulate(setting, variance, options.runs, options.seed)
    # What is learned of short tracks is used on long ones, as KalmanNet is.
    short, seed = setting._replace(steps=min(setting.steps, 100)), options.seed + LEARNING
    scale = 1.0 if setting.published else variance**0.5
    errors = {}
    for name in options.filters.split(","):
        errors[name] = error(estimated(make_filter(name, motion, sensor), tracks, motion), tracks, scale)
    others = simulate(short, variance, LEARNED_FROM, seed)
    for name in filter(None, options.fit.split(",")):
        for words, loss in LOSSES.items():
            f = fitted(make_filter(name, motion, sensor), others, loss)
            errors[f"{name}, {words}"] = error(estimated(f, tracks, motion), tracks, scale)
    learned_from = {"KalmanNet, small": short}
    if setting.outliers:
        learned_from[f"KalmanNet, small, {UNSEEN}"] = short._replace(outliers=False)
    for name, seen in learned_from.items() if options.network else ():
        torch.manual_seed(options.seed)
        network = KalmanNet(motion, sensor)
        trained(network, partial(of_batch, seen, variance, seed + 1), options.network)
        with torch.no_grad():
            errors[name] = error(network.estimated(tracks).double(), tracks, scale)
    if setting.published:
        errors["Gaussian sum"] = error(summed(make_filter("ukf", motion, sensor), tracks, motion), tracks, scale)
        errors["published"] = PUBLISHED[variance]
    return errors


def of_batch(setting: Setting, variance: float, seed: int, number: int) -> Tracks:
    """Tracks that a network learns from in one iteration."""
    return simulate(setting, variance, BATCH, seed + number)


def estimated(f: Filter, tracks: Tracks, motion: Motion) -> torch.Tensor:
    """Estimates ``(B, T, 3)`` of what is asked for."""
    with torch.no_grad():
        return tracks.asked(f(tracks.z, tracks.prior, dt=DT).mean, motion)


def summed(f: Filter, tracks: Tracks, motion: Motion) -> torch.Tensor:
    """The same of a belief that is cut into many once noise has made it wide."""
    with torch.no_grad():
        means, weight = followed(f, tracks.z, tracks.prior, DT)
        asked = torch.stack([tracks.asked(one, motion) for one in means])
        weight = torch.cat([weight[..., :1], weight], -1)  # a prediction has the weight that was there before it
        return (weight.unsqueeze(-1) * asked).sum(0)


def fitted(f: Filter, tracks: Tracks, loss: str) -> Filter:
    """The filter with the noise that makes a loss of ``torchfra.fit`` smallest."""
    truth = tracks.truth[:, : tracks.z.shape[1]]
    data = {"z": tracks.z, "prior": tracks.prior, "truth": truth, "dt": torch.tensor(DT, dtype=torch.float64)}
    return torchfra.fit(f, data, learn=("q", "std"), loss=loss, iterations=60, quiet=True).filter


def error(means: torch.Tensor, tracks: Tracks, scale: float) -> float:
    """Root mean square per component, in units of ``scale``."""
    return float((means - tracks.truth).square().mean().sqrt()) / scale


def table(found: dict[str, dict[str, dict[str, float]]]) -> str:
    """Filters by settings and variances."""
    cells = {f"{name}, {variance}": of for name, by in found.items() for variance, of in by.items()}
    names = list(dict.fromkeys(name for of in cells.values() for name in of))
    rows = [[name, *("" if name not in of else significant(of[name]) for of in cells.values())] for name in names]
    return formed_table("markdown", ["error over noise", *cells], rows)


if __name__ == "__main__":
    sys.exit(main())

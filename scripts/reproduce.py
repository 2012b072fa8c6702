"""Repeats the experiments of the papers with torchfra: their figures, averages and run times.

    python scripts/reproduce.py bearings-outliers       Wang et al. (2021), scenario 1: figures 2-5
    python scripts/reproduce.py bearings-manoeuvre      scenario 2: figures 6-9
    python scripts/reproduce.py adsb-turns              Du & Zhang (2020): errors by coordinate, model probabilities
    python scripts/reproduce.py growth                  Qin et al. (2018): mean square errors over the contamination
    python scripts/reproduce.py reentry                 position, velocity and parameter over time
    python scripts/reproduce.py alpha-beta              Xu et al.: errors by axis, levels, decisions around two outliers
    python scripts/reproduce.py clutter-straight        Chen, Zou & Wu: errors by target, association, lost tracks
    python scripts/reproduce.py clutter-crossing        targets that turn and meet
                                                        (--noise-scale 4: measurement noise four times larger)
    python scripts/reproduce.py noise-change            one aircraft alone: errors of range, azimuth, elevation
    python scripts/reproduce.py bearings-outliers --outliers std --runs 500 --json out/std.json

The seed fixes every run of an experiment.  The JSON file also has run times relative to the UKF on the same runs.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from pathlib import Path

from papers import adsb, alphabeta, bearings, clutter, huber
from papers.experiment import Experiment, Study

from torchfra import plotting
from torchfra.catalogue import learned_filter, make_scenario, track_filters
from torchfra.cli import command
from torchfra.evaluation import evaluate, not_finite, report
from torchfra.running.atomic_write import write_json

EXPERIMENTS: dict[str, Experiment] = (
    bearings.EXPERIMENTS | adsb.EXPERIMENTS | huber.EXPERIMENTS | alphabeta.EXPERIMENTS | clutter.EXPERIMENTS
)
_SCENARIO_OPTIONS = ("outliers", "truth_noise", "initial", "turns", "radar", "noise_scale", "clutter")


def main(arguments: list[str] | None = None) -> int:
    """Runs an experiment; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    return command.exit_status("reproduce", lambda: experiment(parser().parse_args(arguments)))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = command.make_parser(__doc__)
    p.add_argument("experiment", choices=list(EXPERIMENTS))
    command.add_runs_options(p, 100)
    _add_scenario_options(p)
    p.add_argument("--sizes", metavar="A,B", help="of growth and reentry: how many times contaminated noise grows, for "
                   "the figure over it (default of growth: 1 to 20; of reentry: none)")  # fmt: skip
    p.add_argument(
        "--filters",
        metavar="A,B",
        help=f"some of {', '.join(track_filters())}, of bearings-* also {', '.join(bearings.OWN)}, of adsb-turns imm3 "
        "and imm5, of alpha-beta f1, f2, f3, paper and paper_polar; of clutter-* ukf_jpda_paper and iaukf_jpda_paper, "
        "and with safeguards against lost tracks ukf_jpda_safe and iaukf_jpda_safe; those on _paper, and ukf and iaukf "
        "of noise-change, also with _same_points behind, which draw no new points (default: the paper's)",
    )
    p.add_argument(
        "--literal",
        action="store_true",
        help=f"of bearings-*: also {bearings.LITERAL}, the paper's formulas without safeguards that it does not give",
    )
    p.add_argument("--learned", metavar="NAME=FILE", help="also the filter NAME with values that training wrote")
    p.add_argument("--compile", action="store_true", help="run compiled kernels")
    p.add_argument("--plots", type=Path, metavar="DIR", help="write the figures there")
    command.add_output_options(p)
    return p


def _add_scenario_options(p: argparse.ArgumentParser) -> None:
    p.add_argument("--outliers", help="not of adsb-turns: covariance (default), std, none; of bearings also offset "
                   "and bursts")  # fmt: skip
    p.add_argument("--truth-noise", type=float, help="of bearings, clutter-* and noise-change: variance of the "
                   "process noise of the truth, m^2/s^4")  # fmt: skip
    p.add_argument("--initial", choices=["paper", "truth"], help="of bearings: state to start from")
    p.add_argument("--turns", choices=["acceleration", "arc"], help="of adsb-turns (default: acceleration)")
    p.add_argument("--radar", choices=["paper", "precise"], help="of reentry (default: paper)")
    p.add_argument("--noise-scale", type=float, metavar="K", help="of clutter-* (default: 1) and noise-change (5): "
                   "how many times larger than assumed the measurement noise becomes")  # fmt: skip
    p.add_argument("--clutter", type=int, metavar="N", help="of clutter-*: false measurements per scan (default: 6)")


def experiment(options: argparse.Namespace) -> None:
    """Runs it, prints a table, and writes results and figures."""
    command.check_folder("plots", options.plots)
    command.check_files({"json": options.json})
    chosen = EXPERIMENTS[options.experiment]
    study = make_study(chosen, options)
    results = evaluate(study.scenario, study.filters, runs=study.runs, seed=study.seed, compile=study.compile,
                       progress=study.progress)  # fmt: skip
    summary, table = chosen.summarise(study, results)
    failures = command.Failures()
    if not options.quiet:
        settings = ", ".join(f"{key} {value}" for key, value in study.scenario.settings.items())
        print(f"{study.title}, seed {study.seed}, {settings}\n{table}", flush=True)
    if options.json is not None:
        with failures.of("json"):
            write_json(options.json, report(study.scenario, results, runs=study.runs, seed=study.seed) | summary)
    if options.plots is not None:
        with failures.of("plots"):
            for name, figure in chosen.draw(study, results, summary).items():
                with failures.of(name):
                    plotting.save(figure, options.plots / f"{name}.png")
    failures.messages += not_finite(results) + [f"{place}: not finite" for place in infinite(summary)]
    failures.end()


def infinite(summary: object, place: str = "") -> Iterator[str]:
    """Where in nested dictionaries and lists there are infinite numbers; NaN stands for what there is none of."""
    if isinstance(summary, dict):
        for key, value in summary.items():
            yield from infinite(value, f"{place} {key}".strip())
    elif isinstance(summary, list):
        yield from dict.fromkeys(found for value in summary for found in infinite(value, place))
    elif isinstance(summary, float) and math.isinf(summary):
        yield place


def make_study(chosen: Experiment, options: argparse.Namespace) -> Study:
    """The scenario and the filters that the options name.

    Raises:
        ValueError: an option that the experiment does not take, an unknown filter, a file without learned values.
    """
    settings = {key: getattr(options, key) for key in _SCENARIO_OPTIONS}
    scenario = make_scenario(options.experiment, **settings)
    names = options.filters.split(",") if options.filters else list(chosen.defaults)
    if options.literal and options.experiment not in bearings.EXPERIMENTS:
        raise ValueError(f"literal: {options.experiment} takes no such option")
    filters = chosen.filters(scenario, names + [bearings.LITERAL] * options.literal)
    if options.learned is not None:
        name, equals, file = options.learned.partition("=")
        if not equals:
            raise ValueError(f"learned: expected NAME=FILE, received {options.learned!r}")
        filters["learned"] = learned_filter(file, scenario, name)
    return Study(scenario, filters, options.runs, options.seed, settings, sizes(chosen, options), options.compile,
                 progress=not options.quiet)  # fmt: skip


def sizes(chosen: Experiment, options: argparse.Namespace) -> list[float]:
    """The numbers of ``--sizes``, or the default of the experiment.

    Raises:
        ValueError: the experiment takes no sizes, or they are not numbers of 1 or more.
    """
    if options.sizes is None:
        return [float(size) for size in chosen.sizes or ()]
    if chosen.sizes is None:
        raise ValueError(f"sizes: {options.experiment} takes no such option, received {options.sizes!r}")
    try:
        numbers = [float(size) for size in options.sizes.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(1 <= size < math.inf for size in numbers):
        raise ValueError(f"sizes: expected numbers of 1 or more, received {options.sizes!r}")
    return numbers


if __name__ == "__main__":
    sys.exit(main())

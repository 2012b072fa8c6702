"""Repeats the experiments of the papers: their figures, averages and run times, as ours.

    python scripts/reproduce.py bearings-outliers       Wang et al. (2021), scenario 1: figures 2-5
    python scripts/reproduce.py bearings-manoeuvre      scenario 2: figures 6-9
    python scripts/reproduce.py adsb-turns              Du & Zhang (2020): errors by coordinate, model probabilities
    python scripts/reproduce.py growth                  Qin et al. (2018): mean square errors over the contamination
    python scripts/reproduce.py reentry                 position, velocity and parameter over time
    python scripts/reproduce.py alpha-beta              Xu et al.: errors by axis, levels, decisions around two outliers
    python scripts/reproduce.py clutter-straight        Chen, Zou & Wu: errors by target, association, lost tracks
    python scripts/reproduce.py clutter-crossing        targets that turn and meet (--noise-scale 4: under more noise)
    python scripts/reproduce.py noise-change            one of them alone: range, azimuth, elevation
    python scripts/reproduce.py bearings-outliers --outliers std --runs 500 --json out/std.json

Every run of an experiment is fixed by the seed.  Run times are relative to the UKF on the same runs.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from experiments import (
    PAPER,
    adsb,
    averages,
    averages_table,
    bearings,
    by_size,
    contaminated,
    filters_of,
    rms_table,
    sizes_table,
    weave_decisions,
    weave_figures,
    weave_table,
)
from scans import association_table, associations, draw_scans, scan_figures, scan_table

from torchfra import keep_memory
from torchfra.app import plotting
from torchfra.app.atomic_write import write_json
from torchfra.app.evaluate import evaluate, report, table
from torchfra.catalogue import SCENARIOS, learned_filter, make_scenario, track_filters
from torchfra.kernel.build import CompileError


def parser() -> argparse.ArgumentParser:
    """The command line."""
    form = argparse.RawDescriptionHelpFormatter
    p = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    p.add_argument("experiment", choices=list(SCENARIOS))
    p.add_argument("--runs", type=int, default=100, metavar="M", help="Monte-Carlo runs (default: 100)")
    p.add_argument("--seed", type=int, default=0, metavar="S", help="of the random numbers (default: 0)")
    p.add_argument("--outliers", help="not of adsb-turns: covariance (default), std, none, of bearings also offset")
    p.add_argument("--truth-noise", type=float, help="of bearings, clutter-* and noise-change: variance of "
                   "noise on the truth, m^2/s^4")  # fmt: skip
    p.add_argument("--initial", choices=["paper", "truth"], help="of bearings: state to start from")
    p.add_argument("--turns", choices=["acceleration", "arc"], help="of adsb-turns (default: acceleration)")
    p.add_argument("--radar", choices=["paper", "precise"], help="of reentry (default: paper)")
    p.add_argument("--noise-scale", type=float, metavar="K", help="of clutter-* (default: 1) and noise-change (5): "
                   "how many times larger than assumed the noise becomes")  # fmt: skip
    p.add_argument("--clutter", type=int, metavar="N", help="of clutter-*: false measurements per scan (default: 6)")
    p.add_argument("--sizes", metavar="A,B", help="of growth and reentry: how many times contaminated noise grows, for "
                   "the figure over it (default of growth: 1 to 20; of reentry: none)")  # fmt: skip
    known = ", ".join(track_filters())
    p.add_argument(
        "--filters",
        metavar="A,B",
        help=f"out of {known}, of adsb-turns imm3 and imm5, of alpha-beta f1, f2, f3 and paper; of "
        "clutter-* ukf_jpda_paper, ukf_jpda_safe (with our safeguards), iaukf_jpda_paper and iaukf_jpda_safe "
        "(default: the paper's)",
    )
    p.add_argument("--learned", metavar="NAME=FILE", help="also the filter NAME with values that training wrote")
    p.add_argument("--compile", action="store_true", help="run compiled kernels")
    p.add_argument("--json", type=Path, metavar="FILE", help="write the results for machines to read")
    p.add_argument("--plots", type=Path, metavar="DIR", help="write the figures there")
    p.add_argument("--quiet", action="store_true", help="no progress bar, and nothing printed but errors")
    return p


def main(arguments: list[str] | None = None) -> int:
    """Runs an experiment; 0 if it did, 2 with one line on standard error if something handed in was wrong."""
    options = parser().parse_args(arguments)
    keep_memory()
    try:
        said = experiment(options)
    except (ValueError, OSError, CompileError) as error:
        print(f"reproduce: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    if not options.quiet:
        print(said)
    return 0


def experiment(options: argparse.Namespace) -> str:
    """Runs it, writes results and figures, and returns what to print."""
    given = {key: getattr(options, key) for key in ("outliers", "truth_noise", "initial", "turns", "radar",
                                                       "noise_scale", "clutter")}  # fmt: skip
    scenario = make_scenario(options.experiment, **given)
    names = (options.filters or PAPER[scenario.name]).split(",")
    filters = filters_of(scenario, names)
    if options.learned is not None:
        name, equals, file = options.learned.partition("=")
        if not equals:
            raise ValueError(f"learned: expected NAME=FILE, received {options.learned!r}")
        filters["learned"] = learned_filter(file, scenario, name)
    how = {"runs": options.runs, "seed": options.seed, "compile": options.compile, "progress": not options.quiet}
    sizes = sizes_of(options)
    results = evaluate(scenario, filters, **how)
    whole = report(scenario, results, runs=options.runs, seed=options.seed)
    title = f"{scenario.name}, {options.runs} runs"
    if scenario.name == "adsb-turns":
        whole["averages"] = averages(results)
        whole["models"] = scenario.bank.names if scenario.bank is not None else []
        shown = averages_table(whole["averages"], results)
    elif scenario.name == "alpha-beta":
        whole["decisions"] = weave_decisions(scenario, filters, options.runs, options.seed)
        shown = weave_table(whole["decisions"])
    elif scenario.clutter is not None or scenario.name == "noise-change":
        whole["scans"] = scan_figures(scenario, filters, options.runs, options.seed, not options.quiet)
        shown = scan_table(whole["scans"])
        if scenario.clutter is not None:
            whole["associations"] = associations(scenario, filters, options.seed)
            shown += "\n" + association_table(whole["associations"])
    elif scenario.name in ("growth", "reentry"):
        whole["by_size"] = by_size(scenario.name, sizes, filters, given, **how)
        shown = rms_table(results, scenario) + ("\n" + sizes_table(whole["by_size"]) if sizes else "")
    else:
        shown = table(results)
    if options.json is not None:
        write_json(options.json, whole)
    if options.plots is not None:
        if "scans" in whole:
            figures = draw_scans(scenario, filters, whole["scans"], options.runs, options.seed)
        elif "by_size" in whole:
            figures = contaminated(scenario, filters, results, whole["by_size"], title)
        else:
            draw = {"adsb-turns": adsb, "alpha-beta": weave_figures}.get(scenario.name, bearings)
            figures = draw(scenario, filters, results, options.runs, options.seed)
        for name, figure in figures.items():
            plotting.save(figure, options.plots / f"{name}.png")
    settings = ", ".join(f"{key} {value}" for key, value in scenario.settings.items())
    return f"{title}, seed {options.seed}, {settings}\n{shown}"


def sizes_of(options: argparse.Namespace) -> list[float]:
    """What ``--sizes`` says."""
    if options.experiment not in ("growth", "reentry"):
        if options.sizes is not None:
            raise ValueError(f"sizes: {options.experiment} takes no such option, received {options.sizes!r}")
        return []
    if options.sizes is None:
        return [float(size) for size in range(1, 21)] if options.experiment == "growth" else []
    try:
        return [float(size) for size in options.sizes.split(",")]
    except ValueError:
        raise ValueError(f"sizes: expected numbers of 1 or more, received {options.sizes!r}") from None


if __name__ == "__main__":
    sys.exit(main())

"""Learns a filter's hyperparameters on tracks: by gradient descent, or by a search.

    python -m train.tune fra_bearings                          both bearings scenarios, a minute on two cores
    python -m train.tune fra_bearings --resume                 continues from the last checkpoint, bit by bit
    python -m train.tune fra_bearings iterations=50 lr=0.1     any field of train.config.Config
    python -m train.tune fra_recorded files=a.csv,b.csv        recorded tracks: needs no truth
    python -m train.tune noise scenario=own.py:make            your simulator: a function that makes a Scenario
    python -m train.tune gpb                                   one set of values for all models, without gradients
    torchrun --nproc-per-node 2 -m train.tune fra_bearings     two processes share each batch

Runs (train/runs.py): fra_bearings, fra_recorded, gpb, switching (interacting models), contaminated (the
Huber score), association (scans of several targets in clutter), noise, recover, recover_gpb.  Written to out/train/RUN:
config.json, log.csv, checkpoint.pt, the learned state_dict.pt (of the best validation), learning.png and results.json
with the errors on test tracks before and after.  To use the learned values:

    fra = torchfra.presets.fra(scenario.motion, scenario.sensor)
    fra.load_state_dict(torch.load("out/train/fra_bearings/state_dict.pt", weights_only=True))
"""

from __future__ import annotations

import csv
import dataclasses
import io
import math
import sys
from pathlib import Path
from typing import Any

from torchfra import plotting, state_files
from torchfra.cli.command import Failures, add_quiet_option, check_files, check_folder, exit_status, make_parser
from torchfra.fitting.descent import Descent
from torchfra.hyper import named
from torchfra.running import checkpoints, distributed
from torchfra.running.atomic_write import write, write_json, write_text
from torchfra.running.progress import progress_bar
from torchfra.tables import printable
from torchfra.types import CompileError
from train.config import Config
from train.gpb.regret import Regrets
from train.report import not_finite, report, report_text
from train.runs import RUNS, configured
from train.training import Training

NEWEST, BEST, LOG = "checkpoint.pt", "state_dict.pt", "log.csv"
WRITTEN = (NEWEST, checkpoints.previous(Path(NEWEST)).name, BEST, LOG, "config.json", "results.json", "learning.png")


def train(descent: Descent, out: Path, name: str, *, board: Any = None, quiet: bool = False) -> None:
    """Iterates until the end, and saves at each validation.

    Args:
        descent: of a training.
        out: the folder.
        name: of the run.
        board: the TensorBoard log, if there is one.
        quiet: whether to show neither a progress bar nor, without one, a line for each validation.
    """
    bar = progress_bar(descent.remaining, name, not quiet)
    for row in descent.run(bar):
        iteration, loss = row["iteration"], row["loss"]
        if "validation" in row and not quiet and not hasattr(bar, "set_postfix"):
            print(f"{name} {iteration}: loss {loss:.4f}, validation {row['validation']:.4f}", flush=True)
        if "validation" in row and not descent.done:
            save(descent, out)
        if board is not None:
            for key, value in row.items():
                board.add_scalar(key, value, iteration)
    for note in descent.notes:
        print(f"{name}: {note}", flush=True)


def save(descent: Descent, out: Path) -> None:
    """The first process writes checkpoint.pt, the best values as state_dict.pt, and log.csv.

    Raises:
        OSError: a file cannot be written; the message on a checkpoint names the remaining one.
    """
    if distributed.rank() > 0:
        return
    descent.save(out / NEWEST)
    write(out / BEST, lambda file: file.write(state_files.pack(descent.best)))
    text = io.StringIO()
    columns = dict.fromkeys(key for row in descent.rows for key in row)
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(descent.rows)
    write_text(out / LOG, text.getvalue())


def search(training: Training, descent: Descent) -> None:
    """Coordinate search over values without a gradient: each in turn is set to that of the best validation."""
    f = training.filter
    f.load_state_dict(descent.best)
    for name, values in training.config.search.items():
        for hyper in named(f, (name,)).values():
            for value in values:
                hyper.set(value, name)
                descent.keep(training.validation())
            f.load_state_dict(descent.best)


def _tensorboard(out: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ImportError("tensorboard=true needs TensorBoard: pip install 'torchfra[tensorboard]'") from None
    return SummaryWriter(out)


def tune(config: Config, out: Path, *, resume: bool = False, quiet: bool = False) -> dict[str, Any]:
    """A run from its start, or from its last checkpoint; the contents of results.json.

    Raises:
        ValueError: ``out`` holds a run and ``resume`` is False; or see ``Training``.
        OSError: a file cannot be written; checked before the first iteration where possible.
        IncompleteError: the run has ended, but a file is missing or a result is not finite.
    """
    first = distributed.rank() == 0
    quiet = quiet or not first
    if not resume and checkpoints.found(out / NEWEST):
        raise ValueError(f"out: {out} holds a run already: --resume continues it, --out DIR writes elsewhere")
    check_folder("out", out)
    check_files({f"out, {name}": out / name for name in WRITTEN})
    training = Regrets(config, quiet=quiet) if config.loss == "regret" else Training(config)
    start, name = training.natural(), printable(config.name)
    no_score = training.task_weights.new_tensor(math.inf)  # any validation improves on the start
    descent = Descent(training, training.filter, no_score, dataclasses.asdict(config))
    if resume and descent.resume(out / NEWEST, "train") and not quiet:
        print(f"resumed after iteration {descent.iteration}")
    board = _tensorboard(out) if config.tensorboard and first else None
    if first:
        write_json(out / "config.json", dataclasses.asdict(config))
    train(descent, out, name, board=board, quiet=quiet)
    search(training, descent)
    save(descent, out)
    result = report(training, descent, start, quiet=quiet)
    if not quiet:
        print(f"{report_text(result)}\nwritten to {printable(str(out))}", flush=True)
    if first:
        _write(descent, start, result, out)
    return result


def _write(descent: Descent, start: dict[str, float], result: dict[str, Any], out: Path) -> None:
    """The results and the figure.

    Raises:
        IncompleteError: one of them cannot be written, or there is nothing finite to report.
    """
    failures = Failures()
    with failures.of("results.json"):
        write_json(out / "results.json", result)
    with failures.of("learning.png"):
        title = f"{descent.settings['name']}, seed {descent.settings['seed']}"
        figure = plotting.learning_curve(descent.rows, start, title)
        plotting.save(figure, out / "learning.png")
    if not descent.scores.isfinite():
        failures.messages.append("no validation was finite: state_dict.pt has the values of the start")
    failures.messages += not_finite(result)
    failures.end()


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; returns its exit status: see ``torchfra.cli.command.exit_status``."""
    parser = make_parser(__doc__, "python -m train.tune")
    parser.add_argument("run", metavar="RUN", help=f"one of {', '.join(RUNS)}")
    parser.add_argument("changes", metavar="KEY=VALUE", nargs="*", help="fields of train.config.Config")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to write (default: out/train/RUN)")
    parser.add_argument("--resume", action="store_true", help="continue from the last checkpoint, if there is one")
    add_quiet_option(parser)

    def work() -> None:
        options = parser.parse_intermixed_args(arguments)
        config = configured(options.run, options.changes)
        try:
            tune(config, options.out or Path("out/train") / options.run, resume=options.resume, quiet=options.quiet)
        except CompileError as error:
            raise CompileError(f"{error}; compile=false trains without") from None

    with distributed.team():
        return exit_status("train", work)


if __name__ == "__main__":
    sys.exit(main())

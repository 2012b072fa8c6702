"""Learns a filter's hyperparameters on tracks: by gradient descent, or by a search.

    python -m train.tune fra_bearings                          both bearings scenarios, a minute on two cores
    python -m train.tune fra_bearings --resume                 continues from the last checkpoint, bit by bit
    python -m train.tune fra_bearings iterations=50 lr=0.1     any field of train.config.Config
    python -m train.tune fra_recorded files=a.csv,b.csv        recorded tracks: needs no truth
    python -m train.tune noise scenario=own.py:make            one's own simulator: a function that makes a Scenario
    python -m train.tune gpb                                   one set of values for all models, without gradients
    torchrun --nproc-per-node 2 -m train.tune fra_bearings     two processes share each batch

Runs (train/runs.py): fra_bearings, fra_recorded, gpb, switching (interacting models), contaminated (the
Huber score), association (scans of several targets in clutter), noise, recover, recover_gpb.  Written to out/train/RUN:
config.json, log.csv, checkpoint.pt, the learned state_dict.pt (of the best validation), learning.png and results.json
with the errors on unseen tracks before and after.  To use the learned values:

    fra = torchfra.presets.fra(scenario.motion, scenario.sensor)
    fra.load_state_dict(torch.load("out/train/fra_bearings/state_dict.pt", weights_only=True))
"""

from __future__ import annotations

import copy
import dataclasses
import math
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchfra import plotting
from torchfra.catalogue import FILTERS
from torchfra.cli.command import Failures, add_quiet_option, check_files, check_folder, exit_status, make_parser
from torchfra.fitting.descent import bounded, falling
from torchfra.hyper import hypers, named
from torchfra.running import distributed
from torchfra.running.atomic_write import write_json
from torchfra.running.progress import progress_bar
from torchfra.tables import printable
from torchfra.types import CompileError
from train import checkpoints
from train.batches import Batch, simulate
from train.config import Config
from train.regret import Regrets
from train.report import not_finite, report, report_text
from train.runs import RUNS, configured
from train.training import Training

WRITTEN = (*checkpoints.FILES, "config.json", "results.json", "learning.png")


def train(training: Training, out: Path, log: Log) -> None:
    """The training loop: until the last iteration, or until validation has long not improved."""
    config = training.config
    for _ in log.bar:
        if training.stopped:
            break
        begun = time.perf_counter()
        rate, temperature = schedule(config, training.iteration / config.iterations)
        losses, columns = iteration(training, rate, temperature)
        training.iteration += 1

        row = {"iteration": training.iteration, "loss": float(training.task_weights @ losses)}
        if len(config.tasks) > 1:
            row |= {f"loss {i + 1}": value for i, value in enumerate(losses.tolist())}
        row |= columns | training.learned_values() | {"seconds": time.perf_counter() - begun}
        if training.iteration % config.validate_every == 0 or training.iteration == config.iterations:
            row["validation"] = validate(training)
            if row["validation"] < training.best["score"]:
                training.keep(row["validation"])
            unimproved = (training.iteration - training.best["iteration"]) / config.validate_every
            training.stopped = unimproved >= config.patience
        training.rows.append(row)
        log.show(row)
        if training.iteration % config.checkpoint_every == 0 and distributed.rank() == 0:
            checkpoints.save(training, out)


def iteration(training: Training, rate: float, temperature: float) -> tuple[Tensor, dict[str, float]]:
    """Changes the values once; the losses ``(tasks,)`` and further columns of the log."""
    # New tracks in each iteration.  Their numbers follow from the iteration, so a resumed run sees the same ones.
    if isinstance(training, Regrets):
        return training.generation()
    c, first = training.config, training.iteration * training.config.batch
    batch = simulate(training.scenarios, first=first, runs=c.batch, seed=c.seed, device=c.device)
    losses, gradients, left_out = task_means(training, batch, *track_gradients(training, batch, temperature))
    gradient = training.task_weights @ gradients
    parameters = list(training.parameters.values())
    for parameter, part in zip(parameters, gradient.split([p.numel() for p in parameters]), strict=True):
        parameter.grad = part.reshape(parameter.shape).clone()
    training.optimiser.param_groups[0]["lr"] = rate
    training.optimiser.step()
    return losses, {"gradient": gradient.norm().item(), "left out": left_out, "lr": rate, "temperature": temperature}


def schedule(config: Config, progress: float) -> tuple[float, float]:
    """Learning rate and temperature after this share of all iterations."""
    temperature = config.temperature and config.temperature * (config.cold / config.temperature) ** progress
    return falling(config.lr, progress), temperature


def track_gradients(training: Training, batch: Batch, temperature: float) -> tuple[Tensor, Tensor]:
    """The loss of each track, ``(B,)``, and its gradient with respect to the parameters, ``(B, P)``."""
    # Every track gets its own copy of the hyperparameters, all with the same values.  The gradient of the sum of all
    # losses with respect to one copy is then the gradient of that track alone.  So one backward pass gives the
    # gradients of all tracks, which can be clipped one by one, and NaN from a track that diverged stays with it.
    count = len(batch.task)
    copies = {name: _copies(training, name, count) for name in training.parameters}
    losses = training.losses(copies, batch, temperature)
    gradients = torch.autograd.grad(losses.sum(), list(copies.values()), allow_unused=True, materialize_grads=True)
    return losses.detach(), torch.cat([gradient.reshape(count, -1) for gradient in gradients], 1)


def _copies(training: Training, name: str, count: int) -> Tensor:
    """A parameter for each track; in scans for each scene, whose targets share it unless they have one each."""
    value = training.parameters[name].detach()
    shared = (
        FILTERS[training.config.filter].scans and hypers(training.filter)[name.removesuffix(".raw")].batch_rank == 0
    )
    batch = (count, 1) if shared else (count,)
    return value.expand(*batch, *value.shape).clone().requires_grad_()


def task_means(training: Training, batch: Batch, losses: Tensor, gradients: Tensor) -> tuple[Tensor, Tensor, int]:
    """The mean loss ``(tasks,)`` and mean clipped gradient ``(tasks, P)`` of each task, over all processes.

    Tracks whose loss or gradient is NaN or infinite do not count; their number is the third that is returned.
    """
    clipped, finite = bounded(losses, gradients, training.config.clip)
    table = torch.cat([clipped, torch.stack([torch.where(finite, losses, 0.0), finite.to(losses)], 1)], 1)
    count = len(training.scenarios)
    sums = distributed.summed(table.new_zeros(count, table.shape[1]).index_add(0, batch.task, table))
    means = sums[:, :-1] / sums[:, -1:].clamp_min(1)
    return means[:, -1], means[:, :-1], int(count * training.config.batch - sums[:, -1].sum())


@torch.no_grad()
def validate(training: Training) -> float:
    """The weighted loss on tracks that are never trained on, with hard decisions; infinite if it is NaN for one."""
    c = training.config
    if isinstance(training, Regrets):
        return training.validation()
    batch = simulate(training.held_out, first=0, runs=c.validation_runs, seed=c.validation_seed, device=c.device)
    # A teacher that decides softly is compared with a filter that does so too.
    losses = training.losses({}, batch, c.temperature if c.loss == "teacher" else 0.0).nan_to_num(nan=math.inf)
    sums = losses.new_zeros(len(training.held_out)).index_add(0, batch.task, losses)
    return float(training.task_weights @ distributed.summed(sums) / c.validation_runs)


def search(training: Training) -> None:
    """Coordinate search over values that no gradient reaches: each in turn takes the one of the best validation."""
    f = training.filter
    f.load_state_dict(training.best["filter"])
    for name, values in training.config.search.items():
        for hyper in named(f, (name,)).values():
            for value in values:
                hyper.set(value, name)
                score = validate(training)
                if score < training.best["score"]:
                    training.best |= {"score": score, "filter": copy.deepcopy(f.state_dict())}
            f.load_state_dict(training.best["filter"])


class Log:
    """Shows each iteration.

    Args:
        config: of the run.
        out: folder of the TensorBoard log, if ``config.tensorboard``.
        begin: the first iteration.
        quiet: whether to print nothing.

    Raises:
        ImportError: TensorBoard is asked for and not installed.
    """

    def __init__(self, config: Config, out: Path, *, begin: int, quiet: bool) -> None:
        self.name, self.quiet = printable(config.name), quiet
        self.board = _tensorboard(out) if config.tensorboard and distributed.rank() == 0 else None
        self.bar = progress_bar(range(begin, config.iterations), self.name, not quiet)
        """The numbers of the iterations, behind a progress bar on a terminal."""

    def show(self, row: Mapping[str, float]) -> None:
        """One iteration: in the bar, or without one a line for each validation."""
        iteration, loss = row["iteration"], row["loss"]
        if hasattr(self.bar, "set_postfix"):
            self.bar.set_postfix(loss=f"{loss:.4f}", left_out=row["left out"])
        elif not self.quiet and "validation" in row:
            print(f"{self.name} {iteration}: loss {loss:.4f}, validation {row['validation']:.4f}", flush=True)
        if self.board is not None:
            for key, value in row.items():
                self.board.add_scalar(key, value, iteration)


def _tensorboard(out: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ImportError("tensorboard=true needs TensorBoard: pip install 'torchfra[tensorboard]'") from None
    return SummaryWriter(out)


def tune(config: Config, out: Path, *, resume: bool = False, quiet: bool = False) -> dict[str, Any]:
    """A run from its start, or from its last checkpoint, to its report: what results.json holds.

    Raises:
        ValueError: ``out`` holds a run and ``resume`` is not asked for; or see ``Training``.
        OSError: a file cannot be written, which is found before the first iteration where it can be.
        IncompleteError: the run is at its end, but a file is missing or a result is not finite.
    """
    first = distributed.rank() == 0
    quiet = quiet or not first
    if not resume and checkpoints.found(out):
        raise ValueError(f"out: {out} holds a run already: --resume continues it, --out DIR writes elsewhere")
    check_folder("out", out)
    check_files({f"out, {name}": out / name for name in WRITTEN})
    training = Regrets(config, quiet=quiet) if config.loss == "regret" else Training(config)
    start = training.learned_values()
    if resume and checkpoints.load(training, out) and not quiet:
        print(f"resumed after iteration {training.iteration}")
    log = Log(config, out, begin=training.iteration, quiet=quiet)
    if first:
        write_json(out / "config.json", dataclasses.asdict(config))
    train(training, out, log)
    search(training)
    if first:
        checkpoints.save(training, out)
    result = report(training, start, quiet=quiet)
    if not quiet:
        print(f"{report_text(result)}\nwritten to {printable(str(out))}", flush=True)
    if first:
        _write(training, start, result, out)
    return result


def _write(training: Training, start: dict[str, float], result: dict[str, Any], out: Path) -> None:
    """The results and the figure.

    Raises:
        IncompleteError: one of them cannot be written, or there is nothing finite to report.
    """
    config, failures = training.config, Failures()
    with failures.of("results.json"):
        write_json(out / "results.json", result)
    with failures.of("learning.png"):
        figure = plotting.learning_curve(training.rows, start, f"{config.name}, seed {config.seed}")
        plotting.save(figure, out / "learning.png")
    if not math.isfinite(training.best["score"]):
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

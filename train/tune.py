"""Learns a filter's hyperparameters by gradient descent on tracks.

    python -m train.tune fra_bearings                          both bearings scenarios, a minute on two cores
    python -m train.tune fra_bearings --resume                 goes on after the last checkpoint, to the same bits
    python -m train.tune fra_bearings iterations=50 lr=0.1     any field of train.runs.Config
    python -m train.tune fra_recorded files=a.csv,b.csv        recorded tracks: needs no truth
    torchrun --nproc-per-node 2 -m train.tune fra_bearings     two processes share each batch

Runs (train/runs.py): fra_bearings, fra_recorded, switching (interacting models), contaminated (the Huber score),
association (scans of several targets in clutter), noise, recover.  Written to out/train/RUN: config.json, log.csv,
checkpoint.pt, the learned state_dict.pt (of the best validation), learning.png and results.json with what unseen tracks
say before and after.  To use what was learned:

    fra = torchfra.presets.fra(scenario.motion, scenario.sensor)
    fra.load_state_dict(torch.load("out/train/fra_bearings/state_dict.pt", weights_only=True))
"""

from __future__ import annotations

import argparse
import copy
import csv
import dataclasses
import inspect
import io
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchfra import keep_memory, losses, presets, readers, scenarios
from torchfra.app import distributed, plotting
from torchfra.app.atomic_write import write, write_json, write_text
from torchfra.app.evaluate import evaluate, progress_bar, versions
from torchfra.catalogue import make_scenario
from torchfra.filters import Filter
from torchfra.filters.imm import Around
from torchfra.filters.jpda import JPDA
from torchfra.filters.soft import Soft
from torchfra.hyper import hypers, named
from torchfra.kernel.build import CompileError
from torchfra.scenarios import Scenario
from torchfra.types import Estimate, Gaussian
from train.runs import RUNS, Config, Task, configured

Loss = Callable[[Estimate, Tensor, slice], Tensor]


# ---------------------------------------------------------------- what is tracked


def scenario_of(task: Task, config: Config, part: str) -> Scenario:
    """The scenario of a task; of recorded tracks every fifth is kept for ``part`` other than ``"train"``."""
    if task.scenario != "recorded":
        return make_scenario(task.scenario, **task.options)
    files = config.files or readers.samples("calibration", "gliders")
    recordings = [recording for file in files for recording in readers.read(Path(file))]
    kept = [r for i, r in enumerate(recordings) if (i % 5 == 4) == (part != "train")]
    return scenarios.recorded(kept, **task.options)


class Batch(NamedTuple):
    """Tracks of all tasks as one batch: shorter ones end in missing data."""

    z: Tensor
    truth: Tensor
    u: Tensor | None
    prior: Gaussian
    dt: Tensor
    task: Tensor
    """``(B,)`` the number of each track's task; of several targets, each scene's."""


def simulate(parts: list[Scenario], first: int, runs: int, seed: int, device: str) -> Batch:
    """This process's share of ``runs`` tracks of each scenario, from run ``first`` of the seed on."""
    own = distributed.share(runs)
    steps = max(s.steps for s in parts)
    several = [s.simulate(len(own), seed, first=first + own.start) for s in parts]

    def late(x: Tensor, fill: float, time: int = -2) -> Tensor:
        x = x if x.dim() > 2 else x.expand(len(own), *x.shape)
        more = [*x.shape]
        more[time] = steps - x.shape[time]
        return torch.cat([x, torch.full(more, fill, dtype=x.dtype)], time)

    us = [late(t.u, 0.0) for t in several if t.u is not None]
    roots = [t.prior.scale_tril.expand(*t.prior.mean.shape, t.prior.mean.shape[-1]) for t in several]
    return Batch(
        z=torch.cat([late(t.z, math.nan, 1) for t in several]).to(device),
        truth=torch.cat([late(t.truth, math.nan) for t in several]).to(device),
        u=torch.cat(us).to(device) if us else None,
        prior=Gaussian(torch.cat([t.prior.mean for t in several]).to(device), torch.cat(roots).to(device)),
        dt=torch.cat([torch.full((len(own), 1), s.dt, dtype=torch.float64) for s in parts]).to(device),
        task=torch.arange(len(parts)).repeat_interleave(len(own)).to(device),
    )


# ---------------------------------------------------------------- what is learned


def make(config: Config, scenario: Scenario, values: dict[str, float], learn: bool) -> Filter:
    """The filter of a run with these values in natural units."""
    preset = getattr(presets, config.filter, None)
    if preset is None:
        raise ValueError(f"filter: expected a preset, received {config.filter!r}")
    banked = "models" in inspect.signature(preset).parameters
    if banked and scenario.bank is None:
        raise ValueError(f"filter: expected one of a single motion, {scenario.name} has no bank for {config.filter}")
    models = copy.deepcopy((scenario.bank if banked else scenario.motion, scenario.sensor))
    scans = {} if scenario.clutter is None else {"clutter": scenario.clutter, "detection": scenario.detection}
    if (scenario.clutter is None) == ("clutter" in inspect.signature(preset).parameters):
        raise ValueError(f"filter: {config.filter} does not go with the measurements of {scenario.name}")
    names = ("all" if config.learn == ("all",) else config.learn) if learn else ()
    f: Filter = preset(*models, learn=names, **scans | config.options)
    for name, value in values.items():
        for hyper in named(f, (name,)).values():
            hyper.set(value)
    f = f.to(config.device)
    return f.compile() if config.compile else f


def values_of(f: Filter) -> dict[str, float]:
    """All hyperparameters in natural units; a vector by the numbers of its elements."""
    values: dict[str, float] = {}
    for path, hyper in hypers(f).items():
        numbers = hyper().detach().flatten().tolist()
        places = [",".join(map(str, place)) for place in np.ndindex(*hyper.raw.shape)]
        values |= {f"{path}[{i}]" if i else path: v for i, v in zip(places, numbers, strict=True)}
    return values


def loss_of(config: Config) -> Loss:
    """The loss of a run: one number per track."""
    kinds: dict[str, Loss] = {
        "mse": lambda e, truth, states: losses.mse(e.mean, truth, states),
        "robust": lambda e, truth, states: losses.robust_mse(e.mean, truth, states, config.scale),
        "nll": losses.nll,
        "innovation": lambda e, truth, states: losses.innovation_nll(e),
        "teacher": lambda e, truth, states: losses.robust_mse(e.mean, truth, states, config.scale),
    }
    if config.loss not in kinds:
        raise ValueError(f"loss: expected one of {', '.join(kinds)}, received {config.loss!r}")
    return kinds[config.loss]


def decide(f: Filter, temperature: float) -> None:
    """Soft or hard, where the filter decides anything."""
    core = f.inner if isinstance(f, Around) else f
    if isinstance(core, Soft):
        core.temperature = temperature


class Lesson(NamedTuple):
    """What one batch says, over all processes."""

    loss: Tensor
    """``(tasks,)`` mean over the tracks that count."""
    gradient: Tensor
    """``(tasks, P)`` mean, each track's clipped."""
    left_out: int
    """Tracks whose loss or gradient is no number."""


class Tuner:
    """A filter, what it learns from, and how far it has come."""

    def __init__(self, config: Config) -> None:
        self.config, self.loss = config, loss_of(config)
        self.parts = [scenario_of(task, config, "train") for task in config.tasks]
        self.unseen = [scenario_of(task, config, "held") for task in config.tasks]
        if len({(type(s.motion), type(s.sensor), s.motion.size, s.sensor.size) for s in self.parts}) > 1:
            raise ValueError("tasks: expected scenarios of one kind of motion and sensor")
        if min(config.batch, config.validation_runs) < distributed.size():
            raise ValueError(f"batch, validation_runs: expected at least {distributed.size()}, one for each process")
        self.f = make(config, self.parts[0], config.start, learn=True)
        self._check_search()
        self.teacher = make(config, self.parts[0], config.teacher, learn=False) if config.loss == "teacher" else None
        self._named = list(self.f.named_parameters())
        self.names, self.parameters = zip(*self._named, strict=True)
        self.optimiser = torch.optim.Adam(self.parameters, lr=config.lr)
        self.weights = torch.tensor([task.weight for task in config.tasks], dtype=torch.float64, device=config.device)
        self.weights /= self.weights.sum()
        self.iteration, self.stopped = 0, False
        self.rows: list[dict[str, float]] = []
        self.best: dict[str, Any] = {"score": math.inf, "iteration": 0, "filter": copy.deepcopy(self.f.state_dict())}

    def losses(self, values: dict[str, Tensor], batch: Batch, temperature: float) -> Tensor:
        """``(B,)`` losses of a batch under these values, a set of them for each track."""
        call = {"u": batch.u, "dt": batch.dt, "truncate": self.config.truncate or None}
        decide(self.f, temperature)
        estimate = torch.func.functional_call(self.f, values, (batch.z, batch.prior), call)
        truth = batch.truth
        if self.teacher is not None:
            decide(self.teacher, temperature)
            with torch.no_grad():
                truth = self.teacher(batch.z, batch.prior, **call).mean
        skip = self.config.skip
        mean, root, nis, log_likelihood, _ = estimate
        late = Estimate(mean[..., skip:, :], root[..., skip:, :, :], nis[..., skip:], log_likelihood[..., skip:], None)
        counted = late if self.teacher is not None else self.parts[0].cartesian(late)
        each = self.loss(counted, truth[..., skip:, :], self.parts[0].truth_position)
        return each.flatten(1).mean(-1) if each.dim() > 1 else each  # of all targets of a scene

    def learn(self, batch: Batch, temperature: float) -> Lesson:
        """Losses and gradients of a batch.

        Every track has hyperparameters of its own, all equal: so one backward pass gives each track's own gradient, one
        that blew up poisons no other, and each can be clipped alone.
        """
        count = len(batch.task)
        own = [self._for_each(name, p.detach(), count).requires_grad_() for name, p in self._named]
        each = self.losses(dict(zip(self.names, own, strict=True)), batch, temperature)
        pulled = torch.autograd.grad(each.sum(), own, allow_unused=True)
        gradient = torch.cat(
            [torch.zeros_like(p).reshape(count, -1) if g is None else g.reshape(count, -1)
             for p, g in zip(own, pulled, strict=True)], 1
        )  # fmt: skip
        good = each.isfinite() & gradient.isfinite().all(1)
        norm = torch.linalg.vector_norm(gradient, dim=1, keepdim=True)
        gradient = gradient * (self.config.clip / norm).clamp_max(1.0)
        table = torch.cat([gradient, each.detach().unsqueeze(1), torch.ones_like(norm)], 1)
        table = torch.where(good.unsqueeze(1), table, 0.0)
        sums = table.new_zeros(len(self.parts), table.shape[1]).index_add(0, batch.task, table)
        sums = distributed.summed(sums)
        mean = sums[:, :-1] / sums[:, -1:].clamp_min(1)
        return Lesson(mean[:, -1], mean[:, :-1], int(len(self.parts) * self.config.batch - sums[:, -1].sum()))

    def _for_each(self, name: str, value: Tensor, count: int) -> Tensor:
        """A copy for each track; of scans for each scene, whose targets share it unless they have one each."""
        targets = isinstance(self.f, JPDA) and hypers(self.f)[name.removesuffix(".raw")].batch_rank == 0
        shape = (count, 1) if targets else (count,)
        return value.expand(*shape, *value.shape).clone()

    def step(self) -> dict[str, float]:
        """One iteration: fresh tracks, one step of Adam; what the log says about it."""
        c, begun = self.config, time.perf_counter()
        done = self.iteration / c.iterations
        temperature = c.temperature * (c.cold / c.temperature) ** done if c.temperature else 0.0
        rate = c.lr * (0.55 + 0.45 * math.cos(math.pi * done))
        batch = simulate(self.parts, self.iteration * c.batch, c.batch, c.seed, c.device)
        lesson = self.learn(batch, temperature)
        gradient, place = self.weights @ lesson.gradient, 0
        for p in self.parameters:
            p.grad = gradient[place : place + p.numel()].reshape(p.shape).clone()
            place += p.numel()
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.step()
        self.iteration += 1
        row = {"iteration": self.iteration, "loss": float(self.weights @ lesson.loss)}
        if len(c.tasks) > 1:
            row |= {f"loss {i + 1}": value for i, value in enumerate(lesson.loss.tolist())}
        row |= {"gradient": gradient.norm().item(), "left out": lesson.left_out, "lr": rate, "temperature": temperature}
        row |= self.learned() | {"seconds": time.perf_counter() - begun}
        self.rows.append(row)
        if self.iteration % c.validate_every == 0 or self.iteration == c.iterations:
            row["validation"] = score = self.validate()
            if score < self.best["score"]:
                now = copy.deepcopy(self.f.state_dict())
                self.best = {"score": score, "iteration": self.iteration, "filter": now}
            self.stopped = self.iteration - self.best["iteration"] >= c.patience * c.validate_every
        return row

    def learned(self) -> dict[str, float]:
        """The values that learn, or are searched."""
        moving = {name.removesuffix(".raw") for name in self.names} | set(named(self.f, list(self.config.search)))
        return {path: value for path, value in values_of(self.f).items() if path.partition("[")[0] in moving}

    @torch.no_grad()
    def validate(self) -> float:
        """The weighted loss on tracks that are never trained on, decided hard; infinite if one blew up."""
        c = self.config
        batch = simulate(self.unseen, 0, c.validation_runs, c.validation_seed, c.device)
        each = self.losses({}, batch, c.temperature if c.loss == "teacher" else 0.0).nan_to_num(nan=math.inf)
        sums = each.new_zeros(len(self.parts)).index_add(0, batch.task, each)
        return float(self.weights @ distributed.summed(sums) / c.validation_runs)

    def _check_search(self) -> None:
        for name, values in self.config.search.items():
            try:
                found = copy.deepcopy(list(named(self.f, (name,)).values()))
                for hyper in found:
                    for value in values:
                        hyper.set(float(value), name)
            except (ValueError, TypeError) as error:
                said = f"values that {self.config.filter} takes, received {name}: {values}"
                raise ValueError(f"search: expected {said} ({error})") from None

    def search(self) -> None:
        """Of what no gradient reaches the best of the values to try, beside the best that gradients found."""
        self.f.load_state_dict(self.best["filter"])
        for name, values in self.config.search.items():
            for hyper in named(self.f, (name,)).values():
                for value in values:
                    hyper.set(value, name)
                    score = self.validate()
                    if score < self.best["score"]:
                        self.best |= {"score": score, "filter": copy.deepcopy(self.f.state_dict())}
                self.f.load_state_dict(self.best["filter"])

    # ------------------------------------------------------------ checkpoints

    def save(self, out: Path) -> None:
        """Everything that the next iteration rests on; the checkpoint before stays as checkpoint-previous.pt."""
        state = {
            "config": dataclasses.asdict(self.config),
            "iteration": self.iteration,
            "stopped": self.stopped,
            "filter": self.f.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "best": self.best,
            "rows": self.rows,
        }
        newest = out / "checkpoint.pt"
        if newest.exists():
            newest.replace(out / "checkpoint-previous.pt")
        write(newest, lambda file: torch.save(state, file))
        write(out / "state_dict.pt", lambda file: torch.save(self.best["filter"], file))
        text = io.StringIO()
        columns = dict.fromkeys(key for row in self.rows for key in row)
        table = csv.DictWriter(text, columns, lineterminator="\n")
        table.writeheader()
        table.writerows(self.rows)
        write_text(out / "log.csv", text.getvalue())

    def load(self, out: Path) -> bool:
        """Goes on from the newest checkpoint that can be read; False if there is none at all.

        Raises:
            ValueError: none can be read, or it belongs to other settings.
        """
        found = [path for path in (out / "checkpoint.pt", out / "checkpoint-previous.pt") if path.exists()]
        for path in found:
            try:
                state = torch.load(path, map_location=self.config.device, weights_only=True)
            except Exception as error:  # torch raises whatever its reader came upon
                said = str(error).splitlines()[0] if str(error) else type(error).__name__
                if distributed.rank() == 0:
                    print(f"train: {path} is damaged and is not used: {said}", file=sys.stderr)
                continue
            now = dataclasses.asdict(self.config)
            other = [key for key in now if state["config"].get(key) != now[key]]
            if other:
                raise ValueError(f"resume: expected the settings of {path}, these differ: {', '.join(other)}")
            self.iteration, self.stopped = state["iteration"], state["stopped"]
            self.best, self.rows = state["best"], state["rows"]
            self.f.load_state_dict(state["filter"])
            self.optimiser.load_state_dict(state["optimiser"])
            if path != found[0] and distributed.rank() == 0:  # out of the way, or it would push out the good one
                found[0].replace(out / "checkpoint-damaged.pt")
            return True
        if found:
            raise ValueError(f"resume: no checkpoint in {out} can be read")
        return False


# ---------------------------------------------------------------- the run


def tune(config: Config, out: Path, *, resume: bool = False, quiet: bool = False) -> dict[str, Any]:
    """A whole run; what results.json holds.

    Raises:
        ValueError: ``out`` holds a run already and ``resume`` is not asked for; or see ``Tuner``.
    """
    tuner, first = Tuner(config), distributed.rank() == 0
    quiet = quiet or not first
    if not resume and (out / "checkpoint.pt").exists():
        raise ValueError(f"out: {out} holds a run already: --resume goes on with it, --out DIR writes elsewhere")
    start = tuner.learned()
    if resume and tuner.load(out) and not quiet:
        print(f"resumed after iteration {tuner.iteration}")
    board = _board(out) if config.tensorboard and first else None
    if first:
        write_json(out / "config.json", dataclasses.asdict(config))
    bar = progress_bar(range(tuner.iteration, config.iterations), config.name, not quiet)
    for _ in bar:
        if tuner.stopped:
            break
        row = tuner.step()
        if hasattr(bar, "set_postfix"):
            bar.set_postfix(loss=f"{row['loss']:.4f}", left_out=row["left out"])
        elif not quiet and "validation" in row:
            print(
                f"{config.name} {tuner.iteration}: loss {row['loss']:.4f}, validation {row['validation']:.4f}",
                flush=True,
            )
        if board is not None:
            for key, value in row.items():
                board.add_scalar(key, value, tuner.iteration)
        if first and tuner.iteration % config.checkpoint_every == 0:
            tuner.save(out)
    tuner.search()
    if first:
        tuner.save(out)
        plotting.save(
            plotting.learning_curve(tuner.rows, start, f"{config.name}, seed {config.seed}"), out / "learning.png"
        )
    result = report(tuner, start, quiet)
    if first:
        write_json(out / "results.json", result)
    if not quiet:
        print(said(result))
        print(f"written to {out}")
    return result


def report(tuner: Tuner, start: dict[str, float], quiet: bool) -> dict[str, Any]:
    """Values before and after and, on unseen tracks with the hard decision, the position error of each task."""
    config = tuner.config
    tuner.f.load_state_dict(tuner.best["filter"])
    decide(tuner.f, 0.0)
    filters = {"before": make(config, tuner.parts[0], config.start, learn=False), "after": tuner.f}
    tasks = []
    for task, scenario in zip(config.tasks, tuner.unseen, strict=True):
        if not config.test_runs:
            break
        for f in filters.values():
            f.to("cpu")
        results = evaluate(scenario, filters, runs=config.test_runs, seed=config.test_seed, progress=not quiet)
        figures: dict[str, Any] = {"scenario": task.scenario, **task.options}
        for name, of in results.items():
            keys = [key for key in ("rmse_position", "rmse_x", "rmse_y", "rmse_z") if key in of]
            counted = {key: np.nanmean(of[key][config.skip :]).item() for key in keys}
            figures[name] = counted | {"divergence_rate": of["divergence_rate"]}
        tasks.append(figures)
    values: dict[str, dict[str, float]] = {"start": start, "learned": tuner.learned()}
    if tuner.teacher is not None:
        values["known"] = {path: v for path, v in values_of(tuner.teacher).items() if path in start}
    return {"config": dataclasses.asdict(config), "iterations": tuner.iteration, "best": tuner.best["iteration"],
            "left_out": sum(int(row["left out"]) for row in tuner.rows),
            "seconds": sum(row["seconds"] for row in tuner.rows), "values": values, "tasks": tasks,
            "versions": versions()}  # fmt: skip


def said(result: dict[str, Any]) -> str:
    """The results as text."""
    values, lines = result["values"], []
    lines.append(f"{'':<24}" + "".join(f"{title:>12}" for title in values))
    lines += [f"{path:<24}" + "".join(f"{of[path]:>12.5g}" for of in values.values()) for path in values["start"]]
    if result["tasks"]:
        lines.append(f"{'position RMSE, m':<24}{'before':>12}{'after':>12}{'diverged':>16}")
    for task in result["tasks"]:
        before, after = task["before"], task["after"]
        lost = f"{before['divergence_rate']:.2%} -> {after['divergence_rate']:.2%}"
        lines.append(f"{task['scenario']:<24}{before['rmse_position']:>12.1f}{after['rmse_position']:>12.1f}{lost:>18}")
    lines.append(f"best after {result['best']} of {result['iterations']} iterations, {result['seconds']:.0f} s, "
                 f"{result['left_out']} tracks left out")  # fmt: skip
    return "\n".join(lines)


def _board(out: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ImportError("tensorboard=true needs TensorBoard: pip install 'torchfra[tensorboard]'") from None
    return SummaryWriter(out)


def main(arguments: list[str] | None = None) -> int:
    """Runs the command; 0 if it did its work, 2 with one line on standard error if something handed in was wrong."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m train.tune", description=__doc__, formatter_class=form)
    parser.add_argument("run", metavar="RUN", help=f"one of {', '.join(RUNS)}")
    parser.add_argument("changes", metavar="KEY=VALUE", nargs="*", help="fields of train.runs.Config")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to write (default: out/train/RUN)")
    parser.add_argument("--resume", action="store_true", help="go on after the last checkpoint, if there is one")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, and nothing printed but errors")
    options = parser.parse_intermixed_args(arguments)
    keep_memory()
    with distributed.team():
        try:
            config = configured(options.run, options.changes)
            tune(config, options.out or Path("out/train") / options.run, resume=options.resume, quiet=options.quiet)
        except (ValueError, OSError, ImportError, CompileError) as error:
            if distributed.rank() == 0:
                hint = "; compile=false trains without" if isinstance(error, CompileError) else ""
                print(f"train: error: {' '.join(str(error).split())}{hint}", file=sys.stderr)
            return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

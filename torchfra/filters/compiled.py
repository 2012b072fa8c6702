"""A filter as a kernel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchfra.filters import base
from torchfra.hyper import Hyper, hypers
from torchfra.kernel.entries import Entries
from torchfra.kernel.expressions import Expressions
from torchfra.kernel.run import Kernels
from torchfra.kernel.step import Input, Step, flatten, unflatten
from torchfra.types import Gaussian


class Kept(NamedTuple):
    """Of each step."""

    belief: Gaussian
    nis: Tensor
    log_likelihood: Tensor
    info: Any


def _advance(f: Any, state: Any, given: dict[str, Tensor]) -> tuple[Any, Kept]:
    state, record, frame = _moved(f, state, given)
    scores = base._scores(record.normalised, record.root, frame.noise.log_norm)
    return state, Kept(record.belief, *scores, record.info)


def _moved(f: Any, state: Any, given: dict[str, Tensor]) -> Any:
    timed = {k: given[k].unsqueeze(0) for k in ("u", "std", "noise") if k in given}
    optional = {"u": None, "std": None, "noise": None} | timed
    (frame,), _, _ = f._prepare(given["z"].unsqueeze(0), state.belief, given["dt"], **optional)
    return (*f.advance(state, frame), frame)


def _begin(f: Any) -> Any:
    n, dtype, book = f.motion.size, torch.float64, Expressions()
    root = Entries.inputs(book, (n, n), dtype).ids.tril()
    return f.begin(Gaussian(Entries.inputs(book, (n,), dtype), Entries(book, root, dtype)))


class Compiled:
    """Kernels of a filter, one set for each form of call."""

    def __init__(self, f: Any, checkpoint: int | None) -> None:
        self.checkpoint = checkpoint
        self.kernels: dict[Any, Kernels] = {}
        own = hypers(f)
        self.values = {f"{path}.raw": hyper.event for path, hyper in own.items()}
        self.values |= {name: x.dim() for name, x in f.named_parameters() if name not in self.values}

    def forward(self, f: Any, z: Tensor, prior: Gaussian, dt: Any, u: Any, std: Any, noise: Any, truncate: Any) -> Any:
        """Whole tracks."""
        batch = base.check(f.motion, f.sensor, z, prior, dt, u, std, noise)
        rank = max(len(batch), base.batch_rank(f))
        batch = torch.Size((1,) * (rank - len(batch))) + batch
        steps = z.shape[-2]
        dt = torch.as_tensor(dt, dtype=z.dtype)
        dt_timed = dt.dim() > 0 and dt.shape[-1] > 1
        if dt.dim() and not dt_timed:
            dt = dt[..., 0]
        given: dict[str, tuple[Tensor, int, bool]] = {"z": (z, 1, True), "dt": (dt, 0, dt_timed)}
        given |= {name: (x, e, True) for name, x, e in (("u", u, 1), ("std", std, 1), ("noise", noise, 2)) if x is not None}
        tensors = dict(f.named_parameters()) | {k: v for k, v in f.named_buffers() if k in self.values}
        values = {name: (tensors[name], e, False) for name, e in self.values.items()}
        everything = given | values
        spec = tuple((name, x.shape[x.dim() - e :], timed) for name, (x, e, timed) in everything.items())
        batch = torch.broadcast_shapes(batch, *(x.shape[: x.dim() - e] for x, e, _ in values.values()))
        key = (z.dtype, spec)
        if key not in self.kernels:
            inputs = {name: Input(torch.Size(shape[1:] if False else shape), timed, name in values) for name, shape, timed in spec}
            self.kernels[key] = Kernels(Step(f, _begin, _advance, inputs, z.dtype), self.checkpoint)
        kernels = self.kernels[key]
        tracks = batch.numel()
        def flat(x, e, timed):
            x = x.to(z)
            lead = (steps,) if timed else ()
            event = x.shape[x.dim() - e:]
            return x.expand(batch + lead + event).reshape((tracks, *lead, event.numel()))
        mean, root = (x.to(z) for x in prior)
        n = mean.shape[-1:]
        state = f.init(Gaussian(mean.expand(batch + n), root.expand(batch + n + n)))
        leaves, form = flatten(state)
        leaves = [x.expand(batch + z0.shape).reshape(tracks, -1) for x, z0 in zip(leaves, kernels.step.zero)]
        after, kept = kernels.run(tracks, steps, leaves, [flat(*x) for x in everything.values()], truncate)
        step = kernels.step
        state = unflatten([x.reshape(batch + z0.shape) for x, z0 in zip(after, step.zero)], form)
        kept = unflatten([x.reshape(batch + (steps,) + k.shape) for x, k in zip(kept, step.kept)], step.kept_form)
        belief, info = f.finish(state, kept.belief, kept.info)
        return base.Estimate(*belief, kept.nis, kept.log_likelihood, info)

"""A filter as C++ that needs neither torch nor Python: for programs that filter one measurement at a time."""

from __future__ import annotations

import copy
import re
from collections.abc import Collection
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.compiler import traced
from torchfra.compiler.copies import frozen
from torchfra.compiler.entries import Entries, as_entries
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.names import KEYWORDS, give
from torchfra.compiler.refusals import refusals_of
from torchfra.compiler.source import SCALARS, Port, Scan
from torchfra.compiler.standalone import Field, Standalone
from torchfra.compiler.step import Input, Step
from torchfra.hyper import hypers, one_of
from torchfra.linalg.tracing import elementary
from torchfra.linalg.triangular import tria
from torchfra.numbers import is_integer
from torchfra.tree import flatten, paths
from torchfra.types import Gaussian
from torchfra.version import __version__


class Output(NamedTuple):
    """What the C++ returns of a step: the belief after it, and the innovation."""

    mean: Tensor
    scale_tril: Tensor
    residual: Tensor
    innovation_scale_tril: Tensor
    nis: Tensor
    log_likelihood: Tensor


def export(
    f: Any, name: str = "filter", *, u: int = 0, inputs: Collection[str] = (), dtype: torch.dtype = torch.float64
) -> dict[str, str]:
    """One step of a filter as C++17: the texts of header, source, example program and ``CMakeLists.txt``, by file.

    The values of all hyperparameters are constants in it.  Numbers are those of ``Filter.step``, to rounding.

    Args:
        f: a filter of single tracks.
        name: of the C++ namespace, and of header and source.
        u: how many numbers the models need to know at a step; 0 for none.
        inputs: what else comes with each measurement: ``"std"`` or ``"noise"``.
        dtype: of all numbers.

    Raises:
        ValueError: an argument that does not fit, or values for a batch of filters.
        NotImplementedError: the step uses an operation that kernels do not have.
        CompileError: the step is too large.
    """
    inputs = (inputs,) if isinstance(inputs, str) else inputs
    _check(f, name, u, inputs, dtype)
    f = copy.deepcopy(f).requires_grad_(False)
    m: int = f.sensor.size
    shapes = {"z": (m,), "dt": (), "u": (u,) if u else None, "std": (m,), "noise": (m, m)}
    chosen = {"z", "dt", "u", *inputs}
    inputs = {key: Input(torch.Size(x), False, False) for key, x in shapes.items() if key in chosen and x is not None}
    step = Step(f, traced.begin, _advance, inputs, dtype, repeated=False)
    begin, prior = _begin(f, dtype)
    return Standalone(
        name, _about(f), begin, step.forwards(), prior, _fields(step.state),
        [Field(key, x.shape, _MEANINGS[key]) for key, x in inputs.items()], _fields(step.record), f.zero_dt,
    ).files()  # fmt: skip


_MEANINGS = {
    "z": "measured", "dt": "seconds since the step before", "u": "what the models need to know",
    "std": "of this measurement's noise, instead of the sensor's", "noise": "root of the covariance of that noise",
    "mean": "of the belief", "scale_tril": "lower root of its covariance",
    "residual": "measured minus predicted, 0 where missing", "innovation_scale_tril": "lower root of its covariance",
    "nis": "normalised innovation squared", "log_likelihood": "log density of the measurement",
}  # fmt: skip
"""What inputs and outputs mean."""


_TAKEN = KEYWORDS | {"advance", "begin", "block", "example", "main", "read", "std", "write"}
"""Keywords, and names in the files themselves."""


def _check(f: Any, name: str, u: int, inputs: Collection[str], dtype: torch.dtype) -> None:
    if getattr(f, "scans", True):
        raise ValueError(f"filter: expected one of single tracks, received {type(f).__name__}")
    if not isinstance(name, str) or not re.fullmatch(r"[a-z_][a-z0-9_]*", name):
        raise ValueError(f"name: expected small letters, digits and _ as in names of C++, received {name!r}")
    if name in _TAKEN:
        raise ValueError(f"name: expected one that C++ or the example program do not use, received {name!r}")
    if not is_integer(u, 0):
        raise ValueError(f"u: expected a whole number of 0 or more, received {u!r}")
    for key in inputs:
        one_of(inputs=(key, ("std", "noise")))
    if {"std", "noise"} <= {*inputs}:
        raise ValueError("inputs: expected at most one of std and noise, received both")
    if dtype not in SCALARS:
        raise ValueError(f"dtype: expected float32 or float64, received {dtype}")
    batched = [path for path, hyper in hypers(f).items() if hyper.batch_rank]
    if batched:
        raise ValueError(f"filter: expected one value of each hyperparameter, received a batch of {batched[0]}")


def _advance(f: Any, state: Any, data: dict[str, Tensor]) -> tuple[Any, Output]:
    state, innovation = traced.Observe()(f, state, data)
    return state, Output(*state.belief, *innovation)


def _begin(f: Any, dtype: torch.dtype) -> tuple[Scan, list[Field]]:
    """``init`` of one track, and what it reads."""
    n, book = f.motion.size, Expressions()
    prior = Gaussian(Entries.inputs(book, (n,), dtype), Entries.inputs(book, (n, n), dtype))
    module: Any = frozen(f)
    with refusals_of(type(f).__name__), elementary(), torch.no_grad():
        state = module.begin(Gaussian(prior.mean, tria(prior.scale_tril)))
    for part in (prior, state):
        for path, x in paths(part):
            give(book, path, _port(as_entries(book, x)).ids, x.dim() == 0)
    reads, writes = ([_port(as_entries(book, x)) for x in flatten(part)] for part in (prior, state))
    return Scan(book, [], [], reads, writes, dtype=dtype), [
        Field(key, x.shape, _MEANINGS[key]) for key, x in prior._asdict().items()
    ]


def _port(x: Entries) -> Port:
    return Port(x.ids.flatten().tolist(), x.shape)


def _fields(tree: Any) -> list[Field]:
    """The tensors of a tree as they stand in a struct."""
    return [Field(path.replace(".", "_"), x.shape, _MEANINGS.get(path, path)) for path, x in paths(tree)]


def _about(f: Any) -> list[str]:
    """What the filter is, and how to build it."""
    built = "one track, one measurement at a time.  It needs g++ or clang++ (C++17) and no library."
    return [f"{type(f).__name__}, written by torchfra {__version__}: {built}", "", *str(f).splitlines()]

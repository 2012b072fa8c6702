"""A filter as C++ that needs neither torch nor Python: for programs that filter one measurement at a time."""

from __future__ import annotations

import copy
import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfra.compiler import traced
from torchfra.compiler.cpp import KEYWORDS, file
from torchfra.compiler.entries import Entries, as_entries
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.origin import refusals_of
from torchfra.compiler.source import SCALARS, Scan
from torchfra.compiler.step import Input, Step, frozen, give_all, ports
from torchfra.hyper import hypers, one_of
from torchfra.linalg.tracing import elementary
from torchfra.linalg.triangular import tria
from torchfra.numbers import is_integer
from torchfra.steps.loop import observe
from torchfra.steps.recursion import HasBelief, Recursion
from torchfra.tree import flatten, paths
from torchfra.types import Gaussian
from torchfra.version import __version__

_LARGE = 30_000
"""Lines of a source from which a compiler had better optimise less: in half the time."""


class Field(NamedTuple):
    """A tensor in a C++ struct."""

    name: str
    shape: torch.Size
    meaning: str

    @property
    def declared(self) -> str:
        """Its line in the struct; ``dt`` is a second unless it is set."""
        count, shape = self.shape.numel(), ", ".join(map(str, self.shape))
        extent = f"[{count}]" if self.shape else " = 1" if self.name == "dt" else ""
        return f"  Scalar {self.name}{extent};  // {self.meaning}{f', ({shape})' if shape else ''}\n"

    @property
    def present(self) -> bool:
        """Whether it has any numbers: C++ has no empty arrays."""
        return self.shape.numel() > 0

    def port(self, owner: str = "") -> str:
        """The tensor of one track as the functions of kernels take it."""
        if not self.present:
            return "Port{nullptr, 0, 0, 1}"
        return f"Port{{(char*){'' if self.shape else '&'}{owner}{self.name}, 0, 0, 1}}"


class Output(NamedTuple):
    """What the C++ returns of a step: the belief after it, and the innovation."""

    mean: Tensor
    scale_tril: Tensor
    residual: Tensor
    innovation_scale_tril: Tensor
    nis: Tensor
    log_likelihood: Tensor


def export(
    f: Recursion, name: str = "filter", *, u: int = 0, inputs: Collection[str] = (), dtype: torch.dtype = torch.float64
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
    structs = {
        "State": _fields(step.state),
        "Input": [Field(key, x.shape, _MEANINGS[key]) for key, x in inputs.items()],
        "Output": _fields(step.record),
    }
    begin, prior = _begin(f, dtype)
    words = {
        "INSTANT": "0 or more" if f.limits.zero_dt else "above 0", "MEAN": str(prior[0].shape.numel()),
        "ROOT": str(prior[1].shape.numel()), "NAME": name, "SCALAR": SCALARS[dtype],
    }  # fmt: skip
    source = f'#include "{name}.hpp"\n\n' + _source(begin, step.forwards(), prior, structs, words)
    level = "-O1" if source.count("\n") > _LARGE else "-O2"
    return {
        f"{name}.hpp": _about(f) + _replaced(_header(structs), words),
        f"{name}.cpp": source,
        "example.cpp": _replaced(_example(structs["Input"]), words),
        "CMakeLists.txt": _replaced(_CMAKE, {"NAME": name, "LEVEL": level}),
    }


def _replaced(text: str, words: Mapping[str, str]) -> str:
    for word, value in words.items():
        text = text.replace(word, value)
    return text


def _header(structs: Mapping[str, Sequence[Field]]) -> str:
    """Structs of state, input and output, ``init`` and ``step``."""
    lines = {f"  // {name.upper()}\n": "".join(x.declared for x in fields if x.present)
             for name, fields in structs.items()}  # fmt: skip
    return _replaced(_HEADER, lines)


def _source(
    begin: Scan, advance: Scan, prior: Sequence[Field], structs: Mapping[str, Sequence[Field]], words: Mapping[str, str]
) -> str:
    """The functions of the header."""
    (head, first), (_, step) = begin.parts("begin"), advance.parts("advance")
    state = [x.port("state.") for x in structs["State"]]
    arguments = {
        "PRIOR": [x.port() for x in prior],
        "BEGUN": state,
        "READ": state + [x.port("input.") for x in structs["Input"]],
        "WRITTEN": state + [x.port("output.") for x in structs["Output"]],
    }
    lists = {word: ", ".join(x) for word, x in arguments.items()}
    return head + first + step + _replaced(_FUNCTIONS, {**lists, **words})


def _example(inputs: Sequence[Field]) -> str:
    """A program that filters the tracks of a text."""
    reads = "".join(
        f"      for (Scalar& x : input.{x.name}) read(x);\n" if x.shape else f"      read(input.{x.name});\n"
        for x in inputs
        if x.present
    )
    listed = ", ".join(f"{x.name} ({x.shape.numel()})" if x.shape else x.name for x in inputs)
    return _replaced(file("example.cpp"), {"      // INPUTS\n": reads, "LISTED": listed})


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


def _check(f: Recursion, name: str, u: int, inputs: Collection[str], dtype: torch.dtype) -> None:
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


def _advance(f: Recursion, state: HasBelief, data: dict[str, Tensor]) -> tuple[Any, Output]:
    state, innovation = traced.Advance(observe)(f, state, data)
    return state, Output(*state.belief, *innovation[:4])


def _begin(f: Recursion, dtype: torch.dtype) -> tuple[Scan, list[Field]]:
    """``init`` of one track, and what it reads."""
    n, book = f.motion.size, Expressions()
    prior = Gaussian(Entries.inputs(book, (n,), dtype), Entries.inputs(book, (n, n), dtype))
    module = frozen(f)
    with refusals_of(type(f).__name__), elementary(), torch.no_grad():
        state = module.begin(Gaussian(prior.mean, tria(prior.scale_tril)))
    leaves = [[as_entries(book, x) for x in flatten(part)] for part in (prior, state)]
    for part, tensors in zip((prior, state), leaves, strict=True):
        give_all(book, [path for path, _ in paths(part)], tensors)
    reads, writes = map(ports, leaves)
    return Scan(book, [], [], reads, writes, dtype=dtype), _fields(prior)


def _fields(tree: object) -> list[Field]:
    """The tensors of a tree as they stand in a struct."""
    return [Field(path.replace(".", "_"), x.shape, _MEANINGS.get(path, path)) for path, x in paths(tree)]


def _about(f: Recursion) -> str:
    """What the filter is, and how to build it, as a comment."""
    built = "one track, one measurement at a time.  It needs g++ or clang++ (C++17) and no library."
    lines = [f"{type(f).__name__}, written by torchfra {__version__}: {built}", "", *str(f).splitlines()]
    return "".join(f"// {line}".rstrip() + "\n" for line in lines)


_HEADER = """\
#pragma once

namespace NAME {

using Scalar = SCALAR;

// What the filter knows of a track; matrices row by row.
struct State {
  // STATE
};

// What is measured at a step, NaN where it is missing, and its noise and inputs.
struct Input {
  // INPUT
};

// What a step says.
struct Output {
  // OUTPUT
};

// The state before the first measurement: of a belief one dt before it, its mean and any root of its covariance.
State init(const Scalar (&mean)[MEAN], const Scalar (&scale_tril)[ROOT]);

// One measurement: the state becomes the next.  Any number of tracks, in any number of threads, each has a state.
// Nothing is checked: dt is to be finite and INSTANT, deviations finite and above 0.
// NaN must stay NaN: no -ffast-math.
Output step(State& state, const Input& input);

}  // namespace NAME
"""

_FUNCTIONS = """
#ifdef __FAST_MATH__
#error "a missing measurement is NaN, which -ffast-math does not know: build without it"
#endif

namespace NAME {

State init(const Scalar (&mean)[MEAN], const Scalar (&scale_tril)[ROOT]) {
  State state;
  const Port in[] = {PRIOR}, out[] = {BEGUN};
  ::begin::block(in, out, 1, 0);
  return state;
}

Output step(State& state, const Input& input) {
  Output output;
  const Port in[] = {READ}, out[] = {WRITTEN};
  ::advance::block(in, out, 1, 0);
  return output;
}

}  // namespace NAME
"""

_CMAKE = """\
cmake_minimum_required(VERSION 3.10)
project(NAME CXX)

option(NATIVE "use all instructions of this machine's processor" ON)
if(NOT CMAKE_BUILD_TYPE)
  set(CMAKE_BUILD_TYPE Release)
endif()
set(CMAKE_CXX_STANDARD 17)
set(CMAKE_CXX_FLAGS_RELEASE "LEVEL")

add_library(NAME STATIC NAME.cpp)
target_include_directories(NAME PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
target_compile_options(NAME PRIVATE -fno-math-errno -fno-trapping-math)
if(NATIVE)
  target_compile_options(NAME PRIVATE -march=native)
endif()

add_executable(example example.cpp)
target_link_libraries(example NAME)
"""

"""A filter's step as C++ that needs no library: source, header, ``CMakeLists.txt`` and an example program."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from torchfra.compiler.source import SCALARS, Scan

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


class Standalone(NamedTuple):
    """All that is needed to write a filter as C++.

    Args:
        name: of the namespace and the files.
        about: what the filter is, in lines.
        begin: reads the prior's mean and root, writes the state.
        advance: carries the state, reads the inputs, writes the outputs.
        prior: the fields of what ``begin`` reads.
        state: those of a state.
        inputs: those of what a step reads.
        outputs: those of what it writes.
        zero_dt: whether a step may take no time.
    """

    name: str
    about: Sequence[str]
    begin: Scan
    advance: Scan
    prior: Sequence[Field]
    state: Sequence[Field]
    inputs: Sequence[Field]
    outputs: Sequence[Field]
    zero_dt: bool

    def files(self) -> dict[str, str]:
        """The text of each file by its name."""
        source = self.source()
        level = "-O1" if source.count("\n") > _LARGE else "-O2"
        return {
            f"{self.name}.hpp": self.header(),
            f"{self.name}.cpp": source,
            "example.cpp": self.example(),
            "CMakeLists.txt": _CMAKE.replace("NAME", self.name).replace("LEVEL", level),
        }

    def header(self) -> str:
        """Structs of state, input and output, ``init`` and ``step``."""
        structs = {"State": self.state, "Input": self.inputs, "Output": self.outputs}
        text = self._named(_HEADER)
        for name, fields in structs.items():
            text = text.replace(f"  // {name.upper()}\n", "".join(x.declared for x in fields if x.present))
        return "".join(f"// {line}".rstrip() + "\n" for line in self.about) + text

    def source(self) -> str:
        """The functions of the header."""
        (head, begin), (_, advance) = self.begin.parts("begin"), self.advance.parts("advance")
        parts = {
            "PRIOR": [_port(x, "") for x in self.prior],
            "BEGUN": [_port(x, "state.") for x in self.state],
            "READ": [_port(x, "state.") for x in self.state] + [_port(x, "input.") for x in self.inputs],
            "WRITTEN": [_port(x, "state.") for x in self.state] + [_port(x, "output.") for x in self.outputs],
        }
        text = self._named(_FUNCTIONS)
        for word, ports in parts.items():
            text = text.replace(word, ", ".join(ports))
        return f'#include "{self.name}.hpp"\n\n{head}{begin}{advance}{text}'

    def _named(self, text: str) -> str:
        mean, root = (str(x.shape.numel()) for x in self.prior)
        words = {"INSTANT": "0 or more" if self.zero_dt else "above 0", "MEAN": mean, "ROOT": root, "NAME": self.name,
                 "SCALAR": SCALARS[self.advance.dtype]}  # fmt: skip
        for word, value in words.items():
            text = text.replace(word, value)
        return text

    def example(self) -> str:
        """A program that filters the tracks of a text."""
        reads = "".join(
            f"      for (Scalar& x : input.{x.name}) read(x);\n" if x.shape else f"      read(input.{x.name});\n"
            for x in self.inputs
            if x.present
        )
        text = Path(__file__).with_name("example.cpp").read_text().replace("      // INPUTS\n", reads)
        listed = ", ".join(f"{x.name} ({x.shape.numel()})" if x.shape else x.name for x in self.inputs)
        return text.replace("LISTED", listed).replace("NAME", self.name)


def _port(field: Field, owner: str) -> str:
    """A tensor of one track as the functions of kernels take it."""
    if not field.present:
        return "Port{nullptr, 0, 0, 1}"
    return f"Port{{(char*){'' if field.shape else '&'}{owner}{field.name}, 0, 0, 1}}"


_HEADER = """\
#pragma once

namespace NAME {

using Scalar = SCALAR;

// What the filter knows of a track; matrices row by row.
struct State {
  // STATE
};

// What is measured at a step, NaN where it is missing, and what goes with it.
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

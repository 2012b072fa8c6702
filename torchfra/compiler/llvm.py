"""LLVM inside of this process, if it is installed, and what the processor of this machine can do."""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from functools import lru_cache
from typing import Any

import torch

from torchfra.compiler.instructions import Lanes
from torchfra.types import CompileError

INSTALL = "pip install 'torchfra[compiler]'"
"""What gives a machine a compiler."""


@lru_cache(maxsize=1)
def is_installed() -> bool:
    """Whether this process can make kernels for the CPU."""
    return importlib.util.find_spec("llvmlite") is not None


@lru_cache(maxsize=1)
def missing() -> None:
    """Warns, once, that filters run interpreted."""
    text = f"compile: llvmlite, which compiles kernels, is not installed: filters run interpreted on the CPU; {INSTALL}"
    warnings.warn(text, RuntimeWarning, stacklevel=3)


@lru_cache(maxsize=1)
def binding() -> Any:
    """``llvmlite.binding``, ready to make code for this processor.

    Raises:
        CompileError: it is not installed.
    """
    try:
        llvm = importlib.import_module("llvmlite.binding")
    except ImportError as error:
        raise CompileError(
            f"compile: expected the package llvmlite, which compiles kernels ({error}): {INSTALL}; without compile() "
            "filters need none"
        ) from None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    llvm.initialize_native_asmparser()
    return llvm


@lru_cache(maxsize=1)
def features() -> str:
    """The instructions that it has, as LLVM calls them."""
    text: str = binding().get_host_cpu_features().flatten()
    return text


@lru_cache(maxsize=1)
def registers() -> str:
    """Its registers for several numbers: ``"avx512"``, ``"avx2"`` or ``""`` for any others."""
    has = set(features().split(","))
    if {"+avx512f", "+avx512bw", "+avx512dq", "+avx512vl"} <= has:
        return "avx512"
    return "avx2" if {"+avx2", "+fma"} <= has else ""


def lanes_of(dtype: torch.dtype, narrow: bool = False) -> Lanes:
    """How tracks lie side by side in its registers; ``narrow``: one track alone."""
    kind = registers()
    size = {"avx512": 64, "avx2": 32}.get(kind, 16)
    return Lanes(1 if narrow else size // dtype.itemsize, dtype, kind)

"""LLVM inside of this process, if it is installed."""

from __future__ import annotations

import importlib
import importlib.util
import warnings
from functools import lru_cache
from typing import Any

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

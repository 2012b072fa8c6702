"""LLVM inside of this process, if it is installed."""

from __future__ import annotations

import importlib
from functools import lru_cache
from typing import Any

from torchfra.types import CompileError

INSTALL = "pip install 'torchfra[compiler]'"
"""What gives a machine a compiler."""


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
            "the filter needs none"
        ) from None
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    llvm.initialize_native_asmparser()
    return llvm

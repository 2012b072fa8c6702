"""From instructions of LLVM to a function: compiled in this process by llvmlite, and kept on disk."""

from __future__ import annotations

import ctypes
import hashlib
import platform
import threading
from typing import Any

import torch

from torchfra.compiler import cache
from torchfra.compiler.elementary_functions import address
from torchfra.compiler.llvm import binding
from torchfra.compiler.processor import features
from torchfra.types import CompileError as CompileError

compiled = 0
"""How many kernels this process has compiled."""

_LEVEL = 1
"""Of optimisation: more of it takes 1.4 times as long, for kernels that are no faster."""
_loaded: dict[str, Any] = {}
"""By key, what holds the code of a kernel: as long as the process, since its functions may be called at any time."""
_LOADING = threading.Lock()


def load(source: str) -> Any:
    """The function ``run`` of a module.

    It is compiled by LLVM, unless an earlier process has done so: objects are kept in ``TORCHFRA_CACHE``, or
    ``~/.cache/torchfra`` (see ``cache``).

    Raises:
        CompileError: llvmlite is not installed, or what it makes cannot be loaded.
    """
    return _function(source, "run", None, [*[ctypes.c_int64] * 2, ctypes.c_int, *[ctypes.c_void_p] * 2])


def load_whole(source: str) -> Any:
    """The function ``whole`` of a source, which runs whole tracks.

    Raises:
        CompileError: it does not compile.
    """
    arguments = [ctypes.c_void_p, *[ctypes.c_int64] * 2, ctypes.c_int, *[ctypes.c_void_p] * 3, ctypes.c_int64]
    return _function(source, "whole", ctypes.c_int, arguments)


def _function(source: str, name: str, result: Any, arguments: list[Any]) -> Any:
    llvm = binding()
    words = source, str(_LEVEL), llvm.get_host_cpu_name(), features(), str(llvm.llvm_version_info), torch.__version__
    key = hashlib.sha256("\n".join(words).encode()).hexdigest()[:32]
    engine = _loaded.get(key)
    if engine is None:
        made = cache.read(f"{key}.o")
        if made is None:
            made = _compiled(source)
            cache.write(f"{key}.o", made)
        with _LOADING:
            engine = _loaded.setdefault(key, _loaded.get(key) or _engine(source, made))
    return ctypes.CFUNCTYPE(result, *arguments)(engine.get_function_address(name))


def _instead(name: str) -> int:
    """Where the function is that stands for one that neither torch nor the mathematics of C has here.

    Raises:
        CompileError: there is none.
    """
    if name != "GOMP_parallel":
        raise CompileError(f"compile: expected the function {name} of this system's mathematics, found none")
    return ctypes.cast(_PARALLEL, ctypes.c_void_p).value or 0


def _on_threads(function: int, argument: int, threads: int, _: int) -> None:
    """Calls a function on so many threads of Python, as ``GOMP_parallel`` of OpenMP does on its own."""
    call = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(function)  # which lets other threads run meanwhile
    others = [threading.Thread(target=call, args=(argument,)) for _ in range(threads - 1)]
    for other in others:
        other.start()
    call(argument)
    for other in others:
        other.join()


_PARALLEL = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint)(_on_threads)


def _machine() -> Any:
    llvm = binding()
    # Where code and its constants lie in memory is not known before: on x86 addresses must be whole.  On ARM llvmlite
    # keeps both together.
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    reach = {"reloc": "static", "codemodel": "large"} if x86 else {"reloc": "pic", "codemodel": "default"}
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features(), opt=_LEVEL, jit=True, **reach
    )


def _compiled(source: str) -> bytes:
    """The object of a module."""
    global compiled
    try:
        made: bytes = _machine().emit_object(binding().parse_assembly(source))
    except RuntimeError as error:
        raise CompileError(f"compile: no kernel from LLVM: {error}") from None
    compiled += 1
    return made


def _engine(source: str, made: bytes) -> Any:
    """What holds the code of an object, with the functions that it calls."""
    llvm = binding()
    for line in source.splitlines():
        if line.startswith("declare ") and "@llvm." not in line:
            name = line.split("@")[1].split("(")[0]
            llvm.add_symbol(name, address(name) or _instead(name))
    try:
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        engine.add_object_file(llvm.ObjectFileRef.from_data(made))
        engine.finalize_object()
    except RuntimeError as error:
        raise CompileError(f"compile: no kernel from LLVM: {error}") from None
    return engine

"""From instructions of LLVM to a function: compiled in this process by llvmlite, part by part, and kept on disk."""

from __future__ import annotations

import ctypes
import hashlib
import platform
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import torch

from torchfra.compiler import cache
from torchfra.compiler.elementary_functions import address
from torchfra.compiler.llvm import binding, features
from torchfra.compiler.sharing import PART
from torchfra.types import CompileError as CompileError

compiled = 0
"""How many kernels this process has compiled."""

_FORM = "objects, each behind its length"
"""What a kept kernel is.  It is part of its name: LLVM ends the process when it reads anything else."""
_LEVEL = 1
"""Level of optimisation: the next one takes 1.4 times as long, for kernels that are no faster."""
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


def load_tracks(source: str) -> Any:
    """The function ``filter_tracks`` of a source, which runs whole tracks.

    Raises:
        CompileError: it does not compile.
    """
    arguments = [ctypes.c_void_p, *[ctypes.c_int64] * 2, ctypes.c_int, *[ctypes.c_void_p] * 3, ctypes.c_int64]
    return _function(source, "filter_tracks", ctypes.c_int, arguments)


def _function(source: str, name: str, result: type[ctypes._SimpleCData[int]] | None, arguments: list[Any]) -> Any:
    llvm = binding()
    processor, versions = (llvm.get_host_cpu_name(), features()), (str(llvm.llvm_version_info), torch.__version__)
    words = source, _FORM, str(_LEVEL), *processor, *versions
    key = hashlib.sha256("\n".join(words).encode()).hexdigest()[:32]
    engine = _loaded.get(key)
    if engine is None:
        made = cache.read(f"{key}.o")
        if made is None:
            made = _packed(_compiled(source))
            cache.write(f"{key}.o", made)
        with _LOADING:
            engine = _loaded.setdefault(key, _loaded.get(key) or _engine(source, _unpacked(made)))
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
    # Where code and its constants lie in memory is not known before: on x86 addresses need all their bits.  On ARM
    # llvmlite keeps both together.
    x86 = platform.machine().lower() in ("x86_64", "amd64")
    reach = {"reloc": "static", "codemodel": "large"} if x86 else {"reloc": "pic", "codemodel": "default"}
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=features(), opt=_LEVEL, jit=True, **reach
    )


def _compiled(source: str) -> list[bytes]:
    """The objects of the parts of a module."""
    global compiled
    parts = source.split(PART)
    workers = min(len(parts), torch.get_num_threads())
    if workers == 1:
        made = [*map(_object, parts)]
    else:
        with ThreadPoolExecutor(workers) as threads:
            made = [*threads.map(_object, parts)]
    compiled += 1
    return made


def _object(part: str) -> bytes:
    llvm = binding()
    try:
        module, machine = llvm.parse_assembly(part, llvm.create_context()), _machine()
        with llvm.ffi.OutputString() as error:
            # llvmlite lets one thread at a time into LLVM.  This function needs no such lock: context and machine are
            # its own.
            memory = _emit()(machine, module, 1, error)
            if not memory:
                raise RuntimeError(str(error))
        lib = llvm.ffi.lib
        try:
            return ctypes.string_at(lib.LLVMPY_GetBufferStart(memory), lib.LLVMPY_GetBufferSize(memory))
        finally:
            lib.LLVMPY_DisposeMemoryBuffer(memory)
    except RuntimeError as error:
        raise CompileError(f"compile: no kernel from LLVM: {error}") from None


@lru_cache(maxsize=1)
def _emit() -> Any:
    """What makes an object of a module, without llvmlite's lock."""
    locked = binding().ffi.lib.LLVMPY_TargetMachineEmitToMemory
    emit = ctypes.CDLL(binding().ffi.lib._name).LLVMPY_TargetMachineEmitToMemory
    emit.argtypes, emit.restype = locked.argtypes, locked.restype
    return emit


def _packed(objects: Sequence[bytes]) -> bytes:
    """Objects in one file, each behind its length."""
    return b"".join(len(x).to_bytes(8, "little") + x for x in objects)


def _unpacked(content: bytes) -> list[bytes]:
    objects = []
    while content:
        end = 8 + int.from_bytes(content[:8], "little")
        objects.append(content[8:end])
        content = content[end:]
    return objects


def _engine(source: str, objects: Sequence[bytes]) -> Any:
    """What holds the code of objects, with the functions that they call."""
    llvm = binding()
    for line in source.splitlines():
        if line.startswith("declare ") and not line.startswith("declare hidden") and "@llvm." not in line:
            name = line.split("@")[1].split("(")[0]
            llvm.add_symbol(name, address(name) or _instead(name))
    try:
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())
        for made in objects:
            engine.add_object_file(llvm.ObjectFileRef.from_data(made))
        engine.finalize_object()
    except RuntimeError as error:
        raise CompileError(f"compile: no kernel from LLVM: {error}") from None
    return engine

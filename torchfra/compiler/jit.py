"""From instructions of LLVM to functions: compiled in this process by llvmlite, and kept on disk."""

from __future__ import annotations

import ctypes
import hashlib
import threading
import time
from functools import lru_cache
from typing import Any

import torch
import llvmlite.binding as llvm
from torchfra.compiler.elementary_functions import address
from torchfra.compiler.instructions import Lanes

_LOCK = threading.Lock()


@lru_cache(maxsize=1)
def _ready():
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    llvm.initialize_native_asmparser()


@lru_cache(maxsize=1)
def _features():
    return llvm.get_host_cpu_features()

def registers():
    f = _features()
    if all(f.get(x) for x in ("avx512f", "avx512bw", "avx512dq", "avx512vl")): return "avx512"
    return "avx2" if f.get("avx2") and f.get("fma") else ""

def lanes(dtype, narrow=False):
    kind = registers()
    size = {"avx512": 64, "avx2": 32}.get(kind, 16)
    return Lanes(1 if narrow else size // dtype.itemsize, dtype, kind)

OPT=1
_engines = []
def compiled_object(text):
    _ready()
    t0=time.perf_counter()
    module = llvm.parse_assembly(text)
    t1=time.perf_counter()
    target = llvm.Target.from_default_triple()
    machine = target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=_features().flatten(), opt=OPT, reloc="pic", codemodel="default", jit=True)
    r= machine.emit_object(module)
    import os
    if os.environ.get("JITV"): print(f"   parse {t1-t0:.2f} emit {time.perf_counter()-t1:.2f} lines {text.count(chr(10))} bytes {len(r)}")
    return r

def function(text, name, argtypes, restype):
    data = compiled_object(text)
    with _LOCK:
        for line in text.splitlines():
            if line.startswith("declare ") and "@llvm." not in line:
                symbol = line.split("@")[1].split("(")[0]
                llvm.add_symbol(symbol, address(symbol))
        machine = llvm.Target.from_default_triple().create_target_machine(opt=OPT, reloc="pic", jit=True)
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        engine.add_object_file(llvm.ObjectFileRef.from_data(data))
        engine.finalize_object()
        _engines.append(engine)
        f = ctypes.CFUNCTYPE(restype, *argtypes)(engine.get_function_address(name))
    return f

def load(text):
    return function(text, "run", [ctypes.c_int64, ctypes.c_int64, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p], None)

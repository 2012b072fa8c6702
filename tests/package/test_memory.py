"""Freed memory is kept where the C library can be told to, and its absence is reported."""

import ctypes
import platform
import subprocess
import sys

import pytest

import torchfra
from torchfra.running import memory

SCRIPT = """
import ctypes, importlib.util, sys
spec = importlib.util.spec_from_file_location("memory", sys.argv[1])
memory = importlib.util.module_from_spec(spec)
spec.loader.exec_module(memory)
faults = lambda: __import__("resource").getrusage(__import__("resource").RUSAGE_SELF).ru_minflt
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]

def rounds():
    before = faults()
    for _ in range(20):
        block = libc.malloc(32 << 20)
        ctypes.memset(block, 1, 32 << 20)
        libc.free(block)
    return faults() - before

without, said = rounds(), memory.keep_memory()
rounds()
print(said, without, rounds())
"""
"""Loads the module from its file: without torch, in a moment."""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is of glibc")
def test_with_glibc_freed_memory_is_kept_and_met_again_without_page_faults():
    done = subprocess.run([sys.executable, "-c", SCRIPT, memory.__file__], capture_output=True, text=True, check=True)
    effective, before, after = done.stdout.split()
    assert effective == "True"
    assert int(after) < 0.1 * int(before)


def test_elsewhere_than_on_linux_nothing_is_promised(monkeypatch):
    monkeypatch.setattr(sys, "platform", "darwin")
    assert torchfra.keep_memory() is False


def test_without_glibc_nothing_is_promised(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert torchfra.keep_memory() is False

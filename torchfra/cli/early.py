"""What takes a second begins before the options are read, which needs torch: processes that import it meanwhile."""

from __future__ import annotations

import argparse
import gc
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from types import ModuleType

from torchfra.running.jobs import cores, prepare

_LARGE = 1_000_000
"""Bytes of a file from which on it may have work for several processes."""


def start_processes(arguments: Sequence[str]) -> None:
    """Prepares for the work of ``torchfra track`` by several processes, if its arguments look like that.

    What is wrong with them is said by their own parser.
    """
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    parser.add_argument("--jobs", type=int)
    for name in ("--filter", "--out", "--html"):
        parser.add_argument(name)
    try:
        said, others = parser.parse_known_args(arguments)
    except argparse.ArgumentError:
        return
    large = any(os.path.isfile(name) and os.path.getsize(name) > _LARGE for name in others)
    if large and said.filter is None and (said.jobs or cores()) > 1 and "WORLD_SIZE" not in os.environ:
        prepare("torchfra.cleaning.core")


def imported(name: str) -> ModuleType:
    """A module, imported; what that makes stays until the end, so that no garbage is looked for among it."""
    if name in sys.modules:
        return sys.modules[name]
    collects = gc.isenabled()
    gc.disable()
    try:
        return import_module(name)
    finally:
        gc.freeze()
        if collects:
            gc.enable()

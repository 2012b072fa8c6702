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
OPTIONS: dict[type, str] = {
    str: "out format html json bank filter time x y z lat lon alt id sigma-column units delimiter decimal time-format "
    "missing",
    float: "sigma q dt", int: "jobs max-bytes",
    bool: "plots no-plots compile no-compile share-script no-share-script no-smooth no-repair quiet verbose",
}  # fmt: skip
"""Those of ``torchfra track`` by their types."""


def start_processes(arguments: Sequence[str]) -> None:
    """Prepares for the work of ``torchfra track`` by several processes, if its arguments look like that.

    What is wrong with them is said by their own parser, sooner if nothing else begins.
    """
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    parser.add_argument("files", nargs="*")
    for kind, names in OPTIONS.items():
        for name in names.split():
            parser.add_argument(f"--{name}", **({"action": "store_true"} if kind is bool else {"type": kind}))
    try:
        said, others = parser.parse_known_args(arguments)
    except argparse.ArgumentError:
        return
    wrong = others or any(value is not None and not value > 0 for value in (said.sigma, said.q, said.dt))
    if wrong or len(said.files) != 1 or not os.path.isfile(said.files[0]):
        return
    large = os.path.getsize(said.files[0]) > _LARGE
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

"""Forward and backward through filters."""

from __future__ import annotations

import argparse
import copy
import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import pad

from benchmarks.roof import FILTERS
from benchmarks.timing import Row, learners, timed
from torchfra.catalogue import make_filter, make_scenario
from torchfra.filters import Filter
from torchfra.linalg import triangular
from torchfra.scenarios import Tracks

Call = Callable[[], None]
_LEARNED = ("srckf", "gpb", "fra")
"""Filters that are timed unless others are named."""
_BESIDE = ("srckf", "fra")
"""Filters that are timed with checkpoints and with torch's own gradients too; others take too long."""


def training(options: argparse.Namespace) -> list[Row]:
    """Gradients of all values over 64 tracks (or the first number of ``--batch``), with time and peak memory.

    Of SRCKF, FRA with hard and soft decisions and GPB of one motion, or of ``--filters``.
    """
    scenario = make_scenario(options.scenario, outliers="std", initial=options.initial)
    batch = int((options.batch or "64").split(",")[0])
    data = scenario.simulate(batch, 0)
    rows: list[Row] = []
    names = _LEARNED if options.filters == FILTERS else options.filters.split(",")
    for name in [*names, *(["fra, soft"] if "fra" in names else [])]:
        kind, more = name.split(",")[0], {"temperature": 1.0} if "," in name else {}
        bank = None if kind == "gpb" else scenario.bank  # of one motion here
        f = make_filter(kind, scenario.motion, scenario.sensor, bank, learn="all", **more)
        systems: dict[str, Call] = {
            f"{name}, compiled": backward(copy.deepcopy(f).compile(), data),
            f"{name}, eager": backward(f, data),
        }
        if kind in _BESIDE:
            systems[f"{name}, eager, checkpoints"] = backward(f, data, checkpoint=10)
            systems[f"{name}, torch.linalg.qr"] = with_plain_qr(backward(f, data))
        of_kind = timed(learners(systems), options.passes, batch * scenario.steps, batch=batch)
        for row in of_kind:
            row["peak_mib"] = peak(systems[row["system"]])
        rows += of_kind
    return rows


def backward(f: Filter, data: Tracks, **more: Any) -> Call:
    """The gradient of the squared error of the position."""

    def call() -> None:
        f.zero_grad()
        estimate = f(data.z, data.prior, u=data.u, **more)
        (estimate.mean - data.truth)[..., :2].square().mean().backward()

    return call


def with_plain_qr(call: Call) -> Call:
    """The same with gradients through ``torch.linalg.qr``."""

    def plain() -> None:
        with plain_qr():
            call()

    return plain


@contextmanager
def plain_qr() -> Iterator[None]:
    """Gradients through ``torch.linalg.qr`` itself, as one would write it without torchfra."""

    class Plain:
        @staticmethod
        def apply(a, way):
            unit = isinstance(way, triangular._Update) and way.unit
            a = triangular._behind_unit(a, way.measured) if unit else a
            lower = torch.linalg.qr(pad(a, (a.shape[-2], 0)).mT).R.mT  # square, however few its columns
            return lower * lower.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)

    before, triangular._Tria = triangular._Tria, Plain
    try:
        yield
    finally:
        triangular._Tria = before


def peak(call: Call) -> float | None:
    """MiB that a call needs on top of what is in use; None where the system does not say."""
    status = Path("/proc/self/status")

    def read(key: str) -> int:
        return int(next(line for line in status.read_text().splitlines() if line.startswith(key)).split()[1])

    try:
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        before = read("VmRSS")
        call()
        return (read("VmHWM") - before) / 1024
    except (OSError, AttributeError, StopIteration):
        return None

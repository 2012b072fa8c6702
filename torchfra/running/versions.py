"""Versions of the software that computes, and results that name them."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchfra.running.atomic_write import write_json
from torchfra.version import __version__


def versions() -> dict[str, str]:
    """Versions of the software that computed the results."""
    return {
        "torchfra": __version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def write_results(path: Path | None, results: Mapping[str, Any]) -> None:
    """Writes results as JSON, behind the versions, unless no file is asked for."""
    if path is not None:
        write_json(path, {"versions": versions(), **results})

"""Versions of the software that computes."""

from __future__ import annotations

import platform

import numpy as np
import torch

from torchfra.version import __version__


def versions() -> dict[str, str]:
    """Versions of the software that computed the results."""
    return {
        "torchfra": __version__,
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }

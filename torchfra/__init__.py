"""Robust, adaptive tracking of manoeuvring targets: batched, differentiable square-root filters for PyTorch."""

from torchfra import (
    adaptive,
    bank,
    cubature,
    gains,
    linalg,
    losses,
    metrics,
    motion,
    presets,
    readers,
    robust,
    scenarios,
    sensors,
    statistical,
)
from torchfra.hyper import Hyper, learnable, summary
from torchfra.malloc import keep_memory
from torchfra.types import Estimate, Gaussian, Innovation
from torchfra.version import __version__ as __version__

__all__ = [
    "Estimate",
    "Gaussian",
    "Hyper",
    "Innovation",
    "adaptive",
    "bank",
    "cubature",
    "gains",
    "keep_memory",
    "learnable",
    "linalg",
    "losses",
    "metrics",
    "motion",
    "presets",
    "readers",
    "robust",
    "scenarios",
    "sensors",
    "statistical",
    "summary",
]

"""Robust, adaptive tracking of manoeuvring targets: batched, differentiable square-root filters for PyTorch."""

from torchfra import (
    adaptive,
    association,
    coordinates,
    filters,
    gaussian,
    linalg,
    losses,
    metrics,
    motion,
    presets,
    readers,
    register,
    robust,
    scenarios,
    sensors,
    stream,
    targets,
    testing,
)
from torchfra.cli.clean import clean, track
from torchfra.cli.compare import compare
from torchfra.cli.memory import keep_memory
from torchfra.fitting.from_tracks import fit
from torchfra.hyper import Hyper, learnable, summary
from torchfra.presets.values import values
from torchfra.testing.models import check_model
from torchfra.types import Cause, Estimate, Failure, Gaussian, Innovation
from torchfra.version import __version__ as __version__

__all__ = [
    "Cause",
    "Estimate",
    "Failure",
    "Gaussian",
    "Hyper",
    "Innovation",
    "adaptive",
    "association",
    "check_model",
    "clean",
    "compare",
    "coordinates",
    "filters",
    "fit",
    "gaussian",
    "keep_memory",
    "learnable",
    "linalg",
    "losses",
    "metrics",
    "motion",
    "presets",
    "readers",
    "register",
    "robust",
    "scenarios",
    "sensors",
    "stream",
    "summary",
    "targets",
    "testing",
    "track",
    "values",
]

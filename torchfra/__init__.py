"""Robust, adaptive tracking of manoeuvring targets: batched, differentiable square-root filters for PyTorch.

Modules load when they are first named: ``torchfra.presets`` loads what a filter needs, ``torchfra.readers`` what reads
files, and so on.
"""

from typing import TYPE_CHECKING

from torchfra.version import __version__ as __version__

__all__ = [
    "Alarm",
    "Cause",
    "Estimate",
    "Failure",
    "Gaussian",
    "Hyper",
    "Innovation",
    "adapters",
    "adaptive",
    "association",
    "check_model",
    "clean",
    "cleaning",
    "compare",
    "coordinates",
    "correlation",
    "evaluation",
    "filters",
    "fit",
    "fitting",
    "gaussian",
    "keep_memory",
    "learnable",
    "linalg",
    "losses",
    "metrics",
    "motion",
    "plotting",
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

if TYPE_CHECKING:
    from torchfra import (
        adapters,
        adaptive,
        association,
        cleaning,
        coordinates,
        evaluation,
        filters,
        fitting,
        gaussian,
        linalg,
        losses,
        metrics,
        motion,
        plotting,
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
    from torchfra.cleaning.clean import clean, track
    from torchfra.evaluation.comparison import compare
    from torchfra.fitting.correlation import correlation
    from torchfra.fitting.from_tracks import fit
    from torchfra.hyper import Hyper, learnable, summary
    from torchfra.presets.values import values
    from torchfra.running.memory import keep_memory
    from torchfra.testing.models import check_model
    from torchfra.types import Alarm, Cause, Estimate, Failure, Gaussian, Innovation
else:
    from torchfra.loading import when_named

    _, __getattr__, _ = when_named(__name__, {
        "types": "Alarm Cause Estimate Failure Gaussian Innovation",
        "hyper": "Hyper learnable summary",
        "presets.values": "values",
        "testing.models": "check_model",
        "fitting.from_tracks": "fit",
        "fitting.correlation": "correlation",
        "cleaning.clean": "clean track",
        "evaluation.comparison": "compare",
        "running.memory": "keep_memory",
    })  # fmt: skip

    def __dir__() -> list[str]:
        return [*__all__, "__version__"]

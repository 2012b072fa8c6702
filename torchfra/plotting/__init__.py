"""Figures; the only part of torchfra that imports matplotlib.

Each function returns a figure outside of pyplot, so that none has to be closed; ``save`` writes it.
"""

from torchfra.plotting.cleaning import cleaned, overview
from torchfra.plotting.comparison import comparison, printed, ratios
from torchfra.plotting.curves import (
    against,
    bands,
    by_coordinate,
    by_target,
    innovations,
    learning_curve,
    probabilities,
    raw_and_filtered,
    rmse_curves,
    scaling,
)
from torchfra.plotting.paths import in_space, tracks
from torchfra.plotting.style import save
from torchfra.running import home  # noqa: F401  # before matplotlib

__all__ = [
    "against",
    "bands",
    "by_coordinate",
    "by_target",
    "cleaned",
    "comparison",
    "in_space",
    "innovations",
    "learning_curve",
    "overview",
    "printed",
    "probabilities",
    "ratios",
    "raw_and_filtered",
    "rmse_curves",
    "save",
    "scaling",
    "tracks",
]

"""Figures; the only part of torchfra that imports matplotlib.

Each function returns a figure that pyplot does not know of, so that nothing has to be closed; ``save`` writes it.
"""

from torchfra.app import home  # noqa: F401  # before matplotlib
from torchfra.app.plotting.bands import bands
from torchfra.app.plotting.cleaning import cleaned
from torchfra.app.plotting.comparison import comparison
from torchfra.app.plotting.curves import against, by_coordinate, innovations, rmse_curves, scaling
from torchfra.app.plotting.models import probabilities
from torchfra.app.plotting.overview import overview
from torchfra.app.plotting.paths import in_space, tracks
from torchfra.app.plotting.printed import printed
from torchfra.app.plotting.ratios import ratios
from torchfra.app.plotting.style import save
from torchfra.app.plotting.targets import by_target, raw_and_filtered
from torchfra.app.plotting.training import learning_curve

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

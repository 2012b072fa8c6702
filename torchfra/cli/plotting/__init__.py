"""Figures; the only part of torchfra that imports matplotlib.

Each function returns a figure that pyplot does not know of, so that nothing has to be closed; ``save`` writes it.
"""

from torchfra.cli import home  # noqa: F401  # before matplotlib
from torchfra.cli.plotting.bands import bands
from torchfra.cli.plotting.cleaning import cleaned
from torchfra.cli.plotting.comparison import comparison
from torchfra.cli.plotting.curves import against, by_coordinate, innovations, rmse_curves, scaling
from torchfra.cli.plotting.models import probabilities
from torchfra.cli.plotting.overview import overview
from torchfra.cli.plotting.paths import in_space, tracks
from torchfra.cli.plotting.printed import printed
from torchfra.cli.plotting.ratios import ratios
from torchfra.cli.plotting.style import save
from torchfra.cli.plotting.targets import by_target, raw_and_filtered
from torchfra.cli.plotting.training import learning_curve

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

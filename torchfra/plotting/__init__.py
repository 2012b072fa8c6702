"""Figures; with ``torchfra.cleaning.figures`` the only part of torchfra that imports matplotlib.

Each function returns a figure outside of pyplot, so that none has to be closed; ``save`` writes it.
"""

from torchfra.plotting.comparison import comparison, printed
from torchfra.plotting.curves import learning_curve, tracks
from torchfra.plotting.style import save
from torchfra.running import home  # noqa: F401  # before matplotlib

__all__ = ["comparison", "learning_curve", "printed", "save", "tracks"]

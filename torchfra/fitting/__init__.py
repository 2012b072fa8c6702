"""Learning from one's own data: ``torchfra.fit(filter, data)`` and what comes with it.

``fit`` gives a ``Fitted``: the learned values, standard errors, what is identified, before and after on held-out
tracks.  ``sweep`` tries a grid of values in one program.  ``torchfra/fitting/README.md`` shows both.
"""

from torchfra.fitting.data import Batch
from torchfra.fitting.errors import Bootstrap, Profile
from torchfra.fitting.fitted import Fitted
from torchfra.fitting.from_tracks import fit
from torchfra.fitting.judging import Figure, HeldOutComparison, Judged
from torchfra.fitting.likelihood import LogLikelihood
from torchfra.fitting.sweeping import Sweep, sweep

__all__ = [
    "Batch",
    "Bootstrap",
    "Figure",
    "Fitted",
    "HeldOutComparison",
    "Judged",
    "LogLikelihood",
    "Profile",
    "Sweep",
    "fit",
    "sweep",
]

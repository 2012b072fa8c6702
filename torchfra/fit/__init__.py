"""Learning from one's own data: ``torchfra.fit(filter, data)`` and what comes with it.

``fit`` gives a ``Fitted``: the learned values, standard errors, what is identified, before and after on held-out
tracks.  ``sweep`` tries a grid of values in one program.  ``torchfra/fit/README.md`` shows both.
"""

from torchfra.fit.again import Bootstrap, Profile
from torchfra.fit.data import Batch
from torchfra.fit.fitted import Fitted
from torchfra.fit.fitting import fit
from torchfra.fit.judging import Comparison, Figure, Judged
from torchfra.fit.sweeping import Sweep, sweep

__all__ = ["Batch", "Bootstrap", "Comparison", "Figure", "Fitted", "Judged", "Profile", "Sweep", "fit", "sweep"]

"""Filters by the names that papers gave them: each is a choice of arguments to the classes of ``torchfra.filters``.

Every preset takes ``motion`` (how targets move; for interacting models a ``Bank`` or several motions of one state) and
``sensor`` (what is measured), then keywords.  ``help(presets.fra)`` lists the keywords of a preset; the line of each
names the class whose docstring has the details.  A value out of its range is a ``ValueError`` that names the argument.

All presets take ``learn``: the names of the hyperparameters that gradient descent may change, in any part of the
filter, or ``"all"``.  ``torchfra.hyper.summary(f)`` prints the names that a filter has:

- of the robust update: ``threshold``, ``low``, ``high``, ``eps``;
- of the fading factors: ``weakening``, ``forgetting``, ``fading_max``, ``share``;
- of the estimated measurement noise: ``forgetting``, ``confidence``;
- of the feedback decision: ``gate``, ``preference``, ``plain``;
- of ``gpb``: ``noise_levels``, ``jump_factors``, ``self_transition``, ``restart``, ``outlier_transition``,
  ``outlier_sizes``, ``outlier_shares``, ``prior_outlier``, ``prior_inflation``, ``noise_doubt``, ``noise_memory``;
- of interacting models: ``self_transition``, one number, or ``transition``, a matrix, if that is given; ``initial``;
- of interacting models with a likely-model set: ``transition``, ``unlikely``, ``principal``;
- of association: ``detection``, ``gate.size``, ``probability``, ``volume``, ``rate``;
- of motions and sensors: ``q``, ``std``, ``rate``, ``alpha``, ``limit``.

A motion, a sensor or a robust update whose values learn is copied first, so that the argument does not change; one
whose values do not learn is shared.  Filters around another one (``imm``, ``vsimm_srckf``, ``jpda``) always work on
copies.

A filter around another (``imm``, ``vsimm_srckf``, ``jpda``) takes that other as ``inner``: a preset, or any callable
``(motion, sensor) -> Filter``.  Options of the inner filter are bound with ``functools.partial``::

    imm(bank, sensor, inner=partial(rsrckf, threshold=2.0))
"""

from typing import TYPE_CHECKING

from torchfra.loading import when_named
from torchfra.register import LIBRARY

if TYPE_CHECKING:
    from torchfra.presets.banks import *
    from torchfra.presets.constant_gains import *
    from torchfra.presets.feedback import *
    from torchfra.presets.regimes import *
    from torchfra.presets.scans import *
    from torchfra.presets.single import *
else:
    __all__, __getattr__, __dir__ = when_named(__name__, LIBRARY)

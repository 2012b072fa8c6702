"""Track initiation and deletion: births from unassociated measurements, confirmation, deletion and identities.

``Targets`` is a manager around ``torchfra.filters.JPDA``.  ``torchfra/targets/README.md`` shows how to use it.
"""

from torchfra.targets.births import Birth, OnePoint, PoissonBirths, TwoPoint
from torchfra.targets.clutter_map import ClutterMap
from torchfra.targets.extent import Extent
from torchfra.targets.manager import Targets
from torchfra.targets.merging import Merging
from torchfra.targets.rules import SPRT, Confirmation, Deletion, Existence, MOfN
from torchfra.targets.state import TargetsEstimate, TargetsState, Track, collect
from torchfra.targets.stitching import Stitching
from torchfra.targets.triangulation import Triangulation
from torchfra.targets.views import FieldOfView
from torchfra.targets.visibility import Visibility

__all__ = [
    "SPRT",
    "Birth",
    "ClutterMap",
    "Confirmation",
    "Deletion",
    "Existence",
    "Extent",
    "FieldOfView",
    "MOfN",
    "Merging",
    "OnePoint",
    "PoissonBirths",
    "Stitching",
    "Targets",
    "TargetsEstimate",
    "TargetsState",
    "Track",
    "Triangulation",
    "TwoPoint",
    "Visibility",
    "collect",
]

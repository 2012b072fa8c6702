"""Data association: gates, clutter density, and probabilities of which measurement originates from which target.

All probabilities are logs.  In a joint event each target is missed or has one measurement, and each measurement belongs
to one target or is false.  Targets that share measurements in their gates, directly or through others, form a cluster;
clusters are independent of each other.
"""

from typing import TYPE_CHECKING

from torchfra.loading import when_named

if TYPE_CHECKING:  # isort: off
    from torchfra.association.clusters import (
        Association as Association,
        Clusters as Clusters,
        same_cluster as same_cluster,
    )
    from torchfra.association.clutter import Clutter as Clutter
    from torchfra.association.events import check_exact as check_exact, joint_events as joint_events
    from torchfra.association.gates import (
        Candidates as Candidates,
        ChiSquare as ChiSquare,
        Euclidean as Euclidean,
        Gate as Gate,
    )
    from torchfra.association.joint import associate as associate
else:
    __all__, __getattr__, __dir__ = when_named(__name__, {
        "association.clusters": "Association Clusters same_cluster",
        "association.clutter": "Clutter",
        "association.events": "check_exact joint_events",
        "association.gates": "Candidates ChiSquare Euclidean Gate",
        "association.joint": "associate",
    })  # fmt: skip

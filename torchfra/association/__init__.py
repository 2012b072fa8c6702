"""Data association: gates, clutter density, and probabilities of which measurement originates from which target.

All probabilities are logs.  In a joint event each target is missed or has one measurement, and each measurement belongs
to one target or is false.  Targets that share measurements in their gates, directly or through others, form a cluster;
clusters are independent of each other.
"""

from torchfra.association.clusters import Association, Clusters, same_cluster
from torchfra.association.clutter import Clutter
from torchfra.association.events import check_exact, joint_events
from torchfra.association.gates import Candidates, ChiSquare, Euclidean, Gate
from torchfra.association.joint import associate

__all__ = [
    "Association",
    "Candidates",
    "ChiSquare",
    "Clusters",
    "Clutter",
    "Euclidean",
    "Gate",
    "associate",
    "check_exact",
    "joint_events",
    "same_cluster",
]

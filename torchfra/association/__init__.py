"""Which measurement is whose: gates, the density of false measurements, probabilities of joint association.

Everything is in the log domain.  A target is missed or has one measurement; a measurement is of one target or false.
Targets that share measurements in their gates, directly or through others, are a cluster; clusters do not matter to
each other.
"""

from torchfra.association.clusters import Association, Clusters, clusters
from torchfra.association.clutter import Clutter
from torchfra.association.events import check_exact, enumerate_events, events
from torchfra.association.gates import Candidates, ChiSquare, Euclidean, Gate
from torchfra.association.joint import associate
from torchfra.association.messages import propagate

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
    "clusters",
    "enumerate_events",
    "events",
    "propagate",
]

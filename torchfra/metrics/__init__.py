"""Errors and consistency of estimates, over time and over runs.  Steps whose truth is NaN do not count.

``states`` are the components to compare, the same in estimate and truth.  Of a scenario, whatever coordinates its
filters estimate in::

    rmse(scenario.cartesian(estimate).mean, tracks.truth, scenario.truth_position)
"""

from torchfra.metrics.bounds import cramer_rao, outlier_information
from torchfra.metrics.errors import diverged, error, nees, rmse, track_rmse
from torchfra.metrics.identities import HOTA, IDF1, hota, idf1
from torchfra.metrics.lives import Lives, lives
from torchfra.metrics.sets import GOSPA, OSPA, gospa, ospa, swaps

__all__ = [
    "GOSPA",
    "HOTA",
    "IDF1",
    "OSPA",
    "Lives",
    "cramer_rao",
    "diverged",
    "error",
    "gospa",
    "hota",
    "idf1",
    "lives",
    "nees",
    "ospa",
    "outlier_information",
    "rmse",
    "swaps",
    "track_rmse",
]

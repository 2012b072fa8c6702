"""The algebra of all Gaussian filters: rules, prediction, comparison, the update in array form, and mixtures."""

from torchfra.gaussian.cubature import (
    fifth_degree,
    first_order,
    gauss_hermite,
    spherical_fifth_degree,
    third_degree,
    unscented,
)
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.rules import FirstOrder, Linearised, Rule, SigmaPoints

__all__ = [
    "FirstOrder",
    "Linearised",
    "Rule",
    "SigmaPoints",
    "fifth_degree",
    "first_order",
    "gauss_hermite",
    "moment_match",
    "spherical_fifth_degree",
    "third_degree",
    "unscented",
]

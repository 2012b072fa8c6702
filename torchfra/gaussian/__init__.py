"""The algebra of all Gaussian filters: rules, prediction, comparison, the update in array form, and mixtures."""

from torchfra.gaussian.cubature import fifth_degree, tangent, third_degree, unscented
from torchfra.gaussian.mixture import moment_match
from torchfra.gaussian.rules import Linearised, Rule, SigmaPoints, Tangent

__all__ = [
    "Linearised",
    "Rule",
    "SigmaPoints",
    "Tangent",
    "fifth_degree",
    "moment_match",
    "tangent",
    "third_degree",
    "unscented",
]

"""Monte-Carlo evaluation: runs of a scenario through filters, and what is written and printed of them."""

from torchfra.evaluation.flights import Flight, flight
from torchfra.evaluation.results import BASELINE, Result, headline, leaders, not_finite, recordings_table, report, table
from torchfra.evaluation.runs import check_limit, divergence_limit, evaluate, measure, results_of, run

__all__ = [
    "BASELINE",
    "Flight",
    "Result",
    "check_limit",
    "divergence_limit",
    "evaluate",
    "flight",
    "headline",
    "leaders",
    "measure",
    "not_finite",
    "recordings_table",
    "report",
    "results_of",
    "run",
    "table",
]

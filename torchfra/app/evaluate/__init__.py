"""Monte-Carlo evaluation: runs of a scenario through filters, and what is written and printed of them."""

from torchfra.app.evaluate.flights import Flight, flight
from torchfra.app.evaluate.limits import check_limit, divergence_limit
from torchfra.app.evaluate.recordings import recordings_table
from torchfra.app.evaluate.results import BASELINE, Result, leaders, not_finite, report, table, versions
from torchfra.app.evaluate.runs import evaluate, measure, results_of, run
from torchfra.app.evaluate.sureness import sureness

__all__ = [
    "BASELINE",
    "Flight",
    "Result",
    "check_limit",
    "divergence_limit",
    "evaluate",
    "flight",
    "leaders",
    "measure",
    "not_finite",
    "recordings_table",
    "report",
    "results_of",
    "run",
    "sureness",
    "table",
    "versions",
]

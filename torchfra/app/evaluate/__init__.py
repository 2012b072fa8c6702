"""Monte-Carlo evaluation: runs of a scenario through filters, and what is written and printed of them."""

from torchfra.app.evaluate.flights import Flight, flight
from torchfra.app.evaluate.results import BASELINE, Result, leaders, report, table, versions
from torchfra.app.evaluate.runs import LIMIT, evaluate, measure, results_of, run

__all__ = [
    "BASELINE",
    "LIMIT",
    "Flight",
    "Result",
    "evaluate",
    "flight",
    "leaders",
    "measure",
    "report",
    "results_of",
    "run",
    "table",
    "versions",
]

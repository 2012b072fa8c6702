"""Monte-Carlo evaluation: runs of a scenario through filters, and what is written and printed of them."""

from torchfra.cli.evaluate.flights import Flight, flight
from torchfra.cli.evaluate.limits import check_limit, divergence_limit
from torchfra.cli.evaluate.recordings import recordings_table
from torchfra.cli.evaluate.results import BASELINE, Result, leaders, not_finite, report, table, versions
from torchfra.cli.evaluate.runs import evaluate, measure, results_of, run
from torchfra.cli.evaluate.sureness import sureness

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

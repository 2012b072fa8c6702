"""Monte-Carlo evaluation: runs of a scenario through filters, and what is written and printed of them."""

from torchfra.evaluation.mapped_run import mapped_run
from torchfra.evaluation.results import BASELINE, Result, headline, leaders, not_finite, recordings_table, report, table
from torchfra.evaluation.runs import check_limit, divergence_limit, evaluate, measure, results_of, run

__all__ = [
    "BASELINE",
    "Result",
    "check_limit",
    "divergence_limit",
    "evaluate",
    "headline",
    "leaders",
    "mapped_run",
    "measure",
    "not_finite",
    "recordings_table",
    "report",
    "results_of",
    "run",
    "table",
]

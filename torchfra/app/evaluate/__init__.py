"""Monte-Carlo evaluation: runs of a scenario through filters, and what is written and printed of them."""

from torchfra.app.evaluate.results import Result, report, table, versions
from torchfra.app.evaluate.runs import evaluate, run

__all__ = ["Result", "evaluate", "report", "run", "table", "versions"]

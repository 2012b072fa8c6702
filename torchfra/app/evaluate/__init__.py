"""Monte-Carlo evaluation: runs of a scenario through filters, and what is written and printed of them."""

from torchfra.app.evaluate.recordings import recordings_table
from torchfra.app.evaluate.results import Result, report, table, versions
from torchfra.app.evaluate.runs import evaluate, run

__all__ = ["Result", "evaluate", "recordings_table", "report", "run", "table", "versions"]

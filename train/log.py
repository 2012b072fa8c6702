"""Progress of a run on the terminal and in TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchfra.running import distributed
from torchfra.running.progress import progress_bar
from torchfra.tables import printable
from train.config import Config


class Log:
    """Shows each iteration.

    Args:
        config: of the run.
        out: folder of the TensorBoard log, if ``config.tensorboard``.
        begin: the first iteration.
        quiet: whether to print nothing.

    Raises:
        ImportError: TensorBoard is asked for and not installed.
    """

    def __init__(self, config: Config, out: Path, *, begin: int, quiet: bool) -> None:
        self.name, self.quiet = printable(config.name), quiet
        self.board = _tensorboard(out) if config.tensorboard and distributed.rank() == 0 else None
        self.bar = progress_bar(range(begin, config.iterations), self.name, not quiet)
        """The numbers of the iterations, behind a progress bar on a terminal."""

    def show(self, row: Mapping[str, float]) -> None:
        """One iteration: in the bar, or without one a line for each validation."""
        iteration, loss = row["iteration"], row["loss"]
        if hasattr(self.bar, "set_postfix"):
            self.bar.set_postfix(loss=f"{loss:.4f}", left_out=row["left out"])
        elif not self.quiet and "validation" in row:
            print(f"{self.name} {iteration}: loss {loss:.4f}, validation {row['validation']:.4f}", flush=True)
        if self.board is not None:
            for key, value in row.items():
                self.board.add_scalar(key, value, iteration)


def _tensorboard(out: Path) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise ImportError("tensorboard=true needs TensorBoard: pip install 'torchfra[tensorboard]'") from None
    return SummaryWriter(out)

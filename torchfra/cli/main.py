"""The ``torchfra`` command."""

from __future__ import annotations

from collections.abc import Sequence

from torchfra.cli import compare_command, distributed, track_command
from torchfra.cli.command import exit_status, make_parser
from torchfra.version import __version__


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
        arguments: of the command line; None for those of this process.

    Returns:
        The exit status: see ``command.exit_status``.
    """
    parser = make_parser("Robust, adaptive tracking of manoeuvring targets.", "torchfra")
    parser.add_argument("--version", action="version", version=f"torchfra {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    track_command.add_to(commands)
    compare_command.add_to(commands)

    def work() -> None:
        options = parser.parse_args(arguments)
        options.run(options)

    with distributed.team():
        return exit_status("torchfra", work)

"""The ``torchfra`` command."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import nullcontext
from importlib import import_module
from typing import Any

from torchfra.cli.command import Parser, exit_status, make_parser
from torchfra.version import __version__

COMMANDS = {
    "track": "clean a recorded track",
    "many": "clean the tracks of a data set in Parquet, by several processes",
    "compare": "run a batch of tracks through several filters",
}
"""Descriptions of the commands; each has a module with its options and function, such as ``track_command``."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command.

    Args:
        arguments: of the command line; None for those of this process.

    Returns:
        The exit status: see ``command.exit_status``.
    """
    parser = make_parser("Robust, adaptive tracking of manoeuvring targets.", "torchfra")
    parser.add_argument("--version", action="version", version=f"torchfra {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Command)
    for name, about in COMMANDS.items():
        commands.add_parser(name, help=about, formatter_class=argparse.RawDescriptionHelpFormatter)

    options = argparse.Namespace(together=True)

    def work() -> None:
        parser.parse_args(arguments, options)
        from torchfra.running import distributed  # imports torch, which takes long

        with distributed.team() if options.together else nullcontext():
            options.run(options)

    return exit_status("torchfra", work, lambda: not options.together)


class _Command(Parser):
    """The parser of one command, whose module is imported when it is called."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Adds the options of the command, then parses."""
        import_module(f"torchfra.cli.{self.prog.split()[-1]}_command").add_to(self)
        options, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return options, unknown

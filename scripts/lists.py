"""Options of scripts that are comma-separated lists."""

from __future__ import annotations

import argparse
import math
from collections.abc import Collection

from torchfra.suggestions import meant


def check_list(parser: argparse.ArgumentParser, option: str, value: str, known: Collection[str]) -> None:
    """Ends the program with a message unless ``value`` is a comma-separated list of known names."""
    unknown = [name for name in value.split(",") if name not in known]
    if unknown:
        received = f"{', '.join(unknown)}{meant(unknown[0], known)}"
        parser.error(f"--{option}: expected some of {', '.join(known)}, received {received}")


def numbers_in(option: str, value: str) -> list[float]:
    """The numbers in a comma-separated list.

    Raises:
        ValueError: one that is no number above 0.
    """
    try:
        numbers = [float(number) for number in value.split(",")]
    except ValueError:
        numbers = []
    if not numbers or not all(0 < number < math.inf for number in numbers):
        raise ValueError(f"{option}: expected numbers above 0, separated by commas, received {value!r}")
    return numbers

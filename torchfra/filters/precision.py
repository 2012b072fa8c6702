"""Filters compute in the dtype of their data, whatever mixed precision the program around them asks for."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
R = TypeVar("R")


def in_full_precision(method: Callable[P, R]) -> Callable[P, R]:
    """A method that computes under ``torch.autocast`` as it does without: half precision is too coarse for roots."""

    @wraps(method)
    def full(*arguments: P.args, **options: P.kwargs) -> R:
        if not (torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")):
            return method(*arguments, **options)
        with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
            return method(*arguments, **options)

    return full

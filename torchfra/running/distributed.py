"""Several processes, as ``torchrun`` starts them: rank, share of the work, sums and lists over all of them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor, distributed

T = TypeVar("T")


@contextmanager
def team() -> Iterator[None]:
    """Joins the processes that ``torchrun`` started; does nothing in a single process.

    Tensors on the CPU go by gloo, those on a GPU by nccl; each process takes the GPU of its local rank.
    """
    if launched()[1] == 1 or distributed.is_initialized():
        yield
        return
    gpu = torch.cuda.is_available() and distributed.is_nccl_available()
    if gpu:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    distributed.init_process_group("cpu:gloo,cuda:nccl" if gpu else "gloo")
    try:
        yield
    finally:
        distributed.destroy_process_group()


def launched() -> tuple[int, int]:
    """Number of this process, from 0, and how many ``torchrun`` has started, whether or not they have joined.

    Raises:
        ValueError: ``RANK`` is no whole number from 0 that is below ``WORLD_SIZE``.
    """
    if "WORLD_SIZE" not in os.environ:
        return 0, 1
    said = os.environ.get("RANK", "0"), os.environ["WORLD_SIZE"]
    number, count = (int(text) if text.isdecimal() else -1 for text in said)
    if not 0 <= number < count:
        raise ValueError(f"RANK, WORLD_SIZE: expected whole numbers with 0 <= RANK < WORLD_SIZE, received {said}")
    return number, count


def rank() -> int:
    """Number of this process, from 0."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def size() -> int:
    """Number of processes."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def share(count: int) -> range:
    """Which of ``count`` items this process takes; each item goes to one process, in order of rank."""
    return range(count * rank() // size(), count * (rank() + 1) // size())


def gathered(thing: T) -> list[T]:
    """One object from each process, in order of rank."""
    if size() == 1:
        return [thing]
    things: list[Any] = [None] * size()
    distributed.all_gather_object(things, thing)
    return things


def summed(tensor: Tensor) -> Tensor:
    """The sum over all processes, the same in each."""
    if size() == 1:
        return tensor
    total = tensor.detach().clone()
    distributed.all_reduce(total)
    return total

"""Work of many independent parts, on all processors: a process for each, of one thread."""

from __future__ import annotations

import argparse
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice, starmap
from typing import Any, TypeVar

import torch

from torchfra.running.memory import keep_memory

T = TypeVar("T")


def add_jobs_option(parser: argparse.ArgumentParser) -> None:
    """Adds ``--jobs N``."""
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes that share the work (default: 1)")


@contextmanager
def one_thread() -> Iterator[None]:
    """Lets torch work in one thread, for operations so small that several would only wait for each other."""
    before = torch.get_num_threads()
    if before == 1:  # as in a thread that began while another was in here, whose number is not restored by this one
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def finished(work: Callable[..., T], parts: Sequence[tuple[Any, ...]], jobs: int) -> Iterator[tuple[int, T]]:
    """Calls ``work`` with the arguments of each part; a single job runs in this process.

    Args:
        work: a function of a module, as other processes import it by its name.
        parts: arguments; those of the longest first, so that all processes end together.
        jobs: how many processes share them, each of one thread.

    Yields:
        The number of a part and what it returned, as soon as it is done.

    Raises:
        Exception: what ``work`` raises first; parts that have not begun are left out.
        ChildProcessError: a process was killed, for example when memory ran out.
    """
    if jobs == 1:
        yield from enumerate(starmap(work, parts))
        return
    spawn = multiprocessing.get_context("spawn")  # a fork would copy the threads of torch in any state
    pool = ProcessPoolExecutor(min(jobs, max(len(parts), 1)), spawn, initializer=_as_worker)
    waiting, running = iter(enumerate(parts)), dict[Future[T], int]()
    try:
        while True:
            # Only one part for each process: Ctrl-C ends those, but not parts that wait in the pool's queue.
            for number, part in islice(waiting, jobs - len(running)):
                running[pool.submit(work, *part)] = number
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "jobs: expected processes that end by themselves, one was killed: out of memory?"
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _as_worker() -> None:
    """Gives a worker process one thread, and lets it end with the process that started it, even if that is killed."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    keep_memory()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

"""Work of many independent parts, on all processors: a process for each, of one thread."""

from __future__ import annotations

import argparse
import gc
import io
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice, starmap
from typing import Any, TypeVar

from torchfra.running.memory import keep_memory

T = TypeVar("T")
_CONTEXT = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
"""How processes start: a fork of this one would copy the threads of torch in any state, one of a server has none."""


def add_jobs_option(
    parser: argparse.ArgumentParser, default: int | None = 1, about: str = "processes that share the work (default: 1)"
) -> None:
    """Adds ``--jobs N``."""
    parser.add_argument("--jobs", type=int, default=default, metavar="N", help=about)


@contextmanager
def one_thread() -> Iterator[None]:
    """Lets torch work in one thread, for operations so small that several would only wait for each other."""
    import torch  # which takes a second, and which ``prepare`` does without

    before = torch.get_num_threads()
    if before == 1:  # as in a thread that began while another was in here, whose number is not restored by this one
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def cores() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def prepare(module: str) -> None:
    """Begins to import the module of what ``finished`` will run, once for all of its processes where the system allows.

    It takes seconds, in which this process can read a file.
    """
    if _CONTEXT.get_start_method() == "forkserver":
        from multiprocessing import forkserver, resource_tracker  # which not all systems have

        _CONTEXT.set_forkserver_preload([module])
        resource_tracker.ensure_running()  # which the server would begin with, and which unblocks the signal
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # it ends this process, and so its server
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def finished(work: Callable[..., T], parts: Sequence[tuple[Any, ...]], jobs: int) -> Iterator[tuple[int, T]]:
    """Calls ``work`` with the arguments of each part; a single job runs in this process.

    So do all where this is a daemonic process, which may not start others.

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
    if jobs == 1 or multiprocessing.current_process().daemon:
        yield from enumerate(starmap(work, parts))
        return
    prepare(getattr(work, "func", work).__module__)
    pool = ProcessPoolExecutor(min(jobs, max(len(parts), 1)), _CONTEXT, initializer=_as_worker)
    waiting, running = iter(enumerate(parts)), dict[Future[bytes], int]()
    try:
        while True:
            # Only one part for each process: Ctrl-C ends those, but not parts that wait in the pool's queue.
            for number, part in islice(waiting, jobs - len(running)):
                running[pool.submit(_pickled, work, *part)] = number
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), pickle.loads(future.result())
    except BrokenProcessPool as error:
        raise ChildProcessError(
            "jobs: expected processes that end by themselves, one was killed: out of memory, or a script without "
            'if __name__ == "__main__", which each process runs again?'
        ) from error
    finally:
        pool.shutdown(cancel_futures=True)


def _as_worker() -> None:
    """Gives a worker process one thread, and lets it end with the process that started it, even if that is killed."""
    import torch

    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # as the server has passed it on
    threading.Thread(target=_end_with_parent, daemon=True).start()
    gc.freeze()  # what has been imported stays
    torch.set_num_threads(1)
    keep_memory()


def _pickled(work: Callable[..., object], *part: Any) -> bytes:
    """What ``work`` returns, for another process."""
    file = io.BytesIO()
    _Pickler(file, pickle.HIGHEST_PROTOCOL).dump(work(*part))
    return file.getvalue()


class _Pickler(pickle.Pickler):
    """Sends tensors by their values, as plain ones on the CPU; torch would open a file for each of thousands."""

    def reducer_override(self, x: object) -> Any:
        import torch

        return (torch.from_numpy, (x.detach().numpy(),)) if isinstance(x, torch.Tensor) else NotImplemented


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

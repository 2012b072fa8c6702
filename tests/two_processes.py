"""Two processes that share their work as those of ``torchrun`` do, but forked: torch has been imported already."""

import contextlib
import multiprocessing
import os
import socket
import sys
import warnings

import pytest
import torch


def run_in_two(main, arguments, out=os.devnull):
    """Calls ``main`` in both, whose first writes what it prints to a file; both must succeed."""
    if torch.cuda.is_available() or "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("processes cannot be forked here")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    context = multiprocessing.get_context("fork")
    processes = [context.Process(target=_run, args=(rank, port, main, arguments, out)) for rank in range(2)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of pytest-xdist do nothing in the copies
        for process in processes:
            process.start()
    for process in processes:
        process.join(120)
    assert [process.exitcode for process in processes] == [0, 0]


def _run(rank, port, main, arguments, out):
    team = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": 2, "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    os.environ.update({name: str(value) for name, value in team.items()})
    with open(os.devnull if rank else out, "w") as file, contextlib.redirect_stdout(file):
        status = main(arguments)
    sys.exit(status or 0)

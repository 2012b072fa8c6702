"""Two processes that share their work, started as ``torchrun`` does, but forked: torch has been imported already."""

import contextlib
import multiprocessing
import os
import signal
import sys
import warnings

import pytest
import torch
import torch._dynamo  # noqa: F401  or each process imports it
from torch.distributed.launcher.api import LaunchConfig, elastic_launch


def forked(function, *arguments):
    """A process of its own that calls a function: a copy of this one, in which all has been imported already."""
    if torch.cuda.is_available() or "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("processes cannot be forked here")
    process = multiprocessing.get_context("fork").Process(target=_alone, args=(function, *arguments), daemon=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of pytest-xdist do nothing in the copy
        process.start()
    return process


def _alone(function, *arguments):
    torch.set_num_threads(1)  # those of the first process are not there
    sys.exit(function(*arguments))


def run_in_two(main, arguments, out=os.devnull):
    """Calls ``main`` in both, whose first writes what it prints to a file; both must succeed."""
    if torch.cuda.is_available() or "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("processes cannot be forked here")
    team = LaunchConfig(
        *(1, 1, 2), run_id="tests", rdzv_backend="c10d", rdzv_endpoint="localhost:0", start_method="fork",
        monitor_interval=0.05, local_addr="127.0.0.1",
    )  # fmt: skip
    with warnings.catch_warnings(), own_signals():
        warnings.simplefilter("ignore", DeprecationWarning)  # threads of pytest-xdist do nothing in the copies
        warnings.filterwarnings("ignore", "Unable to enable fault handler")  # where pytest has replaced stderr
        assert elastic_launch(team, _run)(main, arguments, out) == {0: 0, 1: 0}


def _run(main, arguments, out):
    torch.set_num_threads(1)  # those of the first process are not there
    with open(out if os.environ["RANK"] == "0" else os.devnull, "w") as file, contextlib.redirect_stdout(file):
        return main(arguments) or 0


@contextlib.contextmanager
def own_signals():
    """The launcher's handlers are gone when it has ended."""
    before = {number: signal.getsignal(number) for number in signal.valid_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            if signal.getsignal(number) != handler:
                signal.signal(number, handler)

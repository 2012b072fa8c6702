"""Work is shared among processes: all of it is done, each part once, and an error ends it."""

import math
import multiprocessing
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from torchfra.running.jobs import finished, one_thread


def test_every_part_is_done_and_comes_with_its_number():
    assert dict(finished(math.sqrt, [(4.0,), (9.0,), (16.0,)], 1)) == {0: 2.0, 1: 3.0, 2: 4.0}


def test_an_error_in_a_part_ends_the_work():
    with pytest.raises(ValueError, match="math domain error"):
        list(finished(math.sqrt, [(4.0,), (-1.0,), (4.0,)], 1))


@pytest.mark.slow
def test_parts_done_by_processes_have_their_numbers_and_after_an_error_none_begins(tmp_path):
    last, found = (f"open({str(tmp_path / 'begun')!r}, 'w')",), {}
    with pytest.raises(ZeroDivisionError):
        found.update(finished(eval, [("1 + 1",), ("2 + 2",), ("1 / 0",), ("1 / 0",), last], 2))
    assert found
    assert found.items() <= {0: 2, 1: 4}.items()
    assert not (tmp_path / "begun").exists()


WAITING = """
from torchfra.running.jobs import finished

if __name__ == "__main__":
    wait = "import time; print('begun', flush=True); time.sleep(600)"
    list(finished(exec, [(wait,), (wait,)], 2))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signal")
def test_processes_end_with_the_one_that_started_them_even_if_it_is_killed(tmp_path):
    (tmp_path / "waiting.py").write_text(WAITING)
    with subprocess.Popen([sys.executable, tmp_path / "waiting.py"], stdout=subprocess.PIPE) as process:
        assert [process.stdout.readline() for _ in range(2)] == [b"begun\n"] * 2
        process.kill()
        process.communicate(timeout=300)  # what they print to is closed when the last of them has ended


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signal")
def test_a_process_that_is_killed_is_said():
    with pytest.raises(ChildProcessError, match="jobs: expected processes that end by themselves, one was killed"):
        list(finished(exec, [("import os, signal; os.kill(os.getpid(), signal.SIGKILL)",)], 2))


def tensors(count):
    """Some tensors, of a process that may open few files."""
    import resource

    resource.setrlimit(resource.RLIMIT_NOFILE, (100, 100))
    return [torch.full((2,), float(i)) for i in range(count)]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such limit")
def test_tensors_come_from_a_process_by_value_and_open_no_files():
    ((_, found),) = finished(tensors, [(1000,)], 2)
    torch.testing.assert_close(torch.stack(found)[:, 0], torch.arange(1000.0))


def test_a_process_that_may_start_no_others_does_the_work_alone(monkeypatch):
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)
    assert dict(finished(math.sqrt, [(4.0,), (9.0,)], 2)) == {0: 2.0, 1: 3.0}


@pytest.mark.slow
def test_a_script_that_each_process_runs_again_is_said(tmp_path):
    (tmp_path / "again.py").write_text(WAITING.replace('if __name__ == "__main__":', "if True:"))
    ended = subprocess.run([sys.executable, tmp_path / "again.py"], capture_output=True, text=True, timeout=300)
    assert ended.stderr.splitlines()[-1].startswith(
        "ChildProcessError: jobs: expected processes that end by themselves"
    )
    assert 'if __name__ == "__main__"' in ended.stderr.splitlines()[-1]
    assert not ended.stdout


# ---------------------------------------------------------------- threads


def threads_of_a_new_one():
    """The number of threads of torch in a thread that begins now."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(torch.get_num_threads).result()


def test_a_thread_that_begins_while_torch_has_one_leaves_the_number_as_it_was():
    before, over = torch.get_num_threads(), threading.Event()

    def work(begun):
        with one_thread():
            begun.set()
            over.wait(60)

    torch.set_num_threads(2)
    try:
        with ThreadPoolExecutor(1) as pool:
            with one_thread():
                pool.submit(work, begun := threading.Event())
                assert begun.wait(60)
            over.set()
        assert (torch.get_num_threads(), threads_of_a_new_one()) == (2, 2)
    finally:
        torch.set_num_threads(before)


def test_an_error_leaves_the_number_of_threads_as_it_was():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        with pytest.raises(ZeroDivisionError), one_thread():
            1 / 0  # noqa: B018
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.skipif(sys.platform != "linux", reason="others import nothing ahead")
def test_ctrl_c_leaves_what_they_import_to_the_end_of_this_process(tmp_path):
    (tmp_path / "slow.py").write_text(
        "import pathlib, time\n"
        "pathlib.Path('begun').touch()\n"
        "while not pathlib.Path('pressed').exists(): time.sleep(0.01)\n"
        "pathlib.Path('done').touch()\n"
    )
    code = (
        "import os, pathlib, signal, time\n"
        "from torchfra.running.jobs import prepare\n"
        "signal.signal(signal.SIGINT, lambda *_: None)\n"
        "prepare('slow')\n"
        "while not pathlib.Path('begun').exists(): time.sleep(0.01)\n"
        "os.killpg(0, signal.SIGINT)\n"
        "pathlib.Path('pressed').touch()\n"
        "for _ in range(3000):\n"
        "    if pathlib.Path('done').exists(): break\n"
        "    time.sleep(0.01)\n"
    )
    paths = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=os.environ | {"PYTHONPATH": paths}, capture_output=True,
        start_new_session=True, check=True,
    )  # fmt: skip
    assert (tmp_path / "done").exists()
    assert not done.stderr

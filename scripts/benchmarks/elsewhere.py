"""Peers, each in a process of its own that waits while others are timed.

In the process of torch they would share its threads, and be slower than they are.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfra.scenarios import Scenario, Tracks

WORKER = Path(__file__).parent.parent / "peers.py"
LIMIT = Path(__file__).parent.parent / "limit.cpp"
PEERS = {
    "jax": "JAX, hand-written SRCKF", "dynamax": "dynamax UKF", "cuthbert": "cuthbertlib CKF",
    "kalman-py": "kalman-py UKF", "filterpy": "FilterPy UKF", "pykalman": "pykalman UKF", "stonesoup": "Stone Soup CKF",
}  # fmt: skip
"""Names of ``peers.py`` on bearings, and what rows call them."""
LINEAR = {
    "dynamax": "dynamax", "dynamax-one": "dynamax, one covariance for all", "cuthbert": "cuthbert",
    "kalman-py": "kalman-py", "kalman-py-vmap": "kalman-py, inside, vmap", "simdkalman": "simdkalman",
    "torch-kf": "torch-kf", "filterpy": "FilterPy", "pykalman": "pykalman", "stonesoup": "Stone Soup",
}  # fmt: skip
"""Peers for linear sensors: Kalman filters."""
IN_TURN = ("kalman-py", "filterpy", "pykalman", "stonesoup")
"""Peers that filter one track after the other, with a constant time per track."""
AT_ONCE = ("dynamax-one", "kalman-py-vmap")
"""Peers for several tracks, other than those of their package for one."""
LEARNERS = ("jax", "dynamax")
"""Peers that learn."""
SIMD = "hand-written SIMD C++ SRCKF"
LANES = 8
"""Number of tracks of one vector in ``limit.cpp``."""
SETTLE = 0.1
"""Seconds between processes: the threads of the last one wait actively for some milliseconds before they sleep."""


class Peer:
    """A process that times a call for each line that it reads.

    Args:
        command: what to run; it prints a JSON line with ``first_call_s`` when it is ready, or with ``missing``, and
            one with ``seconds`` for each pass.
        saved: file of the last means that it writes, if it does.

    Raises:
        ImportError: the process misses a package.
    """

    def __init__(self, command: list[str], saved: Path | None = None) -> None:
        self.saved = saved
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.ready = self._answer()
        if "missing" in self.ready:
            self.close()
            raise ImportError(self.ready["missing"])

    def first_call(self) -> float:
        """Seconds of the first call."""
        return float(self.ready["first_call_s"])

    def one_pass(self) -> float:
        """Seconds per call, in one pass, while this process sleeps."""
        assert self.process.stdin is not None
        time.sleep(SETTLE)
        print(file=self.process.stdin, flush=True)
        seconds = float(self._answer()["seconds"])
        time.sleep(SETTLE)
        return seconds

    def means(self) -> np.ndarray | None:
        """Last means ``(B, n)`` of the tracks, if the process writes them."""
        return None if self.saved is None else np.load(self.saved)

    def close(self) -> None:
        """Ends the process."""
        self.process.communicate()

    def _answer(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise OSError(f"{' '.join(map(str, self.process.args))} ended with {self.process.wait()}")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextmanager
def start_peers(scenario: Scenario, tracks: Tracks) -> Iterator[dict[str, Peer]]:
    """The peers that are installed, on these tracks, by the name in the rows; says which are missing."""
    batch = len(tracks.z)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        job = Path(folder) / "job.npz"
        np.savez(job, **job_arrays(scenario, tracks))
        peers: dict[str, Peer] = {}
        linear = scenario.sensor.linear
        for name, label in (LINEAR if linear else PEERS).items():
            if name not in (IN_TURN if batch > 1 else AT_ONCE):
                means = Path(folder) / f"{name}.npy"
                start(peers, stack, name, label, [str(job), "--means", str(means)], means)
        program = build_limit(Path(folder)) if batch >= LANES and not linear else None
        if program is not None:
            peers[SIMD] = Peer([str(program), str(batch)])
            stack.callback(peers[SIMD].close)
        yield peers


@contextmanager
def start_learners(
    scenario: Scenario, tracks: Tracks, features: Tensor, rate: float, weights: Sequence[np.ndarray]
) -> Iterator[dict[str, Peer]]:
    """Peers that learn a network in front of their filter: see ``benchmarks.layer``."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        job = Path(folder) / "job.npz"
        peers: dict[str, Peer] = {}
        given = {f"weight{i}": weight for i, weight in enumerate(weights)}
        arrays = {"features": features.numpy(), "truth": tracks.truth.numpy(), "rate": np.array(rate), **given}
        np.savez(job, **job_arrays(scenario, tracks), **arrays)
        for name in LEARNERS:
            start(peers, stack, name, PEERS[name], [str(job)])
        yield peers


def start(
    peers: dict[str, Peer], stack: ExitStack, name: str, label: str, arguments: list[str], saved: Path | None = None
) -> None:
    """Adds a peer, which ends with the stack; says if it is not installed."""
    python = os.environ.get("TORCHFRA_PEERS_PYTHON", sys.executable)
    try:
        peers[label] = Peer([python, str(WORKER), name, *arguments], saved)
    except ImportError as missing:
        print(f"{label}: not installed ({missing}): pip install 'torchfra[bench]'")
    else:
        stack.callback(peers[label].close)


def job_arrays(scenario: Scenario, tracks: Tracks) -> dict[str, np.ndarray]:
    """The job as a peer reads it."""
    dt, sensor = torch.tensor(scenario.dt, dtype=torch.float64), scenario.sensor
    arrays = {
        "matrix": scenario.motion.transition(dt), "noise": scenario.motion.process_noise(dt),
        "means": tracks.prior.mean, "root": tracks.prior.scale_tril, "z": tracks.z, "dt": dt,
    }  # fmt: skip
    if tracks.u is not None:
        arrays |= {"std": sensor.std(), "u": tracks.u}
    else:
        unit = torch.eye(scenario.motion.size, dtype=torch.float64)
        arrays |= {"std": sensor.measurement_noise(tracks.z[0, 0]).std, "sensor": sensor(unit).mT}
    return {key: x.detach().numpy() for key, x in arrays.items()}


def build_limit(folder: Path) -> Path | None:
    """The program of ``limit.cpp``; None without a compiler."""
    program = folder / "limit"
    command = [os.environ.get("CXX", "g++"), "-O3", "-march=native", "-ffast-math", "-fopenmp"]
    try:
        subprocess.run([*command, str(LIMIT), "-o", str(program)], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        print(f"{SIMD}: not built, no C++ compiler")
        return None
    return program

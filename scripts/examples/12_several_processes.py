"""Several processes share each batch: a plain PyTorch loop, and ``torchfra.fit``, under torchrun.

You learn that both need nothing but a process group: gradients are averaged, or ``fit`` does it by itself, to the same
values as one process.

    torchrun --nproc-per-node 2 scripts/examples/12_several_processes.py
"""

import argparse

import torch
from torch import distributed
from torch.nn.parallel import DistributedDataParallel

import torchfra
from torchfra import losses, presets, scenarios
from torchfra.running.distributed import rank, share, team
from torchfra.scenarios import Scenario


def loop(scenario: Scenario, iterations: int, tracks: int) -> dict[str, float]:
    """A loop of one's own: each process takes its share of the tracks, and DistributedDataParallel averages."""
    f = presets.rsrckf(scenario.motion, scenario.sensor, threshold=4.0, learn=("threshold", "std"))
    model = DistributedDataParallel(f) if distributed.is_initialized() else f
    optimiser = torch.optim.Adam(f.parameters(), lr=0.1)
    for i in range(iterations):
        mine = share(tracks)
        batch = scenario.simulate(len(mine), seed=0, first=i * tracks + mine.start)
        loss = losses.innovation_nll(model(batch.z, batch.prior, u=batch.u)).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return {"threshold": f.robust.threshold().item(), "std": f.sensor.std().item()}


def main(arguments: list[str] | None = None) -> None:
    """Learns the same values in both ways; the first process prints them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=20, help="of descent (default: 20)")
    parser.add_argument("--tracks", type=int, default=16, help="tracks of an iteration (default: 16)")
    options = parser.parse_args(arguments)
    scenario = scenarios.bearings_outliers("std", initial="truth")
    with team():
        torch.set_num_threads(1)
        values = loop(scenario, options.iterations, options.tracks)
        f = presets.rsrckf(scenario.motion, scenario.sensor, threshold=4.0)
        fitted = torchfra.fit(f, scenario, learn=("threshold", "std"), loss="likelihood", runs=4 * options.tracks,
                              iterations=options.iterations, batch=options.tracks, polish=False)  # fmt: skip
        if rank() == 0:
            print("loop " + ", ".join(f"{name} {value:.10g}" for name, value in values.items()))
            print("fit " + ", ".join(f"{name} {value:.10g}" for name, value in fitted.learned.items()))


if __name__ == "__main__":
    main()

"""Learning: gradient descent through a filter finds its threshold and its process noise.

You learn how to make hyperparameters learnable, which loss to choose, and to judge on tracks that training never saw.

    python scripts/examples/02_learning.py --iterations 60
"""

import argparse

import torch

import torchfra
from torchfra import losses, metrics, presets, scenarios
from torchfra.motion import ConstantAcceleration


def main(arguments: list[str] | None = None) -> None:
    """Trains a robust filter that starts from a bad threshold and a bad process noise."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--iterations", type=int, default=20, help="steps of Adam (default: 20)")
    parser.add_argument("--tracks", type=int, default=32, help="tracks in each (default: 32)")
    parser.add_argument("--steps", type=int, default=40, help="measurements of a track, up to 100 (default: 40)")
    options = parser.parse_args(arguments)

    scenario = scenarios.bearings_outliers("std", initial="truth")  # outliers of ten standard deviations

    def simulate(runs: int, seed: int, first: int = 0):
        tracks = scenario.simulate(runs, seed, first=first)
        return tracks.z[:, : options.steps], tracks.prior, tracks.u[: options.steps], tracks.truth[:, : options.steps]

    # learn= names what gradient descent may change, wherever it is: threshold of the weights, q of the motion.
    f = presets.rsrckf(ConstantAcceleration(q=1.0), scenario.sensor, threshold=4.0, learn=("threshold", "q"))
    torchfra.summary(f)  # f.compile() pays where it learns for more than half a minute
    z, prior, u, truth = simulate(200, seed=1)
    with torch.no_grad():
        before = metrics.rmse(f(z, prior, u=u).mean, truth, scenario.position).mean()

    optimiser = torch.optim.Adam(f.parameters(), lr=0.3)  # in unconstrained coordinates: steps of some 30 %
    for i in range(options.iterations):
        z, prior, u, truth = simulate(options.tracks, seed=0, first=i * options.tracks)  # new tracks every time
        # One track that diverges would dominate the mean square error; the robust form is bounded for each track.
        loss = losses.robust_mse(f(z, prior, u=u).mean, truth, scenario.position, scale=100.0).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if i % 5 == 4:
            values = f"threshold {f.robust.threshold():.3f}, q {f.motion.q():.4f}"
            print(f"iteration {i + 1:>3}: loss {loss.item():.4f}, {values}")

    z, prior, u, truth = simulate(200, seed=1)
    with torch.no_grad():
        after = metrics.rmse(f(z, prior, u=u).mean, truth, scenario.position).mean()
    print(f"position RMSE on 200 unseen tracks: {before:.1f} m before, {after:.1f} m after")


if __name__ == "__main__":
    main()

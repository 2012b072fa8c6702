"""A first filter: simulate tracks, filter them, measure the error.

You learn what a scenario holds, what a filter takes and returns, and what robust, adaptive filtering gains where
sensors have outliers and the first guess is wrong.

    python scripts/examples/01_first_filter.py --plot first.png
"""

import argparse
from pathlib import Path

import torch

from torchfra import metrics, presets, scenarios


def main(arguments: list[str] | None = None) -> None:
    """Three filters on the same tracks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="tracks (default: 20)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw the first track")
    options = parser.parse_args(arguments)

    # Two moving stations measure bearings of one target.  The initial state that filters get is 2.5 km off.
    scenario = scenarios.bearings_outliers()
    tracks = scenario.simulate(options.runs, seed=0)
    print(f"truth {tuple(tracks.truth.shape)}: runs, steps, states [x, y, vx, vy, ax, ay]")
    print(f"z     {tuple(tracks.z.shape)}: runs, steps, bearings in rad")
    print(f"u     {tuple(tracks.u.shape)}: steps, positions of the two stations in m")

    filters = {
        "srckf, a plain cubature Kalman filter": presets.srckf(scenario.motion, scenario.sensor),
        "rsrckf, with Huber weights": presets.rsrckf(scenario.motion, scenario.sensor),
        "fra, robust or adaptive as needed": presets.fra(scenario.motion, scenario.sensor),
    }
    estimates = {}
    for name, f in filters.items():
        with torch.no_grad():
            estimates[name] = f(tracks.z, tracks.prior, u=tracks.u, dt=scenario.dt)
        rmse = metrics.rmse(estimates[name].mean, tracks.truth, scenario.position)  # (steps,)
        print(f"{name:<38} position RMSE {rmse.mean():7.1f} m, at the last step {rmse[-1]:7.1f} m")

    # An estimate is a Gaussian for each step, with the scores of its measurement.
    estimate = estimates["fra, robust or adaptive as needed"]
    (x, y), std = estimate.mean[0, -1, :2], estimate.scale_tril[0, -1].square().sum(-1).sqrt()
    print(f"last position of run 0: {x:.0f}, {y:.0f} m, standard deviations {std[0]:.0f}, {std[1]:.0f} m")
    print(f"largest normalised innovation squared: {estimate.nis[0].max():.0f} at step {estimate.nis[0].argmax() + 1}")

    if options.plot:
        from torchfra import plotting  # needs matplotlib, so only here

        paths = {name.split(",")[0]: estimate.mean[0] for name, estimate in estimates.items()}
        print(plotting.save(plotting.tracks(tracks.truth[0], paths, "run 0", tracks.u), options.plot))


if __name__ == "__main__":
    main()

"""Several targets: scans of measurements without labels, some of them false.

You learn what JPDA filters take and return, and how to compare estimates in modified spherical coordinates with a
Cartesian truth.
"""

import argparse

import torch

from torchfra import metrics, presets, scenarios


def main(arguments: list[str] | None = None) -> None:
    """Two aircraft that cross among false measurements, while the measurement noise becomes four times larger."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=20, help="simulated runs (default: 20)")
    options = parser.parse_args(arguments)

    scenario = scenarios.clutter_crossing(noise_scale=4.0)
    tracks = scenario.simulate(options.runs, seed=0)
    print(f"truth {tuple(tracks.truth.shape)}: runs, targets, steps, states [x, y, z, vx, vy, vz]")
    print(f"z     {tuple(tracks.z.shape)}: runs, steps, measurements in any order, [azimuth, elevation, range]")

    # Both assume the measurement noise before the change; the second estimates it while it filters.
    filters = {
        "ukf_jpda": presets.ukf_jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter),
        "iaukf_jpda": presets.iaukf_jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter),
    }
    for name, f in filters.items():
        with torch.no_grad():
            estimate = f(tracks.z, tracks.prior, dt=scenario.dt)  # mean (runs, targets, steps, 6)
        cartesian = scenario.cartesian(estimate)  # the coordinates of the truth
        error = metrics.error(cartesian.mean, tracks.truth, scenario.truth_position)  # (runs, targets, steps), m
        of_run = error[..., 10:].square().mean((1, 2)).sqrt()
        print(f"{name:<11} position RMSE of a run: median {of_run.median():5.1f} m, largest {of_run.max():6.1f} m")

    # Association probabilities: missed, then one for each measurement of the scan.
    at = 43  # the aircraft meet
    print(f"run 0, scan {at + 1}, the targets are "
          f"{(tracks.truth[0, 0, at, :3] - tracks.truth[0, 1, at, :3]).norm():.0f} m apart")  # fmt: skip
    for target, (missed, *measured) in enumerate(estimate.info.association[0, :, at].tolist(), 1):
        shares = " ".join(f"{share:.2f}" for share in measured)
        print(f"  target {target}: missed {missed:.2f}, measurements {shares}")


if __name__ == "__main__":
    main()

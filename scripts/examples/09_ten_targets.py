"""Ten targets that appear and disappear among false measurements; their number is not known.

You learn how to put a manager of targets around a filter of scans, one scan after the other, and how to see what became
of every target.
"""

import argparse

import torch

from torchfra import metrics, presets, scenarios
from torchfra.association import ChiSquare
from torchfra.targets import SPRT, Deletion, Merging, Targets, TwoPoint, collect


def main(arguments: list[str] | None = None) -> None:
    """Follows all aircraft of a scenario; prints confirmations and deletions, and how well each was followed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of the simulation (default: 0)")
    options = parser.parse_args(arguments)

    scenario = scenarios.clutter_many(count=10, clutter=30)
    tracks = scenario.simulate(1, options.seed)
    truth, scans = tracks.truth[0], tracks.z[0]  # (10, 100, 6), NaN where one is not there, and (100, 40, 3)

    f = presets.jpda(scenario.motion, scenario.sensor, clutter=scenario.clutter, detection=scenario.detection,
                     gate=ChiSquare(0.99999))  # fmt: skip
    targets = Targets(
        f,
        birth=TwoPoint(speed=80.0),  # two unassociated measurements in a row
        confirmation=SPRT(false=1e-4, missed=1e-2),  # by the likelihood ratio of what came since
        deletion=Deletion(misses=4),
        merging=Merging(),
    )

    states, there = [targets.init()], set()
    with torch.no_grad():
        for k, scan in enumerate(scans):
            states.append(targets.step(states[-1], scan, dt=scenario.dt))
            now = set(states[-1].identity.tolist())
            for word, who in (("confirmed", now - there), ("deleted", there - now)):
                print("".join(f"scan {k:3d}: target {identity} {word}\n" for identity in sorted(who)), end="")
            there = now

    estimate = scenario.cartesian(collect(states[1:]))  # mean (K, 100, 6), NaN where a target is not there
    lives = metrics.lives(estimate.mean, truth, scenario.truth_position)
    for i in range(len(truth)):
        print(f"aircraft {i}: there for {lives.length[i]:3d} scans, followed for {lives.followed[i]:3d}, found after "
              f"{lives.begun[i]:.0f}, switches {lives.switches[i]}")  # fmt: skip
    gospa = metrics.gospa(estimate.mean, truth, scenario.truth_position)
    found = f"{len(estimate.mean)} targets found, {lives.false_tracks} of them false"
    print(f"{found}; GOSPA {gospa.distance.mean():.1f} m")


if __name__ == "__main__":
    main()

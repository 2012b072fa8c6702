"""Two boats in a harbour, measured by radar, lidar and a camera from a ferry, among buoys that look like boats.

You learn how several sensors track the same targets, each with its own reach and rate, and how a map of clutter learns
what stays where it is.
"""

import argparse

import torch

from torchfra import metrics, presets
from torchfra.association import ChiSquare, Clutter
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Bearings, Position
from torchfra.targets import ClutterMap, FieldOfView, OnePoint, Targets, collect

FULL_CIRCLE = 6.283


def main(arguments: list[str] | None = None) -> None:
    """Simulates the harbour and follows the boats; prints how well, for each set of sensors."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of the simulation (default: 0)")
    rng = torch.Generator().manual_seed(parser.parse_args(arguments).seed)

    def noise(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng).double()

    time = torch.arange(60).double()
    ferry = torch.stack([0.5 * time, 0 * time], -1)  # (60, 2), m
    boats = torch.stack([torch.stack([3 * time - 80, 40 + 0 * time], -1), torch.stack([60 - time, 2 * time - 90], -1)])
    buoys = 300 * torch.rand(8, 1, 2, generator=rng).double() - 150
    off = boats - ferry
    z = {
        None: torch.cat([boats, buoys.expand(-1, 60, 2)]) + 4 * noise(10, 60, 2),  # radar
        "lidar": (boats + noise(2, 60, 2)).where(off.norm(dim=-1, keepdim=True) < 60, torch.nan),  # NaN: no measurement
        "camera": torch.atan2(off[..., :1], off[..., 1:]) + 0.01 * noise(2, 60, 1),
    }

    motion, gate = ConstantVelocity(0.3, continuous=True), ChiSquare(0.99999)
    radar, lidar, camera = (
        presets.jpda(motion, sensor, clutter=clutter, detection=0.9, gate=gate)
        for sensor, clutter in (
            (Position(4.0), Clutter(300**2, rate=0.5)),
            (Position(1.0), Clutter(300**2, rate=0.1)),
            (Bearings(0.01, count=1), Clutter(extent=[FULL_CIRCLE], rate=0.1)),
        )
    )
    for others in ({}, {"lidar": lidar}, {"lidar": lidar, "camera": camera}):
        views = {"lidar": FieldOfView(60.0)} if others else None  # around the ferry, which ``u`` tells
        targets = Targets(radar, birth=OnePoint(5.0), sensors=others, views=views, clutter_map=ClutterMap(4.0, 60.0))
        state, states = targets.init(), []
        with torch.no_grad():
            for k in range(60):
                for name in (None, *others):  # all at one instant, one after the other
                    dt = 0.0 if name else 1.0
                    state = targets.step(state, z[name][:, k], dt=dt, u=ferry[k], sensor=name)
                states.append(state)
        estimate = collect(states)
        lives = metrics.lives(estimate.mean, boats, slice(0, 2), cutoff=20.0)
        gospa = metrics.gospa(estimate.mean, boats, slice(0, 2), cutoff=20.0).distance.mean()
        share = (lives.followed / lives.length).mean()
        print(f"{' + '.join(['radar', *others])}: boats followed {100 * share:.0f} % of the time, "
              f"{lives.false_tracks:.0f} false tracks, GOSPA {gospa:.1f} m")  # fmt: skip


if __name__ == "__main__":
    main()

"""Fusion: a radar and a camera on one track, whose measurements come late and out of turn.

You learn how a ``Tracker`` takes measurements of several sensors by their names and times, that those which come late
are put in where they belong, what it expects of a sensor, and how a track is saved and goes on.
"""

import argparse
import random
import tempfile
from pathlib import Path

import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Camera, RangeBearing, facing
from torchfra.stream import Tracker

F64 = {"dtype": torch.float64}
RADAR = RangeBearing(torch.tensor([5.0, 0.01, 0.01], **F64), dims=3)  # m, rad, rad; it stands at the origin
PLACE = torch.tensor([600.0, -50.0, 20.0], **F64)
CAMERA = Camera(1000.0, 1.5, position=PLACE, rotation=facing(PLACE, [350.0, 500.0, 100.0]))  # pixels
SENSORS = {"radar": RADAR, "camera": CAMERA}


def truth(time: float) -> torch.Tensor:
    """Where a drone is, that flies a wide turn, m."""
    angle = torch.tensor(0.05 * time, **F64)
    return torch.stack([350 + 200 * angle.cos(), 500 + 200 * angle.sin(), 100 + 20 * (2 * angle).sin()])


def simulate(seconds: float) -> list[tuple[float, float, str, torch.Tensor]]:
    """When each measurement comes in, when it was taken, by which sensor, and what it says."""
    rng, noise, events = random.Random(0), torch.Generator().manual_seed(0), []
    for name, period, delay in (("radar", 0.5, 0.0), ("camera", 0.4, 1.0)):  # images take a while to read
        sensor, time = SENSORS[name], 0.0
        while (time := time + period * rng.uniform(0.5, 1.5)) < seconds:
            z = sensor(truth(time)) + sensor.std() * torch.randn(sensor.size, generator=noise, **F64)
            events.append((time + delay * rng.uniform(0.5, 1.0), time, name, z))
    return sorted(events, key=lambda event: event[0])


def main(arguments: list[str] | None = None) -> None:
    """The drone by the radar alone, by both in the order they come, and by both where they belong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of the flight (default: 20)")
    events = simulate(parser.parse_args(arguments).seconds)

    f = presets.gpb(ConstantVelocity(q=4.0, dims=3, continuous=True), RADAR)
    start = torch.cat([truth(0.0) + 20, torch.zeros(3, **F64)])
    prior = Gaussian(start, torch.tensor([30.0, 30.0, 30.0, 15.0, 15.0, 15.0], **F64).diag())
    ways = {"radar alone": (0.0, ["radar"]), "late ones left out": (0.0, [*SENSORS]), "all": (1.0, [*SENSORS])}
    for way, (lag, names) in ways.items():
        tracker = Tracker(f, prior, sensors=SENSORS, lag=lag, old="count")
        errors = []
        for now, time, name, z in events:
            if name in names:
                tracker.update(time, z, name)
            there = tracker.predict(max(now, tracker.time), "camera").belief.mean[:3]  # where it is by now
            errors.append((there - truth(now)).square().sum())
        rmse = torch.stack(errors[len(errors) // 5 :]).mean().sqrt()
        print(f"{way:20s} RMSE {rmse:5.1f} m  {tracker.counts}")

    pixel = tracker.predict(tracker.time + 1.0, "camera").measurement  # where in the image to look next
    column, row = pixel.mean.tolist()
    print(f"in a second at pixel {column:.0f}, {row:.0f}, to {pixel.covariance.diagonal().max().sqrt():.1f}")
    with tempfile.TemporaryDirectory() as folder:
        torch.save(tracker.state_dict(), Path(folder) / "track.pt")
        again = Tracker(f, prior, sensors=SENSORS, lag=1.0, old="count")
        again.load_state_dict(torch.load(Path(folder) / "track.pt", weights_only=True))
    print(f"saved and loaded, the same to the last bit: {torch.equal(again.belief.mean, tracker.belief.mean)}")


if __name__ == "__main__":
    main()

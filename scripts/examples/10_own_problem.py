"""A problem of your own: your simulator, your sensor, recorded tracks without any truth; fitted, judged, compared.

You learn how ``torchfra.fit`` finds noise levels from measurements, and whether another filter predicts them better.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torchfra
from torchfra import presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Sensor

Q, STD = 0.2, (1.0, 0.02)  # what made the tracks: (m/s^2)^2, dB, rad


class Beacon(Sensor):
    """Strength of a beacon's signal at a station in the origin, dB, and its bearing clockwise from +y, rad."""

    locates = True

    def __init__(self, std) -> None:
        super().__init__(reads=2, angles=[False, True], std=torch.tensor(std))

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """Measurements ``(..., 2)`` of states ``(..., 2 or more)``."""
        strength = -20 / math.log(10) * torch.hypot(x[..., 0], x[..., 1]).log()
        return torch.stack([strength, torch.atan2(x[..., 0], x[..., 1])], -1)

    def locate(self, z: Tensor) -> Tensor:
        """Where the beacon is ``(..., 2)``, from which tracks begin that have no prior."""
        return 10 ** (-z[..., :1] / 20) * torch.stack([z[..., 1].sin(), z[..., 1].cos()], -1)


def record(folder: Path, tracks: int) -> None:
    """A simulator: beacons that drift by, measured at irregular times, 3 % of it badly; one file for each."""
    rng = np.random.default_rng(0)
    for number in range(tracks):
        place, velocity, rows = rng.normal((0, 1000), 200, 2), rng.normal(0, 5, 2), []
        for time in np.cumsum(rng.uniform(0.5, 1.5, rng.integers(40, 60))):
            dt = time - (rows[-1][0] if rows else 0)
            push = math.sqrt(Q) * rng.normal(size=2)
            place, velocity = place + velocity * dt + push * dt**2 / 2, velocity + push * dt
            noise = STD * rng.normal(size=2) * (6 if rng.random() < 0.03 else 1)
            strength, bearing = -20 * math.log10(math.hypot(*place)), math.atan2(*place)
            rows.append((time, strength + noise[0], bearing + noise[1]))
        np.savetxt(folder / f"track-{number:03}.csv", rows, delimiter=",", header="t,strength,bearing")


def main(arguments: list[str] | None = None) -> None:
    """Records tracks into files, reads them, and learns from them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tracks", type=int, default=200, help="how many (default: 200)")
    parser.add_argument("--out", type=Path, default=Path("out/own"), help="folder of tracks and results")
    parser.add_argument("--iterations", type=int, default=200, help="of descent (default: 200)")
    parser.add_argument(
        "--compile", action=argparse.BooleanOptionalAction, help="run kernels (default: where possible)"
    )
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    record(options.out, options.tracks)

    files = [torch.from_numpy(np.loadtxt(file, delimiter=",")) for file in sorted(options.out.glob("track-*.csv"))]
    data = [{"z": rows[:, 1:], "dt": rows[:, 0].diff(prepend=rows[:1, 0] - 1)} for rows in files]
    motion, sensor = ConstantVelocity(q=1.0), Beacon((3.0, 0.06))  # guesses: a factor 3 to 5 off
    how = {"learn": ("q", "std"), "iterations": options.iterations}
    plain, robust = (torchfra.fit(f(motion, sensor), data, **how) for f in (presets.srckf, presets.gpb))
    print(f"made with q {Q} (gpb has levels of its own to multiply it by), std {STD}\n")
    print(f"srckf\n{plain}\n\ngpb\n{robust}\n")
    print(robust.compare({"srckf": plain, "gpb before": presets.gpb(motion, sensor)}))
    robust.to_json(options.out / "gpb.json"), robust.plot(options.out / "gpb.png")


if __name__ == "__main__":
    main()

"""Streaming: one measurement at a time, with gaps and uneven time steps.

You learn the loop around ``init`` and ``step``, that NaN marks what was not measured, that ``dt`` may differ from step
to step, and that one call on the entire track gives the same estimates.  Where measurements come late, twice or from
several sensors, a ``Tracker`` keeps the times: see the seventh example.
"""

import argparse

import torch

from torchfra import Gaussian, presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import RangeBearing


def main(arguments: list[str] | None = None) -> None:
    """A boat seen by a radar that sometimes loses the bearing, and sometimes sees nothing at all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=20, help="steps of the track, 12 or more (default: 20)")
    steps = max(parser.parse_args(arguments).steps, 12)

    rng, like = torch.Generator().manual_seed(0), {"dtype": torch.float64}
    radar = RangeBearing(torch.tensor([10.0, 0.01], **like))  # m, rad
    f = presets.rsrckf(ConstantVelocity(q=0.01), radar)  # Huber weights: outliers lose influence

    dt = 0.5 + 2 * torch.rand(steps, generator=rng, **like)  # seconds since the measurement before
    time = dt.cumsum(0).unsqueeze(-1)
    truth = torch.tensor([1000.0, 2000.0], **like) + time * torch.tensor([8.0, -5.0], **like)
    z = radar(truth) + radar.std() * torch.randn(steps, 2, generator=rng, **like)
    z[4, 1] = torch.nan  # a range without its bearing: the range is used
    z[6:9] = torch.nan  # nothing: these steps only predict
    z[11, 0] += 300.0  # an outlier

    spread = torch.tensor([100.0, 100.0, 10.0, 10.0], **like)
    prior = Gaussian(torch.tensor([1050.0, 1950.0, 0.0, 0.0], **like), spread.diag())
    state = f.init(prior)  # the belief one dt before the first measurement
    means = []
    print(" time, s   range, m  bearing, rad   error, m  std, m    NIS")
    for k in range(steps):
        with torch.no_grad():
            state, innovation = f.step(state, z[k], dt=dt[k])  # the state before is not changed: steps can be tried
        belief = state.belief
        means.append(belief.mean)
        error = (belief.mean[:2] - truth[k]).norm()
        std = belief.scale_tril[:2].square().sum().sqrt()
        print(f"{time[k].item():8.1f} {z[k, 0]:10.1f} {z[k, 1]:13.4f} {error:10.1f} {std:7.1f} {innovation.nis:6.1f}")

    with torch.no_grad():
        estimate = f(z, prior, dt=dt)  # z (T, m), dt (T,): the same loop in one call
    print(f"largest difference from one call: {(torch.stack(means) - estimate.mean).abs().max():.1e}")


if __name__ == "__main__":
    main()

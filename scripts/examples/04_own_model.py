"""A motion and a sensor of your own: a turn of unknown rate, seen by a Doppler radar.

You learn what a ``Motion`` and a ``Sensor`` have to provide: plain tensor code whose last dimension holds states or
measurements; all in front of it broadcasts.  Gradients and every preset follow; ``check_model`` says what is wrong.
"""

import argparse
import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchfra import Gaussian, Hyper, check_model, metrics, presets
from torchfra.motion import ConstantVelocity, Motion
from torchfra.sensors import Sensor


class UnknownTurn(Motion):
    """States ``[x, y, vx, vy, rate]``: the velocity turns by ``rate``, rad/s, which drifts by ``drift`` rad/s per s."""

    def __init__(self, q: float, drift: float) -> None:
        super().__init__(dims=2, orders=2, q=q, size=5, components=("x", "y", "vx", "vy", "rate"))
        self.drift = Hyper(drift, name="drift")  # constrained to be positive; learn="drift" would learn it

    def forward(self, x: Tensor, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The state ``(..., 5)`` after ``dt (...)`` seconds.  A motion that is linear gives ``transition`` instead."""
        vx, vy, turn = x[..., 2], x[..., 3], x[..., 4] * dt
        along = dt * torch.sinc(turn / math.pi)  # sin(turn) / rate, also where the rate is 0
        across = dt * (turn / 2) * torch.sinc(turn / (2 * math.pi)).square()
        position = (x[..., 0] + along * vx - across * vy, x[..., 1] + across * vx + along * vy)
        velocity = (turn.cos() * vx - turn.sin() * vy, turn.sin() * vx + turn.cos() * vy)
        return torch.stack([*position, *velocity, x[..., 4].expand_as(turn)], -1)

    def process_noise(self, dt: Tensor) -> Tensor:
        """A root ``(..., 5, 3)`` of its covariance: accelerations along x and y, and the drift of the rate."""
        drift = (self.drift(dt) * dt)[..., None, None]
        return pad(super().process_noise(dt), (0, 1, 0, 1)) + pad(drift, (2, 0, 4, 0))


class DopplerRadar(Sensor):
    """Range, m, bearing clockwise from +y, rad, and range rate, m/s."""

    def __init__(self, std: Tensor) -> None:
        super().__init__(reads=4, angles=[False, True, False], std=std)  # residuals of angles wrap

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """Measurements ``(..., 3)`` of states ``(..., 4 or more)``."""
        distance = torch.hypot(x[..., 0], x[..., 1])
        rate = (x[..., 0] * x[..., 2] + x[..., 1] * x[..., 3]) / distance
        return torch.stack([distance, torch.atan2(x[..., 0], x[..., 1]), rate], -1)


def main(arguments: list[str] | None = None) -> None:
    """Compares the turn with constant velocity, with and without outliers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=40, help="measurements of a track (default: 40)")
    steps = parser.parse_args(arguments).steps
    rng, like = torch.Generator().manual_seed(0), {"dtype": torch.float64}
    motion, radar = UnknownTurn(q=0.1, drift=0.01), DopplerRadar(torch.tensor([30.0, 0.01, 2.0], **like))
    print(check_model(motion, radar))
    truth = [torch.tensor([5000.0, 5000.0, 100.0, 0.0, 0.0], **like).repeat(100, 1)]
    for k in range(steps):
        truth.append(motion(truth[-1], torch.tensor(1.0, **like)))
        truth[-1][:, 4] = 0.0 if k < 10 else 0.1  # rad/s
    truth = torch.stack(truth[1:], 1)
    z = radar(truth) + radar.std() * torch.randn(100, steps, 3, generator=rng, **like)
    z[:, 5::10, 0] += 600.0  # outliers in range
    spread = torch.tensor([100.0, 100.0, 10.0, 10.0, 0.02], **like)
    prior = Gaussian(torch.tensor([5e3, 5e3, 100.0, 0.0, 0.0], **like), spread.diag())
    straight = Gaussian(prior.mean[:4], prior.scale_tril[:4, :4])
    with torch.no_grad():
        for name, preset in (("srckf", presets.srckf), ("rsrckf", presets.rsrckf), ("fra", presets.fra)):
            turning, straight_on = preset(motion, radar)(z, prior), preset(ConstantVelocity(1.0), radar)(z, straight)
            error, other = (metrics.rmse(e.mean, truth, motion.position).mean() for e in (turning, straight_on))
            print(f"{name:<7} position RMSE {error:6.1f} m with a turn of unknown rate, {other:6.1f} m without")


if __name__ == "__main__":
    main()

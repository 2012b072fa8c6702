"""A step of learning of a small network in front of a filter, beside alternatives."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import torch
from learned.kalmannet import KalmanNet
from learned.lorenz import SETTINGS, models, simulate
from torch import Tensor, nn

from benchmarks.elsewhere import start_learners
from benchmarks.timing import Row, learners, timed
from torchfra import presets
from torchfra.catalogue import make_scenario
from torchfra.scenarios import Scenario, Tracks

FEATURES, UNITS, RATE = 8, 32, 1e-6
"""Features of a measurement, hidden units of the network, and the learning rate."""


class Network(nn.Module):
    """From features to standard deviations, at first those of the sensor times some factor.

    Args:
        std: ``(m,)`` of the sensor.
    """

    def __init__(self, std: Tensor) -> None:
        super().__init__()
        self.std, m = std, len(std)
        self.layers = nn.Sequential(nn.Linear(FEATURES, UNITS), nn.Tanh(), nn.Linear(UNITS, m)).to(std)

    def forward(self, features: Tensor) -> Tensor:
        """``(B, T, m)`` of ``(B, T, k)``."""
        said: Tensor = self.std * self.layers(features).exp()
        return said


def layer(options: argparse.Namespace) -> list[Row]:
    """Network, filter, mean squared error of positions, gradient and descent, of 64 tracks or those of ``--batch``.

    With ``--peers`` the same in JAX too.  The EKF is as torchfilter has it, written anew: torchfilter asks for packages
    that are not to be had any more.  KalmanNet is on as many tracks of Lorenz's attractor, of three states.
    """
    scenario = make_scenario(options.scenario, initial=options.initial)
    data = scenario.simulate(int((options.batch or "64").split(",")[0]), 0)
    torch.manual_seed(0)
    network = Network(torch.full((scenario.sensor.size,), float(scenario.sensor.std()), dtype=torch.float64))
    features = torch.randn(*data.z.shape[:2], FEATURES, dtype=torch.float64)
    calls = {
        "srckf, compiled": srckf(scenario, data, compiled=True),
        "srckf, eager": srckf(scenario, data),
        "EKF, eager, as torchfilter's": lambda std: ekf(scenario, data, std),
    }
    steps = {
        name: descent(own := copy.deepcopy(network), lambda means=means, own=own: means(own(features)), data.truth)
        for name, means in calls.items()
    }
    steps["KalmanNet, small"] = kalmannet(len(data.z))
    with ExitStack() as stack:
        weights = [p.detach().numpy() for p in network.parameters()]
        peers = stack.enter_context(start_learners(scenario, data, features, RATE, weights)) if options.peers else {}
        every = {**learners(steps), **peers}
        rows = timed(every, options.passes, len(data.z) * scenario.steps, "srckf, compiled", batch=len(data.z))
        errors = {name: peer.ready["error"] for name, peer in peers.items()}
    errors |= {name: step() for name, step in steps.items()}
    return [row | {"error": errors[row["system"]]} for row in rows]


def descent(network: nn.Module, means: Callable[[], Tensor], truth: Tensor, rate: float = RATE) -> Callable[[], float]:
    """A call of one step of gradient descent, which returns the error before it."""
    optimiser = torch.optim.SGD(network.parameters(), rate)
    first = [p.detach().clone() for p in network.parameters()]

    def call() -> float:
        with torch.no_grad():  # every call computes the same
            for p, value in zip(network.parameters(), first, strict=True):
                p.copy_(value)
        optimiser.zero_grad()
        loss = (means() - truth)[..., :2].square().mean()
        loss.backward()
        optimiser.step()
        return loss.item()

    return call


def srckf(scenario: Scenario, data: Tracks, compiled: bool = False) -> Callable[[Tensor], Tensor]:
    """Means ``(B, T, n)`` by the standard deviations ``(B, T, m)``."""
    f: Any = presets.srckf(scenario.motion, scenario.sensor)
    f = f.compile() if compiled else f
    return lambda std: f(data.z, data.prior, u=data.u, std=std).mean


def ekf(scenario: Scenario, data: Tracks, std: Tensor) -> Tensor:
    """Means ``(B, T, n)`` of an extended Kalman filter in covariance form, with slopes by automatic differentiation.

    Source: Kloss, Martius & Bohg (2021), "How to train your differentiable filter", for its form; slopes as in
    torchfilter (Lee et al. 2020), whose graph is kept for the gradient.
    """
    dt = torch.tensor(scenario.dt, dtype=std.dtype)
    f, root = scenario.motion.transition(dt), scenario.motion.process_noise(dt)
    mean, q = data.prior.mean, root @ root.mT
    covariance = (data.prior.scale_tril @ data.prior.scale_tril.mT).expand(*mean.shape, -1)
    eye, of_each = torch.eye(mean.shape[-1], dtype=std.dtype), torch.eye(std.shape[-1], dtype=std.dtype)
    means = []
    for k in range(data.z.shape[1]):
        mean, covariance = mean @ f.mT, f @ covariance @ f.mT + q
        x = mean.detach().unsqueeze(-2).expand(-1, len(of_each), -1).clone().requires_grad_()
        expected = scenario.sensor(x, data.u[k].expand(*x.shape[:-1], -1))
        (slope,) = torch.autograd.grad(expected, x, of_each.expand_as(expected), create_graph=True)
        innovation = scenario.sensor.difference(data.z[:, k], scenario.sensor(mean, data.u[k].expand(len(mean), -1)))
        spread = slope @ covariance @ slope.mT + torch.diag_embed(std[:, k].square())
        gain = covariance @ slope.mT @ torch.inverse(spread)
        mean = mean + (gain @ innovation.unsqueeze(-1)).squeeze(-1)
        covariance = (eye - gain @ slope) @ covariance
        means.append(mean)
    return torch.stack(means, 1)


def kalmannet(tracks: int) -> Callable[[], float]:
    """A step of learning of a network whose output is the gain, on tracks of its own."""
    setting = SETTINGS["as stated"]
    batch, network = simulate(setting, 1.0, tracks, 0), KalmanNet(*models(setting, 1.0))
    return descent(network, lambda: network.estimated(batch), batch.truth.float())

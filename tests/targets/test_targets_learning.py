"""The likelihood of scans finds how often targets begin and how often they are measured."""

import math

import pytest
import torch

from torchfra import presets
from torchfra.association import ChiSquare, Clutter
from torchfra.hyper import learnable
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position
from torchfra.targets import Deletion, PoissonBirths, Targets, TwoPoint

WIDTH, FALSE, DETECTION, BIRTHS, SURVIVAL = 800.0, 4, 0.85, 0.3, 0.99


def scenes(runs, steps, seed):
    """Targets that come at a Poisson rate anywhere, live for a geometric time and move as assumed, in clutter."""
    rng = torch.Generator().manual_seed(seed)
    motion, one = ConstantVelocity(0.25), torch.ones(()).double()
    most = math.ceil(3 * BIRTHS * steps)
    come = torch.poisson(torch.full((runs, steps), BIRTHS), generator=rng).long().cumsum(-1)
    first = (come.unsqueeze(1) < torch.arange(1, most + 1)[:, None]).sum(-1)  # (runs, most), steps for never
    life = torch.empty(runs, most).geometric_(1 - SURVIVAL, generator=rng)
    state = torch.cat([WIDTH * torch.rand(runs, most, 2, generator=rng) - WIDTH / 2,
                       5 * torch.randn(runs, most, 2, generator=rng)], -1).double()  # fmt: skip
    F, root, scans = motion.transition(one), motion.process_noise(one), []
    for k in range(steps):
        moved = state @ F.mT + torch.randn(runs, most, 2, generator=rng).double() @ root.mT
        state = torch.where((first < k).unsqueeze(-1), moved, state)
        there = (first <= k) & (k < first + life) & (torch.rand(runs, most, generator=rng) < DETECTION)
        z = state[..., :2] + 2.0 * torch.randn(runs, most, 2, generator=rng).double()
        false = WIDTH * torch.rand(runs, 3 * FALSE, 2, generator=rng).double() - WIDTH / 2
        some = torch.rand(runs, 3 * FALSE, generator=rng) < 1 / 3
        z, there = torch.cat([z, false], 1), torch.cat([there, some], 1)
        order = (~there).int().argsort(dim=-1, stable=True)[:, : int(there.sum(-1).max())]
        z = torch.where(there.unsqueeze(-1), z, math.nan)
        scans.append(z.gather(1, order.unsqueeze(-1).expand(-1, -1, 2)))
    widest = max(z.shape[1] for z in scans)
    return torch.stack([torch.nn.functional.pad(z, (0, 0, 0, widest - z.shape[1]), value=math.nan) for z in scans], 1)


@pytest.mark.slow
def test_births_and_detection_are_found_from_scans_alone():
    f = presets.jpda(
        ConstantVelocity(0.25), Position(2.0), clutter=Clutter(WIDTH**2, rate=FALSE), detection=0.7,
        gate=ChiSquare(0.9999), learn=("detection",),
    )  # fmt: skip
    targets, births = Targets(f, birth=TwoPoint(25.0), deletion=Deletion(6)), learnable(PoissonBirths(0.1), "rate")
    z = scenes(8, 40, 0)
    found = []

    def of_scans():
        targets.zero_grad()
        found.append(targets(z))
        loss = -found[-1].log_likelihood.sum(-2).mean()
        loss.backward()
        return loss

    def of_births():
        births.zero_grad()
        loss = -births(found[-1]).mean()
        loss.backward()
        return loss

    torch.optim.LBFGS(targets.parameters(), lr=0.8, max_iter=4).step(of_scans)
    torch.optim.LBFGS(births.parameters(), max_iter=20).step(of_births)
    assert targets.filter.detection().item() == pytest.approx(DETECTION, abs=0.03)
    assert births.rate().item() == pytest.approx(BIRTHS, rel=0.2)


def test_the_likeliest_rate_is_the_mean_number_of_births():
    targets = Targets(presets.jpda(ConstantVelocity(0.25), Position(2.0), clutter=Clutter(WIDTH**2, rate=FALSE)),
                      birth=TwoPoint(25.0))  # fmt: skip
    with torch.no_grad():
        estimate = targets(scenes(3, 25, 1))
    first = estimate.confirmed.int().argmax(-1)[estimate.identity >= 0]
    mean = (first >= 4).sum() / (3 * 21)
    births = learnable(PoissonBirths(mean.item(), skip=4), "rate")
    likelihood = births(estimate)
    assert likelihood.shape == (3, 25)
    assert (likelihood[:, :4] == 0).all()
    likelihood.sum().backward()
    assert births.rate.raw.grad.abs() < 1e-4
    one = PoissonBirths(mean.item(), skip=0)
    begun = (estimate.confirmed.int().argmax(-1) == 7) & estimate.confirmed.any(-1)
    expected = torch.distributions.Poisson(mean.double()).log_prob(begun.sum(-1).double())
    torch.testing.assert_close(one(estimate)[:, 7], expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("options", "message"), [
    ({"rate": 0.0}, "rate: expected a value above 0"), ({"skip": -1}, "skip: expected 0 scans or more"),
])  # fmt: skip
def test_rates_out_of_range_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        PoissonBirths(**options)

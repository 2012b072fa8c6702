"""Gates and densities of false measurements are what they say, whichever elements are measured."""

import math

import numpy as np
import pytest
import torch
from joint import make

from torchfra.association import Candidates, ChiSquare, Clutter, Euclidean
from torchfra.sensors import RangeBearing


def test_gates_hold_what_they_say():
    sensor = RangeBearing(torch.tensor([1.0, 0.01]))
    z = torch.tensor([[[1000.0, 0.0], [1000.0, 0.06], [1070.0, 0.0]]], dtype=torch.float64)
    predicted = torch.tensor([[[1000.0, 0.0]]], dtype=torch.float64).expand(1, 3, 2)
    nis = torch.tensor([[1.0, 13.8, 13.9]], dtype=torch.float64)
    candidates = Candidates(z, predicted, torch.ones(1, 3, 2).double(), nis)
    inside = Euclidean(65.0)(candidates, sensor, 0.0)
    assert inside.exp().tolist() == [[1.0, 1.0, 0.0]]
    assert ChiSquare(0.999)(candidates, sensor, 0.0).exp().tolist() == [[1.0, 1.0, 0.0]]  # 13.816 for two elements
    assert Euclidean(30.0, probability=0.999)(candidates, sensor, 0.0).exp().tolist() == [[1.0, 1.0, 0.0]]
    one = candidates._replace(measured=torch.tensor([1.0, 0.0]).double().expand(1, 3, 2))
    assert ChiSquare(0.999)(one, sensor, 0.0).exp().tolist() == [[1.0, 0.0, 0.0]]  # 10.83 for one


def test_the_density_of_false_measurements_is_that_of_points_that_fall_evenly():
    """Counted in a small cell of the measurement's space."""
    sensor, rng = RangeBearing(1.0, dims=3), np.random.default_rng(0)
    x = np.array([300.0, 400.0, 200.0]) + rng.uniform(-50, 50, (2_000_000, 3))
    z = sensor(torch.from_numpy(x))
    middle = sensor(torch.tensor([300.0, 400.0, 200.0]).double())
    cell = torch.tensor([10.0, 0.02, 0.02], dtype=torch.float64)
    share = ((z - middle).abs() < cell / 2).all(-1).double().mean() / cell.prod()
    row = middle.expand(1, 1, 3)
    candidates = Candidates(row, row, torch.ones(1, 1, 3).double(), torch.zeros(1, 1).double())
    assert Clutter(100.0**3)(candidates, sensor).exp().item() == pytest.approx(share.item(), rel=0.03)
    assert Clutter(100.0**3, rate=5.0)(candidates, sensor).exp().item() == pytest.approx(5 * share.item(), rel=0.03)
    box = Clutter(extent=[100.0, 1.0, 2.0])
    assert box(candidates, sensor).exp().item() == pytest.approx(1 / 200)
    some = candidates._replace(measured=torch.tensor([[[1.0, 0.0, 1.0]]]).double())
    assert box(some, sensor).exp().item() == pytest.approx(1 / 200)


def test_a_measurement_of_the_infrared_sensor_alone_is_associated_too(crossing, scans):
    """Ranges fail from step 5 on; directions still tell the targets."""
    f, z = make("iaukf_jpda", crossing), scans.z.clone()
    z[:, 5:, :, 2] = math.nan
    estimate = f(z, scans.prior)
    assert not estimate.failed.any()
    assert (estimate.info.association[:, :, 5:15, 0] < 0.5).double().mean() > 0.7
    assert (
        estimate.scale_tril[..., 5, :].norm(dim=-1)[:, :, 15]
        > f(scans.z, scans.prior).scale_tril[..., 5, :].norm(dim=-1)[:, :, 15]
    ).all()

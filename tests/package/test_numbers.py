"""A number of Python or numpy keeps all its digits, wherever it becomes a tensor."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch

from torchfra import Gaussian, association, presets
from torchfra.association.gates import Candidates
from torchfra.motion import ConstantVelocity
from torchfra.numbers import as_tensor
from torchfra.sensors import Position, RangeBearing

ROOT = Path(__file__).parents[2]
NUMBERS = {
    "float": 0.1, "int": 1, "float of numpy": np.float64(0.1), "rough float of numpy": np.float32(0.1),
    "int of numpy": np.int64(1), "unsigned int of numpy": np.uint64(1),
}  # fmt: skip
CALLS = {
    "forward": lambda f, z, prior, dt: f(z, prior, dt=dt),
    "smooth": lambda f, z, prior, dt: f.smooth(z, prior, dt=dt),
    "lag": lambda f, z, prior, dt: f.smooth(z, prior, dt=dt, lag=2),
    "step": lambda f, z, prior, dt: f.step(f.init(prior), z[0], dt=dt)[0].belief,
    "step by a rough measurement": lambda f, z, prior, dt: f.step(f.init(prior), torch.zeros(2), dt=dt)[0].belief,
    "predict": lambda f, z, prior, dt: f.predict(f.init(prior), dt).belief,
}


def far_track():
    """Steps of 100 km, measured to a millimetre: of 0.1 s in single precision the digits do not suffice."""
    step = torch.arange(1, 9, dtype=torch.float64).unsqueeze(-1)
    noise = 1e-3 * torch.randn(8, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    deviations = torch.tensor([1e5, 1e5, 1e7, 1e7], dtype=torch.float64)
    return 1e5 * step + noise, Gaussian(torch.zeros_like(deviations), deviations.diag())


@pytest.fixture(scope="module")
def filters():
    """The same filters eager and compiled."""
    made = {"srckf": presets.srckf, "imm": presets.imm_srckf}
    models = {"srckf": ConstantVelocity(1e-6), "imm": [ConstantVelocity(q) for q in (1e-6, 1.0)]}
    return {
        (name, engine): f if engine == "eager" else f.compile()
        for name, preset in made.items()
        for engine in ("eager", "compiled")
        for f in [preset(models[name], Position(1e-3))]
    }


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("engine", ["eager", "compiled"])
@pytest.mark.parametrize("name", ["srckf", "imm"])
def test_a_time_step_that_is_a_number_says_what_its_tensor_says(filters, name, engine, call):
    f, run, (z, prior) = filters[name, engine], CALLS[call], far_track()
    for kind, dt in NUMBERS.items():
        exact = torch.tensor(float(dt), dtype=torch.float64)
        found, expected = run(f, z, prior, dt), run(f, z, prior, exact)
        assert torch.equal(found.mean, expected.mean), kind
        assert torch.equal(found.scale_tril, expected.scale_tril), kind


def test_a_number_becomes_a_tensor_with_all_its_digits():
    for value in (0.1, np.float64(0.1), [0.1], (0.1,), np.array([0.1]), torch.tensor(0.1, dtype=torch.float64)):
        assert as_tensor(value).dtype == torch.float64
        assert as_tensor(value).flatten().tolist() == [0.1]
    like = torch.zeros(2, dtype=torch.float32)
    assert as_tensor(0.1, like).dtype == torch.float32
    assert torch.equal(as_tensor(2**24 + 1.0, like), torch.tensor(2.0**24))
    assert as_tensor(np.float32(0.1)).item() == np.float32(0.1).item()
    assert as_tensor(np.array([0.1], np.float32)).dtype == torch.float32  # an array has its own


def test_the_probability_of_a_gate_is_not_rounded():
    """Of 1 - 1e-9 single precision makes 1, the probability of a gate that leaves nothing out."""
    gate, far = association.Euclidean(1.0, probability=1 - 1e-9), torch.full((1, 1, 2), 10.0, dtype=torch.float64)
    candidates = Candidates(far, torch.zeros_like(far), torch.ones_like(far), far.square().sum(-1))
    assert bool(gate.beyond(candidates, Position(1.0)) > 0)


def test_no_number_is_rounded_to_single_precision_on_its_way_to_double():
    """``torch.tensor([0.1]).double()`` is 0.10000000149: what is written so loses digits, in examples too."""
    listed = subprocess.run(["git", "ls-files", "*.py", "*.md"], cwd=ROOT, capture_output=True, text=True, check=True)
    call = r"torch\.(?:as_)?tensor\((?:[^()]|\((?:[^()]|\([^()]*\))*\))*\)\.(?:to|double)\("
    rounded = [
        f"{path}: {found}"
        for path in listed.stdout.split()
        if not path.startswith("tests/")
        for found in re.findall(call, (ROOT / path).read_text(encoding="utf-8"))
        if "dtype=" not in found
    ]
    assert not rounded


def northings(steps=5):
    """A target that stands at UTM coordinates, in single precision: its northing is a multiple of half a metre."""
    z = torch.tensor([5e5, 5.4e6]).expand(steps, 2)
    return z, Gaussian(torch.tensor([5e5, 5.4e6, 0.0, 0.0]), torch.eye(4))


@pytest.mark.parametrize("engine", ["eager", "compiled"])
def test_measurements_that_have_lost_their_digits_bring_a_warning(engine):
    f, (z, prior) = presets.srckf(ConstantVelocity(1.0), Position(0.1)), northings()
    f = f if engine == "eager" else f.compile()
    with pytest.warns(RuntimeWarning, match=r"z: float32 holds element 1 in steps of 0.5, .* deviation of 0.1"):
        f(z, prior)
    with pytest.warns(RuntimeWarning, match=r"z: float32 holds element 1"):
        f.step(f.init(prior), z[0])
    with pytest.warns(RuntimeWarning, match=r"z: float32 holds element 1"):
        f.smooth(z, prior, std=torch.full_like(z, 0.1))


def test_lost_digits_are_judged_by_the_noise_that_each_track_of_a_batch_has():
    z, prior = northings()
    f = presets.srckf(ConstantVelocity(1.0), Position(torch.tensor([[0.1, 0.1], [0.2, 0.2], [50.0, 50.0]])))
    with pytest.warns(RuntimeWarning, match=r"z: float32 holds element 1 in steps of 0.5"):
        f(z.expand(3, 5, 2), prior)
    f = presets.srckf(ConstantVelocity(1.0), Position(torch.tensor([[0.1, 0.1], [50.0, 50.0], [60.0, 60.0]])))
    f(z.expand(3, 5, 2), prior)


def test_time_steps_of_unix_times_in_single_precision_bring_a_warning():
    f, (z, prior) = presets.srckf(ConstantVelocity(1.0), Position(1.0)), northings()
    times = torch.tensor([1.7e9 + k for k in range(6)])
    with pytest.warns(RuntimeWarning, match=r"dt: all time steps are 0 in float32: take the differences .* in float64"):
        f(z.double(), prior, dt=times.diff())


def test_degrees_in_place_of_radians_bring_a_warning_and_unwrapped_angles_do_not():
    f = presets.srckf(ConstantVelocity(1.0), RangeBearing([5.0, 0.01]))
    prior = Gaussian.from_std([1000.0, 1000.0, 0.0, 0.0], 100.0)
    z = torch.tensor([[1414.2, 45.0], [1415.0, 45.1], [np.nan, np.nan], [1415.0, np.nan]], dtype=torch.float64)
    with pytest.warns(RuntimeWarning, match=r"z: expected angles in rad in elements \[1\], .*: degrees "):
        f(z, prior)
    f(z.new_zeros(0, 3, 2), prior)
    f(torch.stack([z[:, 0], z[:, 1].deg2rad() + 4 * np.pi * (torch.arange(4) % 2)], 1), prior)


def test_measurements_that_have_their_digits_bring_no_warning():
    """Warnings are errors here."""
    f, (z, prior) = presets.srckf(ConstantVelocity(1.0), Position(0.1)), northings()
    f(z.double(), prior)
    f(z - z[0], prior)
    f(torch.where(torch.arange(5).unsqueeze(-1) == 2, 1e36, z - z[0]), prior)  # an outlier
    f(torch.full_like(z, torch.nan), prior, dt=0.0)
    presets.srckf(ConstantVelocity(1.0), Position(1.0))(z, prior, dt=torch.zeros(1))

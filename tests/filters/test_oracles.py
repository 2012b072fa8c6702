"""Every filter agrees with plain numpy loops over 62 steps, whatever is missing."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import oracles
import pytest
import torch

from torchfra import presets, scenarios

CASES = [
    ("srckf", "srckf", {}),
    ("ukf", "ukf", {}),
    ("ukf", "ukf", {"alpha": 0.5, "beta": 2.0, "kappa": 0.0}),
    ("ekf", "ekf", {}),
    ("rsrckf", "rsrckf", {}),
    ("rsrckf", "rsrckf", {"threshold": 0.7}),
    ("mr_ckf", "mr_ckf", {}),
    ("asrckf", "asrckf", {}),
    ("asrckf", "asrckf", {"trace": "position", "weakening": 1.5, "forgetting": 0.8}),
    ("rmckf", "rmckf", {}),
] + [
    ("fra_srckf", "fra", {"decision": d, "memory": m, "final": f, "rcond": r})
    for d, m, f, r in (
        ("normalised", "plain", "robust", 0.1),
        ("normalised", "weighted", "adaptive", 0.2),
        ("likelihood", "plain", "plain", 0.1),
        ("likelihood", "weighted", "robust", 0.2),
    )
] + [
    ("fra", "fra", {"preference": 1.5, "gate": 8.0, "threshold": np.array([0.8, 2.0])}),
    ("fra_srckf", "fra", {"preference": -1.0, "share": (1.0, 0.3), "states": (slice(0, 2), slice(2, 4))}),
] + [
    ("fra", "fra", {"preference": p, "plain": q, "provisional": s, "final": f})
    for p, q, s, f in (
        (0.0, 0.0, "robust", "robust"), (1.5, 1.0, "likeliest", "plain"), (0.5, 2.0, "likeliest", "likeliest"),
        (-2.0, -1.0, "likeliest", "likeliest"), (0.0, 0.0, "plain", "likeliest"), (0.0, 3.0, "adaptive", "adaptive"),
    )
] + [
    ("fra_srckf", "fra", {"plain": 0.5, "gate": 4.0, "provisional": "likeliest"}),
    ("fra_srckf", "fra", {"provisional": "plain", "final": "likeliest"}),
    ("fra_srckf", "fra", {"patience": 2.0, "plain": 1.0}), ("fra", "fra", {"patience": 1.0}), ("fra", "fra", {}),
]  # fmt: skip


@pytest.fixture(scope="module")
def experiment():
    """Three runs of each experiment of the paper as one batch: both have the same models."""
    both = [make("std", initial="truth") for make in (scenarios.bearings_outliers, scenarios.bearings_manoeuvre)]
    one, other = (scenario.simulate(3, 5) for scenario in both)
    assert torch.equal(one.prior.scale_tril, other.prior.scale_tril)
    z = torch.stack([one.z[:, :62], other.z[:, :62]])  # two outliers or three are within
    z[:, 0, 7, 0] = z[:, 1, 0, 1] = torch.nan
    z[:, 1, 20:23] = z[:, 2, 0] = torch.nan
    z[:, 2, -1] += 0.2  # an abnormal last step
    z[:, 0, 30:34] += 0.3  # outliers of one offset, fewer than ``fra`` has patience with; and more
    z[:, 2, 40:48] += 0.3
    prior = one.prior._replace(mean=torch.cat([one.prior.mean, other.prior.mean]))
    return both[0], one._replace(z=z.flatten(0, 1), u=one.u[:62], prior=prior)


def model_of(scenario, tracks):
    """The scenario's two bearings and constant acceleration, for the oracles."""
    F, SQ = oracles.ca(1.0, 0.01)
    places = tracks.u.numpy().reshape(-1, 2, 2)
    std = scenario.sensor.std().item()
    return oracles.Model(F, SQ, std * np.eye(2), lambda x, k: oracles.bearings(x, places[k]), np.array([True, True]))


def priors_of(tracks):
    """Mean and covariance of each track."""
    covariance = (tracks.prior.scale_tril @ tracks.prior.scale_tril.mT).numpy()
    return [(mean.numpy(), covariance) for mean in tracks.prior.mean]


@pytest.mark.parametrize(("preset", "oracle", "options"), CASES, ids=str)
def test_a_filter_agrees_with_its_oracle(experiment, preset, oracle, options):
    scenario, tracks = experiment
    model = model_of(scenario, tracks)
    ours, theirs = dict(options), dict(options)
    if preset == "fra":
        theirs = {"decision": "likelihood", "memory": "weighted", "rcond": 0.2, "patience": 4.0} | theirs
    if "threshold" in options and not np.isscalar(options["threshold"]):
        ours |= {"threshold": torch.from_numpy(options["threshold"]), "per_element": True}
    if "share" in options:
        pairs = zip(theirs.pop("states"), theirs.pop("share"), strict=True)
        theirs["groups"] = tuple((states.start, states.stop, share) for states, share in pairs)
    e = getattr(presets, preset)(scenario.motion, scenario.sensor, **ours)(tracks.z, tracks.prior, u=tracks.u)
    # The oracle's EKF takes its Jacobian from finite differences.
    tolerance = 1e-5 if oracle == "ekf" else 1e-9
    for i, prior in enumerate(priors_of(tracks)):
        expected = getattr(oracles, oracle)(tracks.z[i].numpy(), *prior, model, **theirs)
        mean, P = e.mean[i].numpy(), e.covariance[i].numpy()
        np.testing.assert_allclose(mean, expected["mean"], rtol=tolerance, atol=tolerance * np.abs(mean).max())
        np.testing.assert_allclose(P, expected["P"], rtol=tolerance * 10, atol=tolerance * np.abs(P).max())
        for key, value in (("nis", e.nis), ("log_likelihood", e.log_likelihood)):
            np.testing.assert_allclose(value[i].numpy(), expected[key], rtol=tolerance * 1e3, atol=tolerance * 1e3)
        info = e.info
        if oracle == "fra":
            np.testing.assert_array_equal(info.abnormal[i].numpy(), expected["abnormal"])
            np.testing.assert_array_equal(info.adaptive[i].numpy(), expected["name"] == "adaptive")
            np.testing.assert_array_equal(info.plain[i].numpy(), expected["name"] == "plain")
            np.testing.assert_allclose(info.provisional.mean[i].numpy(), expected["provisional"], rtol=1e-7, atol=1e-5)
            kept = np.where(info.adaptive[i], info.fading[i], 1.0)
            np.testing.assert_allclose(kept, expected["fading"], rtol=1e-6)
        elif info.fading is not None:
            np.testing.assert_allclose(info.fading[i].numpy(), expected["fading"], rtol=1e-6)
        if oracle in ("rsrckf", "rmckf", "mr_ckf"):
            np.testing.assert_allclose(info.weights[i].numpy(), expected["weights"], rtol=1e-6)


LIKELIHOOD = {"decision": "likelihood", "memory": "weighted", "rcond": 0.2, "preference": 0.7}
NORMALISED = {"decision": "normalised", "memory": "plain", "rcond": 0.1}
THREE = LIKELIHOOD | {"plain": 1.2, "provisional": "likeliest"}


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "options", "temperature"), [
    ("fra", LIKELIHOOD, 0.05), ("fra", LIKELIHOOD, 5.0), ("fra_srckf", NORMALISED, 1.0), ("fra", THREE, 0.05),
    ("fra", THREE, 1.0), ("fra_srckf", NORMALISED | {"plain": -0.5, "provisional": "plain"}, 5.0),
])  # fmt: skip
def test_a_soft_decision_agrees_with_its_oracle(experiment, preset, options, temperature):
    scenario, tracks = experiment
    model = model_of(scenario, tracks)
    f = getattr(presets, preset)(scenario.motion, scenario.sensor, temperature=temperature, **options)
    e = f(tracks.z, tracks.prior, u=tracks.u)
    options = {"patience": f.patience} | options
    for i, prior in enumerate(priors_of(tracks)):
        expected = oracles.soft_fra(tracks.z[i].numpy(), *prior, model, temperature, **options)
        mean, P = e.mean[i].numpy(), e.covariance[i].numpy()
        np.testing.assert_allclose(mean, expected["mean"], rtol=1e-8, atol=1e-8 * np.abs(mean).max())
        np.testing.assert_allclose(P, expected["P"], rtol=1e-7, atol=1e-8 * np.abs(P).max())
        shown = e.info.provisional.mean[i].numpy()
        np.testing.assert_allclose(shown, expected["provisional"], rtol=1e-8, atol=1e-8 * np.abs(shown).max())


def test_oracles_never_import_what_they_are_compared_with():
    code = "import sys, oracles; print({'torch', 'torchfra', 'train'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[1], capture_output=True, text=True, check=True
    )
    assert done.stdout == "set()\n"

"""``torchfra.fit`` finds the values that tracks were made with, from data of any form, and says what it did."""

import json

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, TensorDataset

import torchfra
from torchfra import Gaussian, presets, scenarios
from torchfra.catalogue import scenario_filter
from torchfra.fitting import Sweep, sweep
from torchfra.fitting.data import batch_of
from torchfra.fitting.judging import judged
from torchfra.fitting.objective import objective_of
from torchfra.fitting.vector import Vector, copied
from torchfra.motion import ConstantVelocity
from torchfra.readers import Recording
from torchfra.sensors import Bearings, Position

Q, STD, SPREAD = 0.5, 2.0, torch.tensor([20.0, 20.0, 10.0, 10.0], dtype=torch.float64)
PRIOR = Gaussian(torch.zeros(4, dtype=torch.float64), SPREAD.diag())
QUICK = {"compile": True, "iterations": 0, "quiet": True}
"""Newton's method alone."""


def walks(seed, runs=120, steps=12, q=Q, std=STD):
    """Tracks of constant velocity with known noise: states and measurements."""
    rng, like = torch.Generator().manual_seed(seed), {"dtype": torch.float64}
    motion, one = ConstantVelocity(q), torch.tensor(1.0, **like)
    step, noise = motion.transition(one), motion.process_noise(one)
    x, states = torch.randn(runs, 4, generator=rng, **like) * SPREAD, []
    for _ in range(steps):
        x = x @ step.mT + torch.randn(runs, noise.shape[-1], generator=rng, **like) @ noise.mT
        states.append(x)
    truth = torch.stack(states, 1)
    return truth, truth[..., :2] + std * torch.randn(runs, steps, 2, generator=rng, **like)


def start(**options):
    return presets.srckf(ConstantVelocity(3 * Q), Position(3 * STD), **options)


@pytest.fixture(scope="module")
def data():
    truth, z = walks(0)
    return {"z": z, "prior": PRIOR, "truth": truth}


@pytest.fixture(scope="module")
def fitted(data):
    return torchfra.fit(start(), {k: data[k] for k in ("z", "prior")}, learn=("q", "std"), seed=3, quiet=True,
                        compile=True, batch=16, iterations=20, lr=0.3, restarts=2)  # fmt: skip


# ---------------------------------------------------------------- what is found


@pytest.mark.slow
def test_noise_levels_a_factor_three_off_are_found_from_measurements_alone(fitted):
    for name, known in (("motion.q", Q), ("sensor.std", STD)):
        assert abs(fitted.learned[name] - known) < 3 * fitted.errors[name] < 0.5 * known
        low, high = fitted.intervals[name]
        assert low < fitted.learned[name] < high


def test_the_filter_that_was_handed_in_stays_and_the_fitted_one_has_fixed_values(fitted):
    f = start()
    torchfra.fit(f, {"z": walks(1, 8, 5)[1], "prior": PRIOR}, learn=("q",), **QUICK)
    assert f.motion.q().item() == pytest.approx(3 * Q)
    assert not list(f.parameters())
    assert fitted.filter.motion.q().item() == pytest.approx(fitted.learned["motion.q"])
    assert not any(p.requires_grad for p in fitted.filter.parameters())


def test_held_out_tracks_gain_and_say_by_how_much(fitted):
    row = fitted.held_out["likelihood"]
    assert row.change.high < 0
    assert row.after.value - row.before.value == pytest.approx(row.change.value)
    assert row.before.low < row.before.value < row.before.high


def test_the_same_seed_finds_the_same_values_to_the_bit(data):
    one, again = (
        torchfra.fit(start(), {"z": data["z"][:20, :8], "prior": PRIOR}, learn=("q", "std"), seed=3, quiet=True,
                     compile=False, batch=8, iterations=4, lr=0.3, restarts=2)
        for _ in range(2)
    )  # fmt: skip
    assert again.learned == one.learned


def test_all_starts_come_to_the_same_loss(fitted):
    assert len(fitted.restarts) == 2
    assert max(fitted.restarts) - min(fitted.restarts) < 0.02 * abs(min(fitted.restarts))


@pytest.mark.slow
def test_what_a_preset_makes_learnable_is_learned_without_naming_it(data):
    f = start(learn=("std",))
    assert set(torchfra.fit(f, {"z": data["z"], "prior": PRIOR}, **QUICK).learned) == {"sensor.std"}


@pytest.mark.slow
def test_compiled_and_interpreted_find_the_same(data):
    short = {"z": data["z"][:20, :8], "prior": PRIOR}
    one, other = (torchfra.fit(start(), short, learn=("std",), iterations=0, compile=c) for c in (True, False))
    assert one.compiled
    assert not other.compiled
    assert one.learned["sensor.std"] == pytest.approx(other.learned["sensor.std"], rel=1e-9)


def test_a_filter_that_cannot_be_compiled_runs_interpreted_and_says_so(data, no_compiler):
    found = torchfra.fit(start(), {"z": data["z"][:8, :4], "prior": PRIOR}, learn=("std",), iterations=0)
    assert not found.compiled
    assert "interpreted" in found.notes[0]
    assert "note: the filter runs interpreted" in str(found)


@pytest.mark.slow
def test_float32_stays_float32_and_comes_to_the_same(data):
    double, single = (
        torchfra.fit(start(), {"z": data["z"][:, :10].to(dtype), "prior": PRIOR}, learn=("q", "std"), **QUICK)
        for dtype in (torch.float64, torch.float32)
    )
    assert single.dtype == "float32"
    for name, value in double.learned.items():
        assert single.learned[name] == pytest.approx(value, rel=1e-4)


# ---------------------------------------------------------------- losses


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["robust", "mse", "nll", "own"])
def test_every_loss_is_lowered(data, loss):
    own = (
        (lambda estimate, batch: (estimate.mean - batch.truth)[..., :2].abs().mean((-1, -2))) if loss == "own" else loss
    )
    found = torchfra.fit(start(), data, learn=("q",), loss=own, **QUICK)
    row = next(iter(found.held_out.values()))
    assert row.after.value < row.before.value
    assert found.settings.errors == "sandwich"
    assert (found.held_out["position RMSE"].change.value < 0) == (loss != "nll")  # std stays wrong


@pytest.mark.slow
def test_the_smoothed_likelihood_finds_the_measurement_noise(data):
    found = torchfra.fit(start(), {"z": data["z"][:60], "prior": PRIOR}, learn=("std",), loss="smoothed", **QUICK)
    assert abs(found.learned["sensor.std"] - STD) < 3 * found.errors["sensor.std"] < 0.6 * STD
    assert found.settings.errors == "sandwich"


@pytest.mark.slow
def test_with_a_truth_the_loss_is_robust_and_without_the_likelihood(data):
    short = {"z": data["z"][:8, :4], "prior": PRIOR}
    assert torchfra.fit(start(), short, learn=("q",), **QUICK).settings.loss == "likelihood"
    with_truth = torchfra.fit(start(), short | {"truth": data["truth"][:8, :4]}, learn=("q",), **QUICK)
    assert with_truth.settings.loss == "robust"
    assert 0 < with_truth.settings.scale < 100


# ---------------------------------------------------------------- data


def forms(z, tmp=None):
    """The same tracks in every form."""
    scenario = scenarios.Tracks(torch.full((*z.shape[:2], 4), torch.nan), z, None, PRIOR)
    return {
        "dictionary": {"z": z, "prior": PRIOR},
        "tracks": scenario,
        "function": lambda seed: {"z": z, "prior": PRIOR},
        "function of runs": lambda seed, runs: {"z": z[:runs], "prior": PRIOR},
        "one by one": [{"z": track, "prior": PRIOR} for track in z],
        "loader": DataLoader([{"z": track, "prior": PRIOR, "dt": 1.0} for track in z], batch_size=7),
    }


@pytest.mark.parametrize("form", forms(torch.zeros(1, 1, 2)))
def test_the_same_tracks_in_any_form_are_the_same_batch(form):
    z = walks(0, 12, 5)[1]
    batch, plain = (batch_of(start(), forms(z)[name], runs=12, seed=0) for name in (form, "dictionary"))
    assert torch.equal(batch.z, plain.z)
    assert torch.equal(batch.prior.mean, plain.prior.mean)
    assert torch.equal(batch.prior.scale_tril, plain.prior.scale_tril)
    assert torch.equal(batch.dt, plain.dt)


@pytest.mark.usefixtures("short_tracks")
def test_a_scenario_is_simulated_and_judged_in_the_coordinates_of_its_truth():
    scenario = scenarios.bearings_outliers("none", initial="truth")
    found = torchfra.fit(presets.srckf(scenario.motion, scenario.sensor), scenario, learn=("std",), runs=12, **QUICK)
    assert found.counts["train"] + found.counts["validation"] + found.counts["test"] == 12
    assert "position RMSE" in found.held_out


@pytest.mark.usefixtures("short_tracks")
def test_counts_and_seeds_may_be_integers_of_numpy():
    scenario = scenarios.bearings_outliers("none", initial="truth")
    f = presets.srckf(scenario.motion, scenario.sensor)
    plain, other = (
        torchfra.fit(f, scenario, learn=("std",), runs=count(12), seed=count(3), **QUICK) for count in (int, np.int64)
    )
    assert other.learned == plain.learned


def test_without_a_prior_tracks_begin_at_their_first_whole_measurement():
    z = walks(2, 6, 8)[1]
    z[0, :2] = torch.nan
    z[1, 0, 1] = torch.nan
    f = start()
    batch = batch_of(f, z, runs=0, seed=0)
    assert torch.equal(batch.belief(f).mean[:, :2], torch.stack([z[0, 2], z[1, 1], *z[2:, 0]]))
    assert torch.equal(batch.z[0, :5], z[0, 3:])
    assert batch.z[0, 5:].isnan().all()
    f.sensor.std.set(5.0)
    assert (batch.belief(f).scale_tril[:, 0, 0] - 5.0).abs().max() < 1e-9
    (bearing,) = (presets.srckf(ConstantVelocity(1.0), Bearings(0.1)),)
    with pytest.raises(ValueError, match="prior: expected one belief per track"):
        batch_of(bearing, z, runs=0, seed=0)


@pytest.mark.parametrize("loss", ["likelihood", "smoothed"])
def test_measurements_may_have_standard_deviations_of_their_own(loss):
    z, f = walks(2, 6, 8)[1], start(learn=("q",))
    std = torch.linspace(0.5, 30.0, 8, dtype=z.dtype).unsqueeze(-1) * torch.tensor([1.0, 2.0], dtype=z.dtype)
    whole = {"z": z, "prior": PRIOR, "std": std}
    items = [{"z": track, "prior": PRIOR, "std": std[:6]} for track in z[:, :6]]
    assert torch.equal(batch_of(f, whole, runs=0, seed=0).std[3], std)
    assert torch.equal(batch_of(f, items, runs=0, seed=0).std[3], std[:6])
    vector = Vector(f)
    batch = batch_of(f, whole, runs=0, seed=0)
    found = objective_of(f, vector, whole, batch, loss, None, 0).losses(vector.raw()[None, None], batch)[0]
    if loss == "likelihood":
        expected = -f(z, PRIOR, std=std).log_likelihood.sum(-1)
    else:
        hidden = [z.clone() for _ in range(5)]
        expected = 0.0
        for fold, seen in enumerate(hidden):
            seen[:, fold::5] = torch.nan
            smoothed = f.smooth(seen, PRIOR, std=std)
            belief = Gaussian(smoothed.mean[:, fold::5], smoothed.scale_tril[:, fold::5])
            again = f(z[:, fold::5].unsqueeze(-2), belief, dt=0.0, std=std[fold::5].unsqueeze(-2))
            expected = expected - again.log_likelihood.sum((-2, -1))
    torch.testing.assert_close(found, expected)
    with pytest.raises(ValueError, match="prior: expected one belief per track where std is given"):
        batch_of(f, {"z": z, "std": std}, runs=0, seed=0)
    both = start(learn=("q", "std"))
    with pytest.raises(ValueError, match=r"learn: expected none of sensor\.std, which data with std do not use"):
        objective_of(both, Vector(both), whole, batch, loss, None, 0)


@pytest.mark.parametrize("loss", ["likelihood", "robust"])
def test_tracks_of_the_test_change_nothing_that_is_learned(loss):
    truth, z = walks(8, 12, 6)
    data = {"z": z, "truth": truth}
    tests = torch.randperm(12, generator=torch.Generator().manual_seed(0))[:2]  # as seed 0 splits 12 tracks
    other = {name: x.index_copy(0, tests, 1e3 + 50.0 * x[tests]) for name, x in data.items()}
    options = {"learn": ("q", "std"), "loss": loss, "compile": False, "iterations": 3, "polish": False}
    one, two = (torchfra.fit(start(), x, **options) for x in (data, other))
    assert (two.learned, two.settings) == (one.learned, one.settings)
    assert two.held_out[loss].after != one.held_out[loss].after


def test_the_speed_of_tracks_without_a_prior_is_not_that_of_one_that_is_infinite():
    z = walks(2, 6, 8)[1]
    z[0, 1] = torch.inf
    f = start()
    assert torch.equal(batch_of(f, z, runs=0, seed=0).prior.speed[1:], batch_of(f, z[1:], runs=0, seed=0).prior.speed)


@pytest.mark.slow
def test_a_start_without_a_prior_does_not_move_what_is_found():
    z = walks(4, 300, 12)[1]
    found = torchfra.fit(start(), TensorDataset(z), learn=("q", "std"), **QUICK)
    for name, known in (("motion.q", Q), ("sensor.std", STD)):
        assert abs(found.learned[name] - known) < 3 * found.errors[name]


def test_cleaned_tracks_are_no_measurements():
    cleaned = torchfra.clean((np.arange(30.0), walks(0, 1, 30)[1][0].numpy()), bank="vehicle")
    with pytest.raises(ValueError, match=r"data: expected z .*, received Cleaned"):
        batch_of(start(), [cleaned], runs=0, seed=0)


def test_recordings_of_different_lengths_are_learned_from():
    _, z = walks(5, 30, 20)
    lengths = [20 - i % 5 for i in range(30)]
    recordings = [Recording(f"r{i}", np.arange(t) * 1.0, z[i, :t].numpy(), None, {}) for i, t in enumerate(lengths)]
    found = torchfra.fit(start(), recordings, learn=("std",), **QUICK)
    assert abs(found.learned["sensor.std"] - STD) < 0.2 * STD
    whole = batch_of(start(), recordings, runs=0, seed=0)
    assert (~whole.z.isnan().any(-1)).sum(1).tolist() == [t - 1 for t in lengths]  # the first is what each begins with


@pytest.mark.slow
def test_a_track_that_fails_is_left_out_and_said(data):
    z = data["z"][:12, :6].clone()
    z[3, 2] = torch.inf
    found = torchfra.fit(start(), {"z": z, "prior": PRIOR}, learn=("q",), **QUICK)
    assert found.counts["left out"] == 1
    assert "1 tracks have no finite loss" in found.notes[0]


@pytest.mark.parametrize("compiles", [True, False])
def test_a_gate_that_no_gradient_reaches_stays_without_a_standard_error(data, compiles):
    f = presets.fra(ConstantVelocity(Q), Position(STD))
    tracks = {"z": data["z"][:12, :4], "prior": PRIOR}
    found = torchfra.fit(f, tracks, learn=("gate",), **QUICK | {"iterations": 1, "compile": compiles})
    assert found.learned["gate"] == pytest.approx(found.start["gate"])
    assert "there are no standard errors" in " ".join(found.notes)


# ---------------------------------------------------------------- what is refused, before any work


@pytest.mark.parametrize(("change", "message"), [
    ({"data": 3}, "data: expected a Scenario, a function of a seed"),
    ({"data": []}, "data: expected one track or more"),
    ({"data": {"x": torch.zeros(1)}}, "data: expected z"),
    ({"data": torch.zeros(5, 4, 3).double()}, r"z: expected floating point numbers \(N, T, 2\)"),
    ({"data": torch.full((3, 4, 2), torch.inf).double()}, "data: expected a track whose loss is finite at the start"),
    ({"loss": "best"}, "loss: expected one of"),
    ({"loss": "mse"}, "loss: expected 'likelihood' or 'smoothed' for data without a truth"),
    ({"learn": ("gate",)}, "learn: expected 'all' or some of"),
    ({"learn": None}, "learn: expected names of hyperparameters"),
    ({"held_out": 1.0}, "held_out: expected a share"),
    ({"restarts": 0}, "restarts: expected a whole number of at least 1"),
    ({"lr": 0.0}, "lr: expected a finite number above 0"),
    ({"skip": 99}, "skip: expected less than"),
    ({"scale": -1.0, "loss": "robust", "data": {"z": torch.ones(5, 4, 2).double(), "truth": torch.ones(5, 4, 4)}},
     "scale: expected a finite number above 0"),
    ({"errors": "guess"}, "errors: expected one of"),
    ({"data": {"z": torch.zeros(5, 4, 2).double(), "dt": torch.ones(3)}},
     r"dt: expected a shape that broadcasts to \(N, T\)"),
    ({"data": {"z": torch.zeros(5, 4, 2).double(), "u": torch.ones(3, 2)}}, "u: expected a shape that broadcasts to"),
    ({"data": {"z": torch.zeros(5, 4, 2).double(), "prior": 3}}, "prior: expected a Gaussian"),
    ({"data": {"z": torch.zeros(5, 4, 2).double(), "truth": torch.zeros(5, 3, 4)}}, "truth: expected 5 tracks of 4"),
    ({"data": [torch.zeros(4, 2).double(), torch.zeros(4, 1).double()]}, "z: expected measurements of one size"),
    ({"data": torch.zeros(0, 4, 2).double()}, "data: expected one track or more"),
    ({"loss": lambda estimate, batch: 1.0}, "loss: expected one number for each track, .*received float"),
    ({"loss": 3}, "loss: expected one of"),
    ({"learn": 3}, "learn: expected names"),
    ({"lr": "fast"}, "lr: expected a finite number above 0"),
    ({"iterations": True}, "iterations: expected a whole number"),
    ({"resume": True}, "checkpoint: expected the name of a file"),
])  # fmt: skip
def test_what_cannot_be_is_named(change, message):
    arguments = {"data": {"z": torch.zeros(5, 4, 2).double(), "prior": PRIOR}, "learn": ("q",)} | QUICK | change
    with pytest.raises(ValueError, match=message):
        torchfra.fit(start(), **arguments)


def test_settings_are_checked_before_data_are_simulated():
    def simulator(seed):
        raise AssertionError("simulated")

    with pytest.raises(ValueError, match="clip: expected a finite number above 0"):
        torchfra.fit(start(), simulator, learn=("q",), clip=-1.0)


@pytest.mark.slow
def test_arrays_and_a_truth_that_nobody_knows_are_data_too():
    truth, z = walks(0, 12, 6)
    one = torchfra.fit(start(), z.numpy(), learn=("q",), **QUICK)
    other = torchfra.fit(start(), {"z": z, "truth": truth * float("nan")}, learn=("q",), **QUICK)
    assert one.learned == other.learned
    assert other.settings.loss == "likelihood"


def test_others_that_are_no_filters_are_refused(fitted):
    for others in (
        3,
        {"a": 3},
        {"fitted": start()},
        {"a": presets.srckf(ConstantVelocity(1.0, dims=3), Position(2.0, dims=3))},
    ):
        with pytest.raises(ValueError, match="others: expected"):
            fitted.compare(others)


def test_a_filter_with_a_network_is_sent_to_a_loop_of_its_own():
    f = start()
    f.network = torch.nn.Linear(2, 2)
    with pytest.raises(ValueError, match="filter: expected a filter whose parameters are hyperparameters"):
        torchfra.fit(f, torch.zeros(5, 4, 2).double())


# ---------------------------------------------------------------- going on after an interruption


@pytest.mark.slow
def test_a_fit_that_was_interrupted_goes_on_to_the_same_bits(tmp_path, monkeypatch):
    from torchfra.fitting.descent import Descent

    options = {"learn": ("q",), "compile": True, "iterations": 7, "validate_every": 2, "batch": 4}
    z = {"z": walks(6, 12, 5)[1], "prior": PRIOR}
    unbroken = torchfra.fit(start(), z, **options)
    advance = Descent.advance

    def fails(self):
        if self.iteration == 5:
            raise KeyboardInterrupt
        return advance(self)

    monkeypatch.setattr(Descent, "advance", fails)
    path = tmp_path / "fit.pt"
    with pytest.raises(KeyboardInterrupt):
        torchfra.fit(start(), z, checkpoint=path, **options)
    monkeypatch.setattr(Descent, "advance", advance)
    with pytest.raises(ValueError, match="holds a fit already"):
        torchfra.fit(start(), z, checkpoint=path, **options)
    with pytest.raises(ValueError, match=r"resume: expected the settings of .*fit\.pt, these differ: lr$"):
        torchfra.fit(start(), z, checkpoint=path, resume=True, **options | {"lr": 0.2})
    with pytest.raises(ValueError, match=r"these differ: data, loss at the start$"):
        torchfra.fit(start(), {**z, "z": z["z"] + 1.0}, checkpoint=path, resume=True, **options)
    robust = presets.rsrckf(ConstantVelocity(3 * Q), Position(3 * STD))
    with pytest.raises(ValueError, match=r"these differ: loss at the start$"):
        torchfra.fit(robust, z, checkpoint=path, resume=True, **options | {"compile": False})
    resumed = torchfra.fit(start(), z, checkpoint=path, resume=True, **options)
    assert resumed.learned == unbroken.learned
    assert resumed.rows == unbroken.rows


def test_a_fit_goes_on_on_a_processor_that_rounds_otherwise(tmp_path):
    options = {"learn": ("q",), "compile": False, "iterations": 2, "validate_every": 1, "batch": 4, "polish": False}
    z, path = walks(6, 12, 5)[1] + 5e6, tmp_path / "fit.pt"
    done = torchfra.fit(start(), z, checkpoint=path, **options)
    rounded = z * (1 + 1e-15 * torch.randn(z.shape, dtype=z.dtype, generator=torch.Generator().manual_seed(0)))
    resumed = torchfra.fit(start(), rounded, checkpoint=path, resume=True, **options)
    assert resumed.rows == done.rows
    missing = z.clone()
    missing[4, 2] = torch.nan
    moved = z.clone()
    moved[3, 2] += 1.0
    for other in (z.flip(0), missing, moved, z[:-1]):
        with pytest.raises(ValueError, match="these differ: data"):
            torchfra.fit(start(), other, checkpoint=path, resume=True, **options)


@pytest.mark.slow
def test_a_damaged_checkpoint_gives_way_to_the_one_before_it(tmp_path, capsys):
    options = {"learn": ("q",), "compile": True, "iterations": 4, "validate_every": 2, "batch": 4}
    z = {"z": walks(6, 12, 5)[1], "prior": PRIOR}
    path = tmp_path / "fit.pt"
    done = torchfra.fit(start(), z, checkpoint=path, **options)
    path.write_bytes(path.read_bytes()[:-40])
    assert torchfra.fit(start(), z, checkpoint=path, resume=True, **options).learned == done.learned
    assert "fit.pt is damaged and is not used" in capsys.readouterr().err


# ---------------------------------------------------------------- what is written


def test_the_result_prints_its_values_what_is_identified_and_before_and_after(fitted):
    text = str(fitted)
    for word in ("motion.q", "sensor.std", "standard error", "identified", "condition", "before", "float64", "seed 3"):
        assert word in text


def test_the_result_is_written_as_json_and_as_a_figure(fitted, tmp_path):
    fitted.to_json(tmp_path / "fit.json")
    data = json.loads((tmp_path / "fit.json").read_text())
    assert data["values"]["motion.q"]["learned"] == fitted.learned["motion.q"]
    assert data["settings"]["seed"] == 3
    assert {"torch", "torchfra"} <= set(data["versions"])
    with pytest.raises(ValueError, match=r"path: expected a file that ends in .*, received fit\.docx"):
        fitted.plot("fit.docx")
    fitted.plot(tmp_path / "fit.png")
    assert (tmp_path / "fit.png").stat().st_size > 10_000


def test_other_filters_are_compared_on_the_held_out_tracks(fitted):
    table = fitted.compare(
        {"start": start(), "itself": fitted, "robust": presets.rsrckf(fitted.filter.motion, Position(STD))}
    )
    assert table.rows["start"].change.low > 0
    assert table.rows["itself"].change.value == 0
    assert "held-out" in str(table)


@pytest.mark.parametrize("loss", ["likelihood", "mse"])
def test_another_filter_has_one_loss_for_each_scene_of_several_targets(loss):
    scenario = scenarios.clutter_straight(counts="poisson")
    f = copied(scenario_filter("iaukf_jpda", scenario), ("std",))
    tracks, vector = batch_of(f, scenario, runs=3, seed=0), Vector(f)
    objective = objective_of(f, vector, scenario, tracks, loss, None, 0)
    (own,) = objective.losses(vector.raw()[None, None], tracks)
    torch.testing.assert_close(objective.of_filter(f, tracks), own)


def test_clutter_is_not_learned_by_a_likelihood_that_is_relative_to_it():
    scenario = scenarios.clutter_straight(counts="poisson")
    f = scenario_filter("iaukf_jpda", scenario)
    with pytest.raises(ValueError, match=r"loss: expected another than 'likelihood'.*to learn clutter\.rate"):
        torchfra.fit(f, scenario, learn=("rate",), loss="likelihood", runs=4, quiet=True)


def test_a_track_that_is_lost_decides_the_mean_but_not_the_median_and_is_told_of():
    before = torch.linspace(1.0, 2.0, 30).double()
    after = before - 0.5
    after[3] += 100.0
    row = judged(before, after)
    assert row.change.value > 0 > row.middle.high
    assert row.middle.value == pytest.approx(-0.5)
    assert row.lost == 1
    assert row.note("likelihood", 30).startswith("1 of 30 tracks that judge change over 30 times")
    assert judged(before, before).lost == 0


@pytest.mark.slow
def test_validation_does_not_turn_down_the_last_steps_where_the_model_holds():
    for seed in (10, 22):  # where it is two standard errors better before them
        found = torchfra.fit(start(), {"z": walks(seed, 30, 10)[1], "prior": PRIOR}, learn=("q", "std"), quiet=True,
                             compile=True, iterations=12, lr=0.5, validate_every=1, patience=20)  # fmt: skip
        assert found.certainty.gradient_size < 0.1
        assert not any("validation" in note for note in found.notes)


# ---------------------------------------------------------------- sweeps


def test_a_sweep_finds_the_combination_that_made_the_tracks(data):
    found = sweep(
        start(), {"z": data["z"], "prior": PRIOR}, {"std": (1.0, 2.0, 4.0), "q": (0.1, 0.5, 2.5)}, compile=False
    )
    assert found.best == {"std": STD, "q": Q}
    assert len(found.points) == len(found.losses) == 9


def test_the_best_of_a_sweep_is_no_combination_at_which_the_filter_diverges():
    found = Sweep(["q", "std"], [(1.0, 2.0), (1.0, 3.0), (4.0, 2.0)], [float("nan"), 7.0, 5.0], [])
    assert found.best == {"q": 4.0, "std": 2.0}


def test_a_sweep_says_at_every_point_what_a_filter_with_these_values_says(data):
    z = data["z"][:8, :5]
    found = sweep(start(), {"z": z, "prior": PRIOR}, {"q": (0.2, 0.9), "std": (1.5, 2.5)}, compile=False)
    for point, loss in zip(found.points, found.losses, strict=True):
        values = dict(zip(found.names, point, strict=True))
        f = presets.srckf(ConstantVelocity(values["q"]), Position(values["std"]))
        assert -f(z, PRIOR).log_likelihood.sum(-1).mean().item() == pytest.approx(loss, rel=1e-9)

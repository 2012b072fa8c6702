"""The particle filter that GPB is held against is exact while it keeps every history, and unbiased when it does not."""

import json

import particles
import pytest
import torch
from gpb_cases import ALMOST_NONE, MOTION, PRIOR, SENSORS, VALUES, close, measured

from torchfra import presets


def run(name, steps, count, outliers=True, **options):
    """Means of the filter and of the particles."""
    f = presets.gpb(MOTION, SENSORS[name], **VALUES | {"separate_levels": 0, "unreliable": 0.0} | options)
    z = measured(name, outliers=outliers)[0, 2 : 2 + steps]
    with torch.no_grad():
        return f(z, PRIOR).mean, particles.particle_filter(f, z, PRIOR, None, count, 0, 1.0)


@pytest.mark.parametrize("name", ["position", "bearings"])
def test_the_first_step_has_nothing_to_merge(name):
    merged, alone = run(name, 1, 10_000)
    close(alone, merged, 1e-10)


def test_without_outliers_jumps_and_levels_it_is_the_filter_itself():
    merged, alone = run("position", 12, 50, outliers=False, **ALMOST_NONE)
    close(alone, merged, 1e-9)


def test_few_particles_are_close_to_all_histories():
    _, every = run("position", 4, 10**6)
    merged, some = run("position", 4, 300)
    std = 5.0
    assert (some - every)[:, :2].abs().max() < 0.02 * std
    assert (merged - every)[:, :2].abs().max() < 0.6 * std  # what merging costs, with a jump as rare as a burst


def test_what_is_kept_has_the_right_weight_on_average():
    weight = torch.softmax(2 * torch.randn(40, dtype=torch.float64), 0)
    mean = torch.zeros_like(weight)
    for seed in range(2000):
        chosen, log_weight = particles.keep(weight.log(), 10, torch.Generator().manual_seed(seed))
        assert len(chosen) == 10
        assert log_weight.exp().sum().item() == pytest.approx(1)
        mean.index_add_(0, chosen, log_weight.exp() / 2000)
    assert (mean - weight).abs().max() < 0.006


def test_a_bank_and_several_blocks_are_refused():
    with pytest.raises(ValueError, match="expected one motion, and a sensor of one block"):
        run("ranges", 1, 10)


@pytest.mark.slow
@pytest.mark.usefixtures("short_tracks")
def test_the_script_writes_all_cells(tmp_path, capsys):
    arguments = ["--runs", "1", "--particles", "3", "--json", str(tmp_path / "p.json")]
    assert particles.main(arguments) == 0
    cells = json.loads((tmp_path / "p.json").read_text())["cells"]
    assert len(cells) == 3
    assert all(of.keys() == {"gpb", "lagged", "shared", "particles"} for of in cells.values())
    assert "gpb above" in capsys.readouterr().out
    assert particles.main(["--particles", "0"]) == 2
    assert "particles: expected 1 or more, received 0" in capsys.readouterr().err

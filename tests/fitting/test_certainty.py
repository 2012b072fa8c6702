"""What ``torchfra.fit`` says of its certainty holds for all of it: split, Adam, Newton's method and standard errors."""

import json

import certainty
import pytest


@pytest.mark.slow
def test_errors_of_whole_fits_are_as_large_as_they_say(tmp_path, capsys):
    small = ["--fits", "12", "--tracks", "24", "--steps", "10", "--iterations", "4"]
    assert certainty.main([*small, "--json", str(tmp_path / "c.json")]) == 0
    found = json.loads((tmp_path / "c.json").read_text())["values"]
    for of in found.values():
        assert of["inside"] >= 9 / 12  # of intervals that hold in 95 of 100, fewer do once in 5000
        assert 0.45 < of["rms"] < 1.7  # 99.9 % of the roots of mean squares of 12 normal numbers
    assert "12 fits" in capsys.readouterr().out

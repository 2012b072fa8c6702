"""What the README and the scripts promise, happens."""

import json
import re
from pathlib import Path

import pytest
import reproduce

ROOT = Path(__file__).parent.parent


def test_the_quickstart_of_the_readme_runs(capsys):
    code = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    scope: dict[str, object] = {}
    for block in code:
        exec(compile(block, "README.md", "exec"), scope)
    assert len(code[0].strip().splitlines()) <= 15
    assert 100 < float(re.findall(r"tensor\(([\d.]+)", capsys.readouterr().out)[0]) < 170


@pytest.mark.parametrize("experiment", ["bearings-outliers", "bearings-manoeuvre"])
def test_reproduce_writes_results_and_the_papers_figures(experiment, tmp_path):
    arguments = [experiment, "--runs", "10", "--json", str(tmp_path / "r.json"), "--plots", str(tmp_path), "--quiet"]
    assert reproduce.main(arguments) == 0
    result = json.loads((tmp_path / "r.json").read_text())
    assert result.keys() == {"experiment", "runs", "seed", "settings", "versions", "filters"}
    assert result["experiment"] == experiment
    expected = {"rmse_position", "rmse_velocity", "mean_rmse_position", "median_error_position", "divergence_rate",
                "relative_time"}  # fmt: skip
    for figures in result["filters"].values():
        assert expected <= figures.keys()
        assert len(figures["rmse_position"]) == 100
    assert len(list(tmp_path.glob("figure-*.png"))) == 4


def test_reproduce_says_what_is_wrong(capsys):
    assert reproduce.main(["bearings-outliers", "--filters", "kalman"]) == 2
    assert "kalman" in capsys.readouterr().err

"""The page on outliers has the rows of its script, and the arguments there are those that the script takes."""

import re
from pathlib import Path

import outliers
import pytest
import torch

from torchfra.motion import GaussMarkov

PAGE = (Path(__file__).parents[2] / "torchfra/robust/README.md").read_text(encoding="utf-8")


def test_each_kind_of_outliers_has_its_row_and_argument():
    rows = re.findall(r"^\| (.*?) \| (.*?) \| .*\(.*\|$", PAGE, re.M)
    assert rows == [(kind.words, kind.argument) for kind in outliers.KINDS.values()]


def test_the_arguments_of_the_page_are_those_of_the_script():
    fitted = {name: kind.fitted() for name, kind in outliers.KINDS.items()}
    assert fitted["bursts"].outliers.outlier_durations().tolist() == pytest.approx([100, 10])
    assert fitted["one side"].outliers.outlier_durations().tolist() == pytest.approx([60, 20])
    assert {type(error) for error in fitted["lasting"].errors} == {GaussMarkov}
    assert float(fitted["second target"].outliers.same_offset()) == pytest.approx(0.9)


def test_a_fault_lasts_as_long_as_it_is_said_to():
    on = outliers.runs(torch.zeros(2000, 300), (60.0, 12.0), torch.Generator().manual_seed(0))
    ends, began = on[:, :-1] & ~on[:, 1:], ~on[:, :-1] & on[:, 1:]
    assert float(on[:, :-1].sum() / ends.sum()) == pytest.approx(12, rel=0.03)
    assert float((~on)[:, :-1].sum() / began.sum()) == pytest.approx(60, rel=0.03)

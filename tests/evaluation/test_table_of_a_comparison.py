"""The table of a comparison says how far off filters are, which are the same, and which lose their targets."""

import pytest

from torchfra import presets
from torchfra.catalogue import FILTERS
from torchfra.evaluation import headline, table


def result(error, lost=0, steps=(1.0, 1.0)):
    return {
        "mean_rmse_position": error, "mean_rmse_velocity": 3.0, "median_error_position": 31.0, "worst_track": 400.0,
        "diverged": lost, "limit": 1000.0, "nees_position": 1.5, "microseconds": 0.0812,
        "rmse_position": [error * step for step in steps],
    }  # fmt: skip


RESULTS = {
    "gpb": result(60.2), "ukf": result(92.0), "srckf": result(92.1), "asrckf": result(6e11, lost=4),
    "fra": result(72.4, lost=1), "mine": result(92.0, steps=(0.5, 1.5)),
}  # fmt: skip


def lines(**options):
    return {line.split()[0]: line for line in table(RESULTS, **options).splitlines()}


def test_a_filter_has_a_line_with_its_time_and_what_its_name_stands_for():
    assert list(lines()) == ["filter", *RESULTS]
    assert lines()["gpb"].split()[:8] == ["gpb", "60.2", "3.00", "31.0", "400", "0", "1.50", "0.08"]
    assert lines()["srckf"].endswith("square-root cubature Kalman filter")
    assert lines()["mine"].endswith("0.08")
    assert all(entry.words for name, entry in FILTERS.items() if hasattr(presets, name))


def test_filters_with_the_same_errors_share_a_line_unless_all_are_asked_for():
    shown = lines(every=False)
    assert list(shown) == ["filter", "gpb", "ukf", "asrckf", "fra", "mine"]
    assert shown["ukf"].endswith("unscented Kalman filter; the same: srckf")


def test_where_runs_are_lost_far_away_their_number_stands_for_the_mean_errors():
    assert lines()["asrckf"].split()[:7] == ["asrckf", "-", "-", "31.0", "-", "4", "1.50"]
    assert lines()["fra"].split()[1:6] == ["72.4", "3.00", "31.0", "400", "1"]


@pytest.mark.parametrize(("names", "said"), [
    (RESULTS, "gpb: 60 m, no run diverged; best of the others: fra, 72 m; plain srckf: 92 m"),
    (["srckf", "gpb"], "srckf: 92 m, no run diverged; best of the others: gpb, 60 m"),
    (["asrckf"], "asrckf: more than 1000 km, 4 of 867 runs diverged"),
])  # fmt: skip
def test_a_sentence_says_how_the_first_filter_compares(names, said):
    assert headline({name: RESULTS[name] for name in names}, 867) == said

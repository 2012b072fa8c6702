"""Intervals hold what they should, tests err as often as they say, and quantiles are those of tables."""

import itertools
import math

import numpy as np
import pytest

from torchfra.metrics.statistics import (
    chi_square_bounds,
    holm,
    mean_interval,
    median_interval,
    signed_rank,
    student_quantile,
)
from torchfra.tables import decimals_of, formed_table, significant, with_error


@pytest.mark.parametrize(("degrees", "share", "value"), [
    (1, 0.975, 12.7062047), (4, 0.975, 2.7764451), (30, 0.95, 1.6972609), (10**6, 0.975, 1.9599664),
])  # fmt: skip
def test_students_quantiles_are_those_of_tables(degrees, share, value):
    assert student_quantile(share, degrees) == pytest.approx(value, rel=1e-6)


def test_quantiles_and_tests_are_those_of_scipy():
    stats = pytest.importorskip("scipy.stats")
    for degrees in (1, 2, 60, 4000, 10**6):
        expected = stats.chi2.ppf([0.025, 0.975], degrees) / degrees
        np.testing.assert_allclose(chi_square_bounds(degrees), expected, rtol=1e-9)
        assert student_quantile(0.975, degrees) == pytest.approx(stats.t.ppf(0.975, degrees), rel=1e-8)
    rng = np.random.default_rng(0)
    for one, other in (rng.normal(size=(2, 60)), rng.integers(0, 5, (2, 60)), rng.normal(size=(2, 300)) * [[1], [2]]):
        expected = stats.wilcoxon(one, other, correction=True, method="approx").pvalue
        assert signed_rank(one, other) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("n", [1, 2, 5, 9, 12])
def test_of_few_runs_the_test_is_that_of_all_signs(n):
    rng = np.random.default_rng(n)
    for gap in (rng.normal(size=n), rng.integers(1, 4, n) * rng.choice([-1.0, 1.0], n)):  # without ties and with many
        size = np.abs(gap)
        rank = (size[:, None] > size).sum(1) + (1 + (size[:, None] == size).sum(1)) / 2
        sums = np.array([rank @ signs for signs in itertools.product((0, 1), repeat=n)])
        middle = rank.sum() / 2
        expected = np.mean(np.abs(sums - middle) >= abs(rank[gap > 0].sum() - middle) - 1e-9)
        assert signed_rank(gap, np.zeros(n)) == pytest.approx(expected, rel=1e-12)


def test_of_few_runs_without_ties_the_test_is_that_of_scipy_and_near_the_approximation():
    stats = pytest.importorskip("scipy.stats")
    one, other = np.random.default_rng(4).normal(size=(2, 25))
    expected = stats.wilcoxon(one, other, method="exact").pvalue
    assert signed_rank(one, other) == pytest.approx(expected, rel=1e-9)
    assert signed_rank(one, other) == pytest.approx(
        stats.wilcoxon(one, other, correction=True, method="approx").pvalue, rel=0.05
    )


def test_intervals_hold_the_mean_and_the_median_in_95_of_100_samples():
    samples = np.random.default_rng(1).exponential(size=(800, 60))
    found = [(mean_interval(x), median_interval(x)) for x in samples]
    assert 0.91 < np.mean([m.low < 1 < m.high for m, _ in found]) < 0.97
    assert 0.93 < np.mean([m.low < math.log(2) < m.high for _, m in found]) < 0.985


def test_of_equal_filters_the_test_says_so_in_95_of_100_samples_and_sees_a_difference():
    draws = np.random.default_rng(2).gamma(2.0, size=(2, 1000, 40))
    assert 0.03 < np.mean([signed_rank(a, b) < 0.05 for a, b in zip(*draws, strict=True)]) < 0.07
    assert signed_rank(draws[0, 0], draws[0, 0] * 1.1) < 1e-6


def test_infinite_errors_count_as_far_off_and_missing_runs_not_at_all():
    good, bad = np.arange(1.0, 21.0), np.arange(1.0, 21.0) + 5
    bad[3], good[4] = np.inf, np.nan
    assert signed_rank(good, bad) < 1e-3
    assert signed_rank([np.inf, 1.0], [np.inf, 1.0]) == 1.0
    assert mean_interval(bad).value == np.inf
    assert math.isnan(mean_interval(bad).low)
    assert math.isfinite(median_interval(bad).high)
    assert mean_interval([1.0, 1e300]).high == np.inf
    assert math.isnan(mean_interval([]).value)
    assert math.isnan(median_interval([1.0, 2.0]).low)


def test_holm_corrects_as_its_paper():
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]


# ---------------------------------------------------------------- digits and forms


@pytest.mark.parametrize(("value", "half", "written"), [
    (123.456, 1.234, ("123.5", "1.2")), (0.012345, 0.00067, ("0.01235", "0.00067")), (98765.4, 123.0, ("98765", "123")),
    (1.0, 0.0996, ("1.00", "0.10")), (5.4321, math.nan, ("5.43", "")), (math.inf, math.nan, ("inf", "")),
    (math.nan, math.nan, ("-", "")), (2.5e7, 3.0, ("2e+07", "")),
])  # fmt: skip
def test_a_value_has_the_digits_that_its_interval_gives_it(value, half, written):
    assert with_error(value, half) == written


def test_decimals_follow_the_scale():
    assert [decimals_of(x) for x in (123.0, 12.0, 1.2, 0.12, 0.0)] == [0, 0, 1, 2, 0]
    assert [significant(x) for x in (1234.5, 12.345, 0.012345)] == ["1234", "12.3", "0.0123"]


def test_tables_take_the_forms_of_papers():
    header, rows = ["filter", "RMSE m", "p %"], [["my_filter", "**1.0 +- 0.1**", "5"], ["a|b", "2.0", "-"]]
    assert formed_table("text", header, rows).splitlines()[1] == "my_filter  1.0 +- 0.1    5"
    assert formed_table("csv", header, rows) == "filter,RMSE m,p %\nmy_filter,1.0 +- 0.1,5\na|b,2.0,-\n"
    latex = formed_table("latex", header, rows, "50 % of_it").splitlines()
    assert r"\caption{50 \% of\_it}" in latex
    assert r"my\_filter & \textbf{1.0 $\pm$ 0.1} & 5 \\" in latex
    assert [line for line in latex if "rule" in line] == [r"\toprule", r"\midrule", r"\bottomrule"]
    markdown = formed_table("markdown", header, rows, "about").splitlines()
    assert markdown[1:4] == ["| --- | ---: | ---: |", "| my_filter | **1.0 ± 0.1** | 5 |", r"| a\|b | 2.0 | - |"]


def test_other_forms_and_rows_are_refused():
    with pytest.raises(ValueError, match="form: expected one of text, csv, latex, markdown, received 'html'"):
        formed_table("html", ["a"], [])
    with pytest.raises(ValueError, match="rows: expected 1 cells in each, received 2"):
        formed_table("latex", ["a"], [["b", "c"]])

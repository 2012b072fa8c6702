"""GPB becomes the filters it generalises, weighs hypotheses by what comes after, and names what does not fit."""

import math

import pytest
import torch
from gpb_cases import ALMOST_NONE, ANCHORS, MOTION, PRIOR, SENSORS, STEPS, VALUES, close, measured, same, tensor
from hypothesis import given, settings
from hypothesis import strategies as st

from torchfra import presets
from torchfra.hyper import hypers
from torchfra.motion import Bank, ConstantVelocity, CoordinatedTurn
from torchfra.sensors import Position, Ranges
from torchfra.types import Gaussian

# ---------------------------------------------------------------- what it generalises


@pytest.mark.parametrize("name", ["position", "bearings"])
def test_without_outliers_jumps_and_poor_starts_one_level_is_srckf(name):
    z = measured(name, outliers=False)
    e = presets.gpb(MOTION, SENSORS[name], **ALMOST_NONE)(z, PRIOR)
    expected = presets.srckf(MOTION, SENSORS[name])(z, PRIOR)
    close(e.mean, expected.mean)
    close(e.covariance, expected.covariance)
    close(e.nis, expected.nis)
    close(e.log_likelihood, expected.log_likelihood)
    close(e.info.lagged.mean, expected.mean, 1e-8)


def test_blocks_of_a_sensor_that_bends_linearise_anew_and_that_matters_little():
    z = measured("ranges", outliers=False)
    e = presets.gpb(MOTION, SENSORS["ranges"], **ALMOST_NONE)(z, PRIOR)
    expected = presets.srckf(MOTION, SENSORS["ranges"])(z, PRIOR)
    std = expected.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    assert ((e.mean - expected.mean).abs() < 0.5 * std).all()
    assert ((e.mean - expected.mean).abs() < 0.15 * std)[:, 5:].all()


def test_blocks_of_a_linear_sensor_one_after_the_other_are_all_at_once():
    together, apart, z = Position(5.0), Position(5.0), measured(outliers=False)
    apart.blocks = ((1,), (0,))
    e, expected = (presets.gpb(MOTION, s, **ALMOST_NONE)(z, PRIOR) for s in (apart, together))
    close(e.mean, expected.mean)
    close(e.covariance, expected.covariance)
    close(e.log_likelihood, expected.log_likelihood)


def test_without_outliers_and_jumps_a_bank_is_imm_srckf():
    motions = [MOTION, ConstantVelocity(0.1, orders=3), CoordinatedTurn(math.pi / 20, 0.1, orders=3)]
    stay, renew = tensor([0.6, 0.8, 0.8]), tensor([0.5, 0.25, 0.25])
    matrix, z = stay.diag() + (1 - stay).unsqueeze(-1) * renew, measured(outliers=False)
    e = presets.gpb(motions, SENSORS["position"], **ALMOST_NONE)(z, PRIOR)
    initial = renew / (1 - stay) / (renew / (1 - stay)).sum()
    expected = presets.imm_srckf(motions, SENSORS["position"], transition=matrix, initial=initial)(z, PRIOR)
    close(e.mean, expected.mean)
    close(e.covariance, expected.covariance)
    close(e.info.probabilities[..., :3], expected.info.probabilities)
    close(e.log_likelihood, expected.log_likelihood)


def test_a_bank_of_one_is_the_motion_itself():
    z = measured()
    one, *banks = (presets.gpb(m, SENSORS["position"], **VALUES)(z, PRIOR) for m in (MOTION, [MOTION], Bank([MOTION])))
    for bank in banks:
        same(one, bank)


# ---------------------------------------------------------------- what it knows


def first_regimes(stay, restart, motions=1):
    """Probabilities of the regimes before the first step: two levels, other motions, a jump."""
    options = {"noise_levels": (0.1, 10.0), "jump_factors": (200.0,), "self_transition": stay, "restart": restart}
    f = presets.gpb([MOTION, ConstantVelocity(0.1, orders=3)][:motions], SENSORS["position"], **options)
    return f.init(PRIOR).log_weights.exp().sum(-2)


def test_regimes_begin_as_often_as_the_chain_has_them_in_the_long_run():
    stay, restart = tensor([0.95, 0.8, 0.9, 0.5]), tensor([0.5, 0.3, 0.15, 0.05])
    chain = stay.diag() + (1 - stay).unsqueeze(-1) * restart
    close(first_regimes(stay, restart, 2), torch.linalg.matrix_power(chain, 1000)[0])


def test_a_regime_that_begins_and_never_ends_is_there_from_the_first_step_on():
    found = first_regimes((1.0, 0.8, 1.0, 0.5), (0.5, 0.3, 0.1, 0.1), 2)
    close(found, tensor([0.5, 0.0, 0.1, 0.0]) / 0.6)
    assert first_regimes((0.9, 1.0, 0.9, 0.5), (0.5, 0.0, 0.4, 0.1))[1] == 0  # it never begins


@pytest.mark.slow
@given(
    seed=st.integers(0, 1000), name=st.sampled_from(sorted(SENSORS)), spread=st.floats(1.0, 1e4),
    outlier=st.floats(0.001, 0.5), jump=st.floats(1e-8, 0.05),
)  # fmt: skip
@settings(deadline=None, max_examples=10)
def test_probabilities_are_probabilities(seed, name, spread, outlier, jump):
    noise = torch.randn(2, STEPS, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    z = measured(name, seed=seed)
    z = z + spread * SENSORS[name].std() * noise * (noise > 1)
    options = VALUES | {
        "restart": (0.5, 0.3, 0.2 - jump, jump),
        "outlier_transition": ((1 - outlier, outlier), (0.6, 0.4)),
    }
    e = presets.gpb(MOTION, SENSORS[name], **options)(z, PRIOR)
    for of in (e.info.probabilities, e.info.outlier):
        assert ((of >= 0) & (of <= 1 + 1e-12)).all()
    close(e.info.probabilities.sum(-1), torch.ones(2, STEPS).double(), 1e-12)
    assert e.info.outlier.shape == (2, STEPS, len(SENSORS[name].blocks))


def test_later_measurements_tell_an_outlier_from_a_jump():
    t = torch.arange(1.0, 21.0).double()
    straight = torch.stack([9 * t, torch.full_like(t, 100)], -1)
    gone, back = straight.clone(), straight.clone()
    gone[14:, 1] += 60  # twelve sigma
    back[14, 1] += 60
    e = presets.gpb(MOTION, SENSORS["position"], **VALUES)(torch.stack([gone, back]), PRIOR)
    filtered, settled = e.info.filtered.mean[:, 14, 1], e.info.lagged.mean[:, 14, 1]
    close(filtered[0], filtered[1])
    assert settled[1] < settled[0]
    assert abs(settled[1] - 100) < 10
    assert abs(e.mean[0, 19, 1] - 160) < 15  # a burst of outliers is shorter


@pytest.mark.parametrize(
    ("values", "most"), [(VALUES | {"separate_levels": 0}, 0.2), ({}, 0.5)], ids=["own", "default"]
)
def test_only_the_block_that_is_wrong_is_an_outlier(values, most):
    z = measured("ranges", outliers=False)
    z[:, 8, 2] += 100
    outlier = presets.gpb(MOTION, SENSORS["ranges"], **values)(z, PRIOR).info.outlier
    assert (outlier[:, 8, 2] > 0.99).all()
    assert (outlier[:, 8, [0, 1, 3]] < most).all()


def test_outliers_come_in_runs_where_the_chain_says_so():
    z = measured(outliers=False)
    z[:, 8:11] += 20
    once, runs = (
        presets.gpb(MOTION, SENSORS["position"], **VALUES | {"outlier_transition": ((0.95, 0.05), (1 - still, still))})(
            z, PRIOR
        )
        for still in (0.05, 0.8)
    )
    assert (runs.info.outlier[:, 9] > once.info.outlier[:, 9]).all()


def test_blocks_may_come_in_any_order():
    z = measured("ranges", outliers=False)
    z[:, 8, 2] += 100
    order = [2, 0, 3, 1]
    turned = Ranges(ANCHORS[order], 2.0)
    cases = ((SENSORS["ranges"], z), (turned, z[..., order]))
    e, other = (presets.gpb(MOTION, sensor, **VALUES)(x, PRIOR) for sensor, x in cases)
    std = e.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    apart = (e.mean - other.mean).abs() / std
    assert (apart < 0.8).all()  # from a prior so wide that it matters which block has what ranges bend
    assert (apart[:, 2:] < 0.4).all()
    assert ((e.info.outlier[..., order] - other.info.outlier).abs() < 0.3).all()


def test_it_does_not_matter_which_block_is_missing():
    ranges = [Ranges(ANCHORS[list(order)], 2.0) for order in ((0, 1), (1, 0))]
    z = measured("ranges", outliers=False)[:1, :1, :2]
    z[..., 0] = torch.nan
    e, other = (presets.gpb(MOTION, sensor)(x, PRIOR) for sensor, x in zip(ranges, (z, z.flip(-1)), strict=True))
    torch.testing.assert_close(e.covariance, other.covariance)


def test_nothing_measured_is_a_prediction_that_jumps_nowhere():
    z = measured()
    z[:, 10:] = torch.nan
    f = presets.gpb(MOTION, SENSORS["position"], **VALUES)
    e, one = f(z, PRIOR), torch.tensor(1.0).double()
    matrix, noise = MOTION.transition(one), MOTION.process_noise(one)
    for k in range(10, STEPS):
        level = (e.info.probabilities[:, k] * tensor([0.1, 30, 30])).sum(-1)[:, None, None]
        close(e.mean[:, k], e.mean[:, k - 1] @ matrix.mT)
        close(e.covariance[:, k], matrix @ e.covariance[:, k - 1] @ matrix.mT + level * noise @ noise.mT)
    assert (e.nis[:, 10:] == 0).all()
    close(1 + e.log_likelihood[:, 10:], torch.ones(2, 5).double(), 1e-12)


def test_lag_chooses_between_the_filtered_and_the_settled_estimate():
    z = measured()
    now, later = (presets.gpb(MOTION, SENSORS["position"], lag=lag, **VALUES)(z, PRIOR) for lag in (0, 1))
    close(now.mean, now.info.filtered.mean, 0)
    close(later.scale_tril, later.info.lagged.scale_tril, 0)
    close(now.info.lagged.mean, later.mean, 0)
    close(later.info.lagged.mean[:, -1], later.info.filtered.mean[:, -1], 0)
    assert (now.mean - later.mean)[:, :-1].abs().max() > 1


# ---------------------------------------------------------------- values


def test_every_value_learns():
    f = presets.gpb(MOTION, SENSORS["position"], learn="all", **VALUES)
    paths = set(hypers(f))
    assert {p.removesuffix(".raw") for p, _ in f.named_parameters()} == paths
    assert {path.rpartition(".")[2] for path in paths} == {"q", "std", *VALUES}
    f = presets.gpb(MOTION, SENSORS["position"], learn=("prior_outlier", "self_transition"), **VALUES)
    assert {p for p, _ in f.named_parameters()} == {"prior_outlier.raw", "regimes.self_transition.raw"}
    assert not list(MOTION.parameters())


class Shifted(Position):
    """A position whose forward is its own: no matrix times the state."""

    def forward(self, x, u=None):
        return super().forward(x) + 100.0


def test_a_sensor_with_a_forward_of_its_own_is_not_taken_for_linear():
    z = torch.randn(3, 8, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    prior = Gaussian(torch.zeros(3, 4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    plain, shifted = (presets.gpb(ConstantVelocity(1.0), sensor(2.0)) for sensor in (Position, Shifted))
    torch.testing.assert_close(plain(z, prior).mean, shifted(z + 100, prior).mean)

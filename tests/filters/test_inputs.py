"""What is handed in wrongly is named before any work; what may be handed in, works."""

import copy
import math
import re

import pytest
import torch

from torchfra import Gaussian, presets, scenarios
from torchfra.adaptive import Fading
from torchfra.association import Clutter, Euclidean
from torchfra.filters import FRA, SRCKF
from torchfra.motion import ConstantVelocity, Motion
from torchfra.robust import Huber, HuberScore, Weights
from torchfra.sensors import Bearings, Position, RangeBearing, Sensor

MOTION, SENSOR = ConstantVelocity(1.0), Position(2.0)
PRIOR = Gaussian(torch.zeros(4).double(), torch.eye(4).double())
Z = torch.zeros(6, 2).double()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: f(Z, PRIOR, dt=object()), r"dt: expected numbers, received <object"),
        (lambda f: SRCKF(SENSOR, MOTION), r"motion: expected an instance of torchfra's Motion, received Position"),
        (lambda f: SRCKF(ConstantVelocity, SENSOR), r"motion: expected an instance .*, received ConstantVelocity"),
        (lambda f: SRCKF(MOTION, Position(2.0, dims=3)), r"sensor: expected one of at most 2 dimensions of space"),
        (lambda f: SRCKF(MOTION, SENSOR, rule="ckf"), r"rule: expected torchfra.gaussian.third_degree or the like"),
        (lambda f: SRCKF(MOTION, SENSOR, robust=torch.nn.Identity()), r"robust: expected Robust .*received Identity"),
        (lambda f: SRCKF(MOTION, SENSOR, robust=Fading()), r"robust: expected Robust .*received Fading"),
        (lambda f: FRA(MOTION, SENSOR, robust=HuberScore(), fading=Fading()), r"robust: .*received HuberScore"),
        (lambda f: Gaussian.from_covariance(torch.zeros(2), -torch.eye(2)), r"covariance: expected a symmetric"),
        (lambda f: f.step(PRIOR, Z[0]), r"state: expected what init or step has returned, received Gaussian"),
        (lambda f: f.step(presets.fra(MOTION, SENSOR).init(PRIOR), Z[0]), r"state: .* this SRCKF .* a FRAState"),
        (lambda f: presets.fra(MOTION, SENSOR).step(f.init(PRIOR), Z[0]), r"state: .* this FRA .* received a State"),
        (lambda f: presets.iaukf(MOTION, SENSOR).step(f.init(PRIOR), Z[0]), r"state: .* this SRCKF .* another filter"),
        (lambda f: f.step(f.init(PRIOR)._replace(belief=Gaussian([0.0] * 4, PRIOR.scale_tril)), Z[0]),
         r"state.belief.mean: expected a tensor, received list"),
    ],
)  # fmt: skip
def test_what_is_not_of_its_kind_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call(presets.srckf(MOTION, SENSOR))


def test_too_few_numbers_for_the_stations_are_named():
    f = presets.srckf(MOTION, Bearings(0.1))
    with pytest.raises(ValueError, match=r"u: expected the positions of 2 stations, \(..., 4\), received"):
        f(Z, PRIOR, u=torch.zeros(6, 2).double())


def test_a_measurement_of_another_dtype_is_taken_in_that_of_the_state():
    f = presets.srckf(MOTION, SENSOR)
    state, _ = f.step(f.init(PRIOR), torch.ones(2))
    assert state.belief.mean.dtype == torch.float64
    torch.testing.assert_close(state.belief.mean, f.step(f.init(PRIOR), torch.ones(2).double())[0].belief.mean)


def test_a_filter_takes_a_robust_update_later():
    f = presets.srckf(MOTION, SENSOR)
    f.robust = Huber(1.0)
    far = torch.full((6, 2), 50.0).double()
    torch.testing.assert_close(f(far, PRIOR).mean, presets.rsrckf(MOTION, SENSOR, threshold=1.0)(far, PRIOR).mean)


class Unchanging(Motion):
    """Nothing to learn: its process noise is fixed."""

    linear = True

    def __init__(self):
        super().__init__(2, 2, None)

    def transition(self, dt):
        return torch.eye(4, dtype=dt.dtype).expand(*dt.shape, 4, 4)

    def process_noise(self, dt):
        return torch.eye(4, dtype=dt.dtype).expand(*dt.shape, 4, 4)


class Constant(Unchanging):
    """Declares nothing of time."""

    def __init__(self, order):
        super().__init__()
        self.order = order

    def transition(self, dt):
        return torch.eye(4, dtype=dt.dtype)

    def process_noise(self, dt):
        return torch.eye(4, dtype=dt.dtype)[self.order]


@pytest.mark.parametrize("steps", [4, 6])
def test_a_motion_may_be_the_same_for_all_steps_where_each_has_a_dt(steps):
    z = torch.arange(2.0 * steps).double().reshape(steps, 2)
    order = [1, 0, 3, 2]  # another root of the same covariance
    f = presets.srckf(Constant(order), Position(1.0))
    expected = f(z, PRIOR, dt=1.0)
    for dt in (torch.ones(steps).double(), torch.ones(3, steps).double()):
        found = f(z.expand(*dt.shape, 2), PRIOR, dt=dt)
        torch.testing.assert_close(found.mean, expected.mean.expand_as(found.mean))
        torch.testing.assert_close(found.covariance, expected.covariance.expand_as(found.covariance))


class Short(Sensor):
    """Declares two elements and gives one."""

    def __init__(self):
        super().__init__(2, [False, False], 1.0)

    def forward(self, x, u=None):
        return x[..., :1]


class Shrinking(Motion):
    """Gives back half of its state."""

    def __init__(self):
        super().__init__(2, 2, 1.0)

    def forward(self, x, dt, u=None):
        return x[..., :2]


class OneForAll(Weights):
    """One weight for a whole measurement, without the dimension of its elements."""

    def forward(self, residual, nis):
        return 1 / (1 + nis)


@pytest.mark.parametrize(
    ("f", "message"),
    [
        (lambda: presets.srckf(MOTION, Short()), r"Short.forward: expected measurements .*2\), received"),
        (lambda: presets.srckf(Shrinking(), SENSOR), r"Shrinking.forward: expected states"),
        (lambda: presets.rsrckf(MOTION, SENSOR, robust=OneForAll()), r"OneForAll.forward: expected weights"),
    ],
)  # fmt: skip
def test_models_that_give_the_wrong_shape_are_named(f, message):
    with pytest.raises(ValueError, match=message):
        f()(Z, PRIOR)


class Multiplying(Position):
    """Multiplies by a matrix that does not fit."""

    def forward(self, x, u=None):
        return x @ torch.ones(3, 2).to(x)


class Wide(ConstantVelocity):
    """Its transition and its process noise are those of other states."""

    def __init__(self, part):
        super().__init__(1.0)
        self.part = part

    def transition(self, dt):
        return torch.eye(6).to(dt) if self.part == "transition" else super().transition(dt)

    def process_noise(self, dt):
        return torch.eye(6).to(dt) if self.part == "noise" else super().process_noise(dt)


@pytest.mark.parametrize("compiled", [False, True])
def test_errors_inside_models_tell_whose_they_are(compiled):
    for motion, sensor, message in (
        (MOTION, Multiplying(1.0), r"Multiplying.forward: states \(.*2\) in torch.float64, u None: "),
        (Wide("transition"), SENSOR, r"Wide.transition: expected \(..., 4, 4\), received \(6, 6\)"),
        (Wide("noise"), SENSOR, r"Wide.process_noise: expected \(..., 4, r\), received \(6, 6\)"),
    ):
        f = presets.srckf(motion, sensor)
        with pytest.raises((ValueError, RuntimeError), match=message):
            (f.compile() if compiled else f)(Z, PRIOR)


@pytest.mark.parametrize(("mean", "root"), [(3, 4), (4, 3), (3, 3)])
def test_a_filter_does_not_begin_with_a_belief_of_other_states(mean, root):
    said = rf"prior: expected \(..., 4\) and .*, received \({mean},\) and \({root}, {root}\)"
    with pytest.raises(ValueError, match=said):
        presets.srckf(MOTION, SENSOR).init(Gaussian(torch.zeros(mean), torch.eye(root)))


def test_values_without_entries_are_refused():
    with pytest.raises(ValueError, match=r"threshold: expected one value or more, received none, \(0,\)"):
        presets.rsrckf(MOTION, SENSOR, threshold=torch.zeros(0))


def test_noise_of_missing_elements_may_leave_the_others_with_a_singular_root():
    f = presets.srckf(MOTION, Position(noise=torch.eye(2).double()))
    root = torch.tensor([[1.0, 2.0], [2.0, 4.0]]).double().expand(6, 2, 2)
    with pytest.raises(ValueError, match=r"noise: expected roots .* received \[\[1.0, 2.0\], \[2.0, 4.0\]\] at \(0,\)"):
        f(Z, PRIOR, noise=root)
    z = Z.clone()
    z[:, 0] = torch.nan
    assert not f(z, PRIOR, noise=root).failed
    of_the_first = torch.tensor([[1.0, 0.0], [3.0, 0.0]]).double().expand(6, 2, 2)
    assert not f(z, PRIOR, noise=of_the_first).failed


class Station(RangeBearing):
    """Asks for what the docstring of a sensor promises: states and what goes with a step have the same batch."""

    def forward(self, x, u=None):
        assert u.shape[:-1] == x.shape[:-1]
        return super().forward(x, u)


@pytest.mark.parametrize("shape", [(5, 2), (3, 5, 2)])
def test_in_scans_too_a_sensor_gets_the_shapes_that_it_is_promised(shape):
    sensor = Station(torch.tensor([5.0, 0.01]).double())
    pair = presets.jpda(MOTION, sensor, clutter=Clutter(1e6), gate=Euclidean(500.0))
    mean = torch.tensor([[300.0, 400.0, 0.0, 0.0], [-300.0, 400.0, 0.0, 0.0]]).double().expand(3, 2, 4)
    z = torch.tensor([[500.0, math.atan2(3, 4)], [500.0, -math.atan2(3, 4)]]).double().expand(3, 5, 2, 2)
    estimate = pair(z, Gaussian(mean, torch.eye(4).double()), u=torch.zeros(shape).double())
    assert estimate.mean.isfinite().all()


def test_parts_of_fra_may_be_replaced_by_ones_with_a_batch_of_values():
    scenario = scenarios.bearings_outliers("std", initial="truth")
    tracks = scenario.simulate(3, 0)
    thresholds = torch.tensor([1.0, 2.0, 3.0]).double()
    f = presets.fra(scenario.motion, scenario.sensor)
    f.robust = Huber(thresholds)
    whole = f(tracks.z, tracks.prior, u=tracks.u).mean
    for i, threshold in enumerate(thresholds):
        one = presets.fra(scenario.motion, scenario.sensor, threshold=threshold)
        prior = Gaussian(tracks.prior.mean[i], tracks.prior.scale_tril)
        torch.testing.assert_close(one(tracks.z[i], prior, u=tracks.u).mean, whole[i])


@pytest.mark.parametrize(
    ("shape", "fits"), [((3,), False), ((3, 2), False), ((2,), True), ((1,), True), ((4, 1), True)]
)
def test_values_of_other_tracks_are_named(shape, fits):
    f = presets.srckf(ConstantVelocity(torch.ones(shape, dtype=torch.float64)), Position(2.0))
    z, prior = torch.zeros(2, 4, 2).double(), Gaussian(torch.zeros(2, 4).double(), torch.eye(4).double())
    if shape[-1] in (1, 2):
        assert f(z, prior).mean.shape == (*shape[:-1], 2, 4, 4)
        return
    said = rf"motion\.q: expected values that broadcast with tracks \((1, )?2,?\), received {re.escape(str(shape))}"
    for g in (f, copy.deepcopy(f).compile()):
        with pytest.raises(ValueError, match=said):
            g(z, prior)
        with pytest.raises(ValueError, match=said):
            g.step(g.init(prior), z[:, 0])


@pytest.mark.parametrize("value", ["prior_outlier", "prior_inflation"])
def test_a_grid_of_values_is_a_grid_of_tracks_whichever_value_it_is(value):
    values = {
        "prior_outlier": torch.tensor([[0.1], [0.2], [0.3]]),
        "prior_inflation": torch.tensor([[10.0], [100.0], [300.0]]),
    }[value].double()
    z = torch.randn(2, 4, 2, generator=torch.Generator().manual_seed(0)).double()
    prior = Gaussian(torch.zeros(2, 4).double(), torch.eye(4).double())
    whole = presets.gpb(ConstantVelocity(1.0), Position(2.0), **{value: values})(z, prior).mean
    assert whole.shape == (3, 2, 4, 4)
    for i, one in enumerate(values.flatten().tolist()):
        alone = presets.gpb(ConstantVelocity(1.0), Position(2.0), **{value: one})(z, prior).mean
        torch.testing.assert_close(whole[i], alone, rtol=1e-10, atol=1e-10)


def test_a_value_that_a_filter_does_not_read_still_says_of_which_tracks_it_is():
    f = presets.alphabeta(ConstantVelocity(torch.ones(3, 1).double()), Position(2.0))
    z, prior = torch.zeros(2, 4, 2).double(), Gaussian(torch.zeros(2, 4).double(), torch.eye(4).double())
    assert f(z, prior).mean.shape == copy.deepcopy(f).compile()(z, prior).mean.shape == (3, 2, 4, 4)

"""Whatever holds the numbers, a list, an array, a column or a tensor, filters, trackers and targets take it alike."""

import numpy as np
import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.association import Clutter
from torchfra.filters import FixedLag
from torchfra.motion import ConstantVelocity, Motion
from torchfra.sensors import Position, Sensor
from torchfra.stream import Tracker
from torchfra.targets import Targets

MOTION, SENSOR = ConstantVelocity(1.0), Position(2.0)
ROWS = [[0, 1], [9, 6], [22, 11], [30, 14]]
Z = torch.tensor(ROWS).double()
DT = [1, 1, 2, 1]
PRIOR = Gaussian.from_std([0, 0, 0, 0], [5, 5, 10, 10])


def columns(rows):
    """Of a data frame, rows with an index of their own."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame(np.array(rows), index=range(7, 7 + len(rows)))
    return frame if np.ndim(rows) > 1 else frame[0]


KINDS = {
    "lists": list, "arrays": np.array, "single precision": lambda rows: np.array(rows, dtype=np.float32),
    "whole numbers": torch.tensor, "columns": columns, "nullable columns": lambda rows: columns(rows).astype("Int64"),
}  # fmt: skip


@pytest.mark.parametrize("of", KINDS.values(), ids=KINDS)
@pytest.mark.parametrize("way", ["forward", "smooth"])
def test_whole_tracks_from_any_kind_of_numbers_are_the_same(of, way):
    f = presets.srckf(MOTION, SENSOR)
    prior = Gaussian(of([0, 0, 0, 0]), of(np.diag([5, 5, 10, 10]).tolist()))
    found = getattr(f, way)(of(ROWS), prior, dt=of(DT), std=of([[3, 3]] * 4))
    plain = getattr(f, way)(Z, PRIOR, dt=torch.tensor(DT).double(), std=torch.full_like(Z, 3.0))
    torch.testing.assert_close(found.mean, plain.mean)
    torch.testing.assert_close(found.scale_tril, plain.scale_tril)


def without_one(kind):
    """The rows without their first number."""
    if kind == "masked":
        return np.ma.MaskedArray(ROWS, mask=[[True, False]] + [[False, False]] * 3)
    table = columns(ROWS).astype("Int64")
    table.iloc[0, 0] = None
    return table


@pytest.mark.parametrize("kind", ["masked", "of pandas"])
def test_what_is_masked_is_missing(kind):
    f, z = presets.gpb(MOTION, SENSOR), Z.clone()
    z[0, 0] = torch.nan
    torch.testing.assert_close(f(without_one(kind), PRIOR).mean, f(z, PRIOR).mean)


@pytest.mark.parametrize("of", [list, np.array, torch.tensor], ids=["lists", "arrays", "whole numbers"])
def test_steps_streams_and_targets_from_any_kind_of_numbers_are_the_same(of):
    def results(of, prior, rows):
        f = presets.gpb(MOTION, SENSOR)
        state, lagged = f.init(prior), FixedLag(f, 1)
        stated, late, tracker = state, lagged.init(prior), Tracker(f, prior)
        for time, row in enumerate(rows):
            state, _ = f.step(state, of(row), dt=of([2])[0])
            stated, _ = f.step(stated, of(row), std=of([3, 3]))
            late, _ = lagged.step(late, of(row))
            tracker.update(time + 1, of(row))
        manager = Targets(presets.jpda(MOTION, SENSOR, clutter=Clutter(extent=[1e3, 1e3], rate=1.0)))
        targets = manager.init()
        for _ in range(4):
            targets = manager.step(targets, of(rows), dt=2)
        scans = manager(of([rows] * 4), dt=of([2] * 4))
        ahead = f.predict(state, of([2])[0]).belief
        return [*state.belief, *stated.belief, *late.lagged, *tracker.belief, *ahead, *targets.belief, *scans[:2]]

    given = results(of, Gaussian(of([0, 0, 0, 0]), of(np.diag([5, 5, 10, 10]).tolist())), ROWS)
    plain = results(lambda rows: torch.tensor(rows).double(), PRIOR, ROWS)
    for a, b in zip(given, plain, strict=True):
        torch.testing.assert_close(a, b, equal_nan=True)


def test_a_stream_takes_a_row_of_a_table_that_misses_a_number():
    f = presets.gpb(MOTION, SENSOR)
    table, plain = Tracker(f, PRIOR), Tracker(f, PRIOR)
    table.update(1.0, without_one("of pandas").iloc[0])
    plain.update(1.0, [torch.nan, 1.0])
    torch.testing.assert_close(table.belief.mean, plain.belief.mean)


# ---------------------------------------------------------------- beliefs


def test_a_belief_from_standard_deviations_has_their_squares_as_variances():
    belief = Gaussian.from_std([1, 2], [3, 0])
    assert belief.mean.tolist() == [1, 2]
    assert belief.covariance.tolist() == [[9, 0], [0, 0]]
    assert Gaussian.from_std(np.zeros((5, 2)), 2).covariance[3].tolist() == [[4, 0], [0, 4]]
    assert Gaussian.from_std(torch.zeros(2), [1.0, 2.0]).scale_tril.dtype == torch.float32


@pytest.mark.parametrize(
    "covariance", [[[4, 2, 0], [2, 9, 0], [0, 0, 0]], [[1, 1, 0], [1, 1, 0], [0, 0, 2]], np.zeros((3, 3))]
)
def test_a_belief_may_know_components_and_sums_of_them(covariance):
    belief = Gaussian.from_covariance([0, 0, 0], covariance)
    np.testing.assert_allclose(belief.covariance, covariance, atol=1e-15)
    state = presets.srckf(MOTION, SENSOR).init(Gaussian.from_covariance(np.zeros(4), np.diag([1, 1, 0, 0])))
    assert state.belief.covariance[2:].abs().sum() == 0


def test_a_covariance_has_gradients_beside_what_is_known():
    covariance = torch.tensor([[4.0, 2.0, 0.0], [2.0, 9.0, 0.0], [0.0, 0.0, 0.0]]).double().requires_grad_()
    belief = Gaussian.from_covariance(torch.zeros(3).double(), covariance)
    weight = torch.arange(9.0).double().reshape(3, 3)
    (slope,) = torch.autograd.grad((belief.covariance * weight).sum(), covariance)
    np.testing.assert_allclose(slope[:2, :2], (weight + weight.mT)[:2, :2] / 2, atol=1e-12)
    assert slope.isfinite().all()


FULL = torch.tensor([[2.0, 1, 0, 0], [1, 2, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]).double()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda f: f(Z, Gaussian(PRIOR.mean, FULL)), r"prior\.scale_tril: .* as a covariance is: take"),
        (lambda f: f.init(Gaussian(PRIOR.mean, FULL)), r"prior\.scale_tril: expected a triangular root"),
        (lambda f: Tracker(f, Gaussian(PRIOR.mean, FULL)), r"prior\.scale_tril: expected a triangular root"),
        (lambda f: Gaussian.from_std([0, 0], [1, -1]), r"std: expected finite numbers of 0 or more"),
        (lambda f: Gaussian.from_std([0, 0], [1, 1, 1]), r"mean, std: expected \(\.\.\., n\) and .*\(2,\) and \(3,\)"),
        (lambda f: Gaussian.from_covariance([0, 0], np.eye(3)), r"mean, covariance: expected .*\(2,\) and \(3, 3\)"),
        (lambda f: Gaussian.from_covariance([0, 0], [[0, 1], [1, 2]]), r"covariance: expected a symmetric positive"),
        (lambda f: f(Z[:0], PRIOR), r"z: expected 1 step or more in \(\.\.\., T, 2\), received none, \(0, 2\)"),
        (lambda f: f([[[0, 0]], [[0, 0], [1, 1]]], PRIOR), r"z: .*several lengths: take torch\.nn"),
        (lambda f: f(torch.nested.nested_tensor([Z, Z[:2]], layout=torch.jagged), PRIOR), r"z: .* nested one: take"),
        (lambda f: presets.gpb(torch.nn.Linear(4, 4), SENSOR), r"motion: .* received Linear, which these lines"),
        (lambda f: presets.gpb(MOTION, torch.nn.Linear(4, 2)), r"sensor: .* received Linear, which these lines"),
    ],
)  # fmt: skip
def test_what_cannot_be_right_is_told_with_what_to_hand_in(call, message):
    with pytest.raises(ValueError, match=message):
        call(presets.srckf(MOTION, SENSOR))


def test_padded_as_the_messages_say_tracks_of_several_lengths_are_filtered():
    tracks, f = [Z, Z[:2]], presets.srckf(MOTION, SENSOR)
    ways = (
        torch.nn.utils.rnn.pad_sequence([torch.as_tensor(track) for track in tracks], True, torch.nan),
        torch.nested.to_padded_tensor(torch.nested.nested_tensor(tracks, layout=torch.jagged), torch.nan),
    )
    for z in ways:
        torch.testing.assert_close(f(z, PRIOR).mean[1, :2], f(Z[:2], PRIOR).mean)


@pytest.mark.parametrize("name", ["motion", "sensor"])
def test_the_lines_in_the_message_make_a_module_a_model(name):
    module = torch.nn.Linear(4, 4).double() if name == "motion" else torch.nn.Linear(2, 2).double()
    with pytest.raises(ValueError, match="these lines") as told:
        presets.srckf(*((module, SENSOR) if name == "motion" else (MOTION, module)))
    import torchfra

    scope = {"torchfra": torchfra}
    exec("\n".join(line[4:] for line in str(told.value).splitlines()[1:]), scope)
    mine = scope["Mine"](module)
    assert isinstance(mine, Motion | Sensor)
    assert presets.srckf(*((mine, SENSOR) if name == "motion" else (MOTION, mine)))(Z, PRIOR).mean.isfinite().all()

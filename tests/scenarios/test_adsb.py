"""The ADS-B experiment is what its paper says of it, and interacting models do in it what was found before."""

import pytest
import torch

from torchfra import presets
from torchfra.scenarios import adsb_models, adsb_turns


def test_the_track_goes_where_its_legs_lead():
    truth = adsb_turns().simulate(1, 0).truth[0]

    def at(seconds):
        return truth[round(seconds / 2) - 3, :4]  # the first two reports start the filter

    known = {400: (6000, 2000, 15, 0), 600: (7500, 3500, 0, 15), 610: (7500, 3650, 0, 15), 660: (7875, 4025, 15, 0),
             900: (11475, 4025, 15, 0)}  # fmt: skip
    for seconds, state in known.items():
        torch.testing.assert_close(at(seconds), torch.tensor(state, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("turns", ["acceleration", "arc"])
def test_velocity_and_acceleration_are_the_slopes_of_what_they_should_be(turns):
    truth = adsb_turns(turns).simulate(1, 0).truth[0]
    moved = truth[1:, :4] - truth[:-1, :4]
    smooth = (truth[1:, 4:] - truth[:-1, 4:]).norm(dim=-1) < 0.05
    torch.testing.assert_close(moved[smooth, :2] / 2, (truth[1:, 2:4] + truth[:-1, 2:4])[smooth] / 2, rtol=0, atol=0.1)
    torch.testing.assert_close(moved[smooth, 2:] / 2, (truth[1:, 4:] + truth[:-1, 4:])[smooth] / 2, rtol=0, atol=0.01)
    if turns == "arc":
        torch.testing.assert_close(truth[:, 2:4].norm(dim=-1), torch.full((448,), 15.0, dtype=torch.float64))


def test_filters_start_from_the_first_two_reports():
    scenario = adsb_turns(std=20.0)
    tracks = scenario.simulate(2000, 0)
    error = tracks.prior.mean[:, :2] - torch.tensor([60.0, 2000.0], dtype=torch.float64)  # at 4 s
    assert error.std() == pytest.approx(20, rel=0.05)
    assert (tracks.prior.mean[:, 2] - 15).std() == pytest.approx(20 * 2**0.5 / 2, rel=0.05)
    covariance = tracks.prior.scale_tril @ tracks.prior.scale_tril.mT
    torch.testing.assert_close(covariance[0, [0, 2]], torch.tensor([400.0, 200.0], dtype=torch.float64))


@pytest.mark.slow
def test_three_and_five_models_err_as_much_as_they_should():
    """Root mean square error in x and y from sample 21 on: 12.1 / 14.1 and 13.5 / 13.9 m, of other runs."""
    scenario = adsb_turns()
    tracks = scenario.simulate(100, 5)
    for count, known in ((5, (12.10, 14.10)), (3, (13.45, 13.89))):
        f = presets.imm(adsb_models()[:count], scenario.sensor).compile()
        with torch.no_grad():
            e = f(tracks.z, tracks.prior, dt=scenario.dt)
        found = (e.mean - tracks.truth)[:, 18:, :2].square().mean(0).sqrt().mean(0)
        assert found.tolist() == pytest.approx(known, rel=0.1)


def test_arguments_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match=r"turns: expected one of .*, received 'spiral'"):
        adsb_turns("spiral")
    with pytest.raises(ValueError, match="std: expected metres above 0"):
        adsb_turns(std=0.0)

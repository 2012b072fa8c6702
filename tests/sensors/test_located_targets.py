"""Where a measurement locates a target is where it is seen so, and a metre there changes it by as much as is said."""

import pytest
import torch

from torchfra.coordinates import from_cartesian
from torchfra.sensors import Correlated, InfraredLaser, Position, RangeBearing

PLACES = 500 * torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
FROM = torch.tensor([30.0, -20.0, 5.0]).double()
SENSORS = [
    Position(2.0), Position(2.0, dims=3), RangeBearing((2.0, 0.01)), RangeBearing((2.0, 0.01, 0.01), dims=3),
    RangeBearing((2.0, 0.01), position=FROM[:2]), RangeBearing((2.0, 0.01, 0.01), dims=3, position=FROM),
    InfraredLaser((0.01, 0.01, 2.0)), Correlated(RangeBearing((2.0, 0.01)), 0.1, 30.0),
]  # fmt: skip
each = pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: f"{sensor.describe()}, {sensor.dims}")


def measured(sensor, place):
    """The measurement of a target at rest."""
    if isinstance(sensor, InfraredLaser):
        return sensor(from_cartesian(torch.cat([place, torch.zeros_like(place)], -1)))
    return sensor(place)


@each
def test_a_target_is_located_where_it_is_seen(sensor):
    place = PLACES[:, : sensor.dims]
    torch.testing.assert_close(sensor.locate(measured(sensor, place)), place)


@each
def test_an_element_changes_by_its_units_per_metre_in_the_direction_in_which_it_changes_most(sensor):
    if not sensor.measures_each_direction:
        return
    place = PLACES[:, : sensor.dims]
    slope = torch.func.vmap(torch.func.jacrev(lambda x: measured(sensor, x)))(place)
    units = sensor.units_per_metre(measured(sensor, place)).expand(len(place), -1)
    torch.testing.assert_close(slope.norm(dim=-1), units.abs())

"""Nothing of the catalogue is refused: every filter of a scenario becomes expressions of a kernel."""

import pytest

from torchfra.catalogue import SCENARIOS, filters_for, scenario_filter
from torchfra.gaussian.inputs import Measurements


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["growth", "reentry", "clutter-straight"])
def test_every_filter_of_a_scenario_is_traced(scenario):
    """Without a compiler, which would take minutes; other scenarios are compiled elsewhere."""
    scenario = SCENARIOS[scenario]()
    tracks = scenario.simulate(runs=1, seed=0)
    for name in filters_for(scenario):
        f = scenario_filter(name, scenario).compile()
        _, plan, _ = f.engine._plan(f, f.init(tracks.prior), Measurements(tracks.z, 1.0, tracks.u), False)
        assert len(plan.kernels.step.forwards().live()) > 50, name

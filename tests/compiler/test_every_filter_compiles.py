"""Nothing of the catalogue is refused: every filter of a scenario becomes expressions of a kernel."""

import pytest
import torch

from torchfra import Gaussian, presets
from torchfra.catalogue import SCENARIOS, filters_for, scenario_filter
from torchfra.gaussian.inputs import Measurements
from torchfra.motion import RandomWalk
from torchfra.sensors import Ranges


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "names"), [
    ("growth", None), ("reentry", ["hghckf2"]), ("clutter-straight", None),
])  # fmt: skip
def test_every_filter_of_a_scenario_is_traced(scenario, names):
    """Without a compiler, which would take minutes; other scenarios are compiled elsewhere."""
    scenario = SCENARIOS[scenario]()
    tracks = scenario.simulate(runs=1, seed=0)
    for name in names or filters_for(scenario):  # one: of what models of that scenario are made
        f = scenario_filter(name, scenario).compile()
        assert expressions(f, tracks.prior, tracks.z, tracks.u) > 50, name


def expressions(f, prior, z, u=None):
    """How many a step is."""
    _, task, _ = f.engine._task(f, f.init(prior), Measurements(z, 1.0, u), False)
    return len(task.kernels.step.forwards().live())


def test_a_step_of_gpb_grows_with_the_ranges_and_not_with_their_square():
    prior = Gaussian(torch.zeros(2).double(), torch.eye(2).double())

    def of_ranges(count):
        anchors = torch.arange(2.0 * count).reshape(count, 2)
        f = presets.gpb(RandomWalk(1.0, dims=2), Ranges(anchors, 1.0), manoeuvres="none").compile()
        return expressions(f, prior, torch.ones(3, count).double())

    few, some, many = map(of_ranges, (1, 2, 4))
    assert many - some < 2.4 * (some - few)

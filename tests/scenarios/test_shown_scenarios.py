"""What is shown of a scenario can be read: its models and settings, and not how each of its steps is simulated."""

import pytest

from torchfra.catalogue import SCENARIOS, make_scenario


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_scenario_is_shown_in_some_lines(name):
    shown = str(make_scenario(name))
    assert name in shown
    assert "motion=" in shown
    assert "sensor=" in shown
    assert len(shown.splitlines()) < 80

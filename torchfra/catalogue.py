"""Filters and scenarios by name: those of the library, and what ``register`` adds to them."""

from __future__ import annotations

import copy
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchfra import scenarios, state_files
from torchfra.filters.alphabeta.axes import measures_positions, moves_along_axes
from torchfra.filters.base import Filter
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.register import SCENARIOS as SCENARIOS
from torchfra.register import FilterEntry, filters, made
from torchfra.scenarios.base import Scenario
from torchfra.sensors.base import Sensor
from torchfra.suggestions import meant

FILTERS = filters()
SCENARIOS.update({
    "bearings-outliers": scenarios.bearings_outliers,
    "bearings-manoeuvre": scenarios.bearings_manoeuvre,
    "adsb-turns": scenarios.adsb_turns,
    "alpha-beta": scenarios.level_then_weave,
    "clutter-straight": scenarios.clutter_straight,
    "clutter-crossing": scenarios.clutter_crossing,
    "noise-change": scenarios.noise_change,
    "growth": scenarios.growth,
    "reentry": scenarios.reentry,
    "ranges-outliers": scenarios.ranges_outliers,
    "as-stated": scenarios.as_stated,
})  # fmt: skip


def track_filters() -> list[str]:
    """The filters of single targets that commands list."""
    return [name for name, entry in FILTERS.items() if entry.listed and not entry.scans]


def scan_filters() -> list[str]:
    """The filters of several targets in scans that commands list."""
    return [name for name, entry in FILTERS.items() if entry.listed and entry.scans]


def reference_filter(scenario: Scenario) -> str:
    """The filter that run times are relative to."""
    return "ukf" if scenario.clutter is None else "ukf_jpda"


def filters_for(scenario: Scenario) -> list[str]:
    """The filters that go with the measurements and the models of a scenario."""
    if scenario.clutter is not None:
        return scan_filters()
    return [name for name in track_filters() if _go_together(FILTERS[name], scenario)]


def _go_together(entry: FilterEntry, scenario: Scenario) -> bool:
    """Whether a filter of single targets can be made around the models of a scenario."""
    motion, sensor, bank = scenario.motion, scenario.sensor, scenario.bank
    if entry.constant_gains:
        return measures_positions(sensor) and moves_along_axes(motion, sensor.size)
    return not entry.bank or (bank is not None and (not entry.neighbours or bank.neighbours is not None))


def check_names(names: Sequence[str], scenario: Scenario) -> None:
    """Checks that there are filters of these names for the measurements of a scenario.

    Raises:
        ValueError: a name that is not in ``FILTERS`` or takes other measurements, or no name at all.
    """
    scans = scenario.clutter is not None
    known = scan_filters() if scans else track_filters()
    unknown = [name for name in names if name not in FILTERS or FILTERS[name].scans != scans]
    if unknown or not names:
        received = f"{', '.join(unknown) or 'none'}{meant(unknown[0], known) if unknown else ''}"
        raise ValueError(f"filters: expected some of {', '.join(known)}, received {received}")


def make_filter(name: str, motion: Motion, sensor: Sensor, bank: Bank | None = None, **options: Any) -> Filter:
    """The filter of this name around a motion, or around a bank of motions if that is what it takes.

    Args:
        name: of a filter of single targets.
        motion: for a filter of one motion.
        sensor: what is measured.
        bank: for a filter of several motions.
        options: of the preset.

    Raises:
        ValueError: an unknown name, or a filter of several motions where there is no bank.
    """
    if name not in FILTERS or FILTERS[name].scans:
        known = track_filters()
        raise ValueError(f"filter: expected one of {', '.join(known)}, received {name!r}{meant(name, known)}")
    entry = FILTERS[name]
    if entry.bank and bank is None:
        raise ValueError(f"filter: expected one of a single motion, as there is no bank of motions, received {name!r}")
    models = motion if bank is None or not (entry.bank or entry.either) else bank
    return made(name, entry.preset(models, sensor, **options), Filter, "(motion, sensor)")


def scenario_filter(name: str, scenario: Scenario, **options: Any) -> Filter:
    """The filter of this name around the models of a scenario.

    Raises:
        ValueError: an unknown name, or a filter that does not go with the scenario.
    """
    check_names([name], scenario)
    if scenario.clutter is None:
        return make_filter(name, scenario.motion, scenario.sensor, scenario.bank, **options)
    clutter = {"clutter": scenario.clutter, "detection": scenario.detection}
    f = FILTERS[name].preset(scenario.motion, scenario.sensor, **clutter | options)
    return made(name, f, Filter, "(motion, sensor)")


def scenario_filters(names: Sequence[str], scenario: Scenario) -> dict[str, Filter]:
    """The filters of these names around the models of a scenario.

    Raises:
        ValueError: an unknown name, or a filter that does not go with the scenario.
    """
    check_names(names, scenario)
    return {name: scenario_filter(name, scenario) for name in names}


def learned_filter(path: str | Path, scenario: Scenario, name: str = "fra", *, models: bool = True) -> Filter:
    """The filter ``name`` with values that were learned.

    Args:
        path: a state dictionary, as ``torch.save(f.state_dict(), path)`` writes it; a ``config.json`` beside it, of a
            training run with this filter, says what the filter was made with.
        scenario: whose models the filter gets, in copies with learned values.
        name: of the filter whose values they are.
        models: whether motion and sensor take their values too; False leaves them those of the scenario.

    Raises:
        OSError: the file cannot be read.
        ValueError: an unknown filter, a file that is damaged or no state dictionary of it, a value that is not finite
            or out of its range, or a ``config.json`` with other content.
    """
    f = _as_configured(Path(path).with_name("config.json"), scenario, name)
    try:
        values = state_files.read(path)
        state_files.load_values(f, values if models else _with_own_models(f, values))
    except ValueError as error:
        raise ValueError(f"learned: expected {path} to hold a state dictionary of {name}: {error}") from None
    return f


def _as_configured(config: Path, scenario: Scenario, name: str) -> Filter:
    """The filter, made with the options of a training run with it, if this is one."""
    f = scenario_filter(name, copy.deepcopy(scenario))
    if not config.exists():
        return f
    try:
        settings = json.loads(config.read_text())
        options = settings.get("options", {}) if settings.get("filter") == name else {}
        return scenario_filter(name, copy.deepcopy(scenario), **options) if options != {} else f
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        expected = f"expected the settings of a training run, received others ({error})"
        raise ValueError(f"learned: {config}: {expected}") from None


def _with_own_models(f: Filter, values: object) -> dict[str, Any]:
    """Values of a state dictionary, but those of motion and sensor from the filter itself."""

    def of_models(state: Mapping[str, Any]) -> set[str]:
        return {key for key in state if {"motion", "sensor"} & set(str(key).split("."))}

    own = f.state_dict()
    if not isinstance(values, Mapping):
        raise ValueError(f"expected tensors by name, received {type(values).__name__}")
    return {key: values[key] for key in values.keys() - of_models(values)} | {key: own[key] for key in of_models(own)}


def make_scenario(name: str, **options: Any) -> Scenario:
    """A simulated scenario by its name; an option that is None keeps the scenario's default.

    Raises:
        ValueError: an unknown name, or an option that the scenario does not take.
    """
    if name not in SCENARIOS:
        raise ValueError(f"scenario: expected one of {', '.join(SCENARIOS)}, received {name!r}{meant(name, SCENARIOS)}")
    return scenario_by(name, SCENARIOS[name], {key: value for key, value in options.items() if value is not None})


def scenario_by(name: str, make: Callable[..., Any], options: Mapping[str, Any]) -> Scenario:
    """The scenario that a function of this name makes.

    Raises:
        ValueError: the function does not take an option, or returns something else.
    """
    for key in sorted(options.keys() - inspect.signature(make).parameters.keys()):
        raise ValueError(f"{key}: {name} takes no such option, received {options[key]!r}")
    return made(name, make(**options), Scenario, "()")

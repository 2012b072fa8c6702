"""Views of a filter around other sensors, with the same motion, hyperparameters and states."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from torch import nn

from torchfra.filters.checks import check_models
from torchfra.gaussian.inputs import Frame
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian

_VIEWS = 32
"""Number of views that a filter keeps.  With a new sensor for every step, every step makes a new view."""


class View:
    """Mixed into a view of a filter around another sensor; its states are those of the ``viewed`` filter.

    The memory of a filter (of recent innovations, of outliers in the last measurement) is of its own sensor: a step of
    a view neither uses nor changes it.
    """

    viewed: Any = None
    around: Any = None
    """The sensor that it was asked for."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _view, (self.viewed, self.around)  # its class has no name that pickle would find

    def begin(self, belief: Gaussian) -> Any:
        """The state of a belief."""
        return self.viewed.begin(belief)

    def advance(self, state: Any, frame: Frame, *mix: Any) -> tuple[Any, Any]:
        """One step, from a state with an empty memory; the next state has the memory of the one before."""
        parent: Any = super()
        after, record = parent.advance(parent.without_memory(state), frame, *mix)
        return parent.with_memory_of(after, state), record

    def with_sensor(self, sensor: Sensor | None) -> Any:
        """A view of the viewed filter around another sensor."""
        return self.viewed.with_sensor(sensor)


class SensorViews:
    """A filter's views around other sensors; each is made at the first call for its sensor."""

    def __init__(self) -> None:
        self._views: dict[int, Any] = {}

    def __reduce__(self) -> tuple[type[SensorViews], tuple[()]]:
        return SensorViews, ()  # a copy of the filter makes its own

    def __call__(self, f: Any, sensor: Sensor) -> Any:
        """The view of ``f`` around ``sensor``, brought up to date with the filter."""
        view = self._views.pop(id(sensor), None)
        if view is None or any(f._modules[name] is not part for name, part in view.replaced.items()):
            check_models(f.motion, sensor)
            parts = f.parts_for(sensor)
            view = sharing(f, mixed(View, f.__class__), engine=f.engine.another(), **parts)
            view.__dict__.update(
                viewed=f, around=sensor, replaced={name: f._modules[name] for name in parts if name != "sensor"}
            )
            if len(self._views) == _VIEWS:  # the one that was used least recently goes
                self._views.pop(next(iter(self._views)))
        self._views[id(sensor)] = view
        share(f, view)
        for name, part in view.replaced.items():
            if hasattr(part, "with_sensor"):
                view._modules[name] = part.with_sensor(sensor)
            else:
                share(part, view._modules[name])
        if type(f.engine) is not type(view.engine):
            view.engine = f.engine.another()
        return view


def _view(f: Any, sensor: Sensor) -> Any:
    """A copy of a view, of a copy of its filter."""
    return f.with_sensor(sensor)


@lru_cache(maxsize=64)
def mixed(mixin: type, cls: Any) -> type:
    """A filter's class with another mixed into it."""
    return type(cls.__name__, (mixin, cls), {})


def sharing(module: nn.Module, cls: type, **own: Any) -> Any:
    """A module of class ``cls`` that shares all parts and values of ``module`` except those in ``own``, without copies.

    Modules in ``own`` become its parts, other values its attributes.
    """
    new: Any = module.__new__(cls)
    new.__dict__.update(_modules={}, _own=frozenset(own))
    share(module, new)
    for name, x in own.items():
        (new._modules if isinstance(x, nn.Module) else new.__dict__)[name] = x
    return new


def share(module: nn.Module, new: Any) -> None:
    """Updates a module made by ``sharing`` with the current parts and values of the original."""
    if "_own" not in new.__dict__:
        return  # a rule of points, which ``parts_for`` has made for the other sensor, shares nothing
    own: frozenset[str] = new._own | {"_modules"}
    new.__dict__.update({name: x for name, x in module.__dict__.items() if name not in own})
    new._modules.update({name: x for name, x in module._modules.items() if name not in own})

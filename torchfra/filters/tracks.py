# ruff: noqa: D102
"""The base of filters whose backward step is called ``smooth_step``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from torchfra.filters.ahead import only
from torchfra.filters.base import Filter, S
from torchfra.filters.records import Past, Smoothed
from torchfra.gaussian.inputs import BackwardStep, Frame
from torchfra.types import Gaussian


class GaussianFilter(Filter[S]):
    """Abstract: see ``Filter``."""

    if TYPE_CHECKING:

        def past(self, belief: Gaussian, info: Any, state: Any, steps: Any) -> Past: ...
        def fresh(self, past: Past) -> Past: ...
        def decided(self, past: Past) -> Past: ...
        def needed_ahead(self, past: Past) -> Past: ...
        def last(self, past: Past) -> tuple[Gaussian, Smoothed]: ...

    def predict_hypotheses(self, state: Any, frame: Frame) -> tuple[Gaussian, Tensor]:
        """The only hypothesis of the state after a step, and the log of its weight."""
        return only(self.predicted(state.belief, frame).belief)

    def retreat(self, step: BackwardStep, after: Any) -> tuple[Any, Smoothed]:
        """One step of the backward pass."""
        return self.smooth_step(step, after)

    def smooth_step(self, step: BackwardStep, after: Gaussian) -> tuple[Gaussian, Smoothed]:
        """One step of the backward pass."""
        return super().retreat(step, after)

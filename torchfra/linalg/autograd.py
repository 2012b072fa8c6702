"""What torch hands to the passes of a function of its autograd, which torch itself does not type."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Context(Protocol):
    """Holds what the forward pass saves for the backward one; further values are attributes of it."""

    saved_tensors: tuple[Tensor, ...]
    needs_input_grad: tuple[bool, ...]

    def save_for_backward(self, *tensors: Tensor) -> None:
        """Saves tensors for ``backward``."""

    def save_for_forward(self, *tensors: Tensor) -> None:
        """Saves tensors for ``jvp``."""

    def set_materialize_grads(self, value: bool) -> None:
        """Whether gradients that are None become zeros."""

    def mark_non_differentiable(self, *outputs: Tensor) -> None:
        """Says that results have no gradients."""

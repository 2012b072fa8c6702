"""Linear sensors by their matrices."""

from __future__ import annotations

from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.entries import Entries
from torchfra.linalg.covariance import covariance_root
from torchfra.linalg.triangular import apply
from torchfra.numbers import as_numbers
from torchfra.sensors.base import Sensor


class Linear(Sensor):
    """A measurement that is a matrix times the state, ``z = H x + v`` with ``v`` of covariance ``R``.

    An entry of ``H`` may be a ``Hyper``, with a constraint, which learns; so does ``std`` where ``R`` are variances.
    With one ``H`` for each step, as of a regression, these are the last of the inputs:
    ``f(z, prior, u=sensor.inputs())``, or ``u=torch.cat([motion.inputs(), sensor.inputs()], -1)`` where the motion has
    inputs too.  Where the noise differs from step to step, pass ``std=`` or ``noise=`` to the filter.

    Args:
        H: ``(m, n)``, or ``(T, m, n)`` or ``(..., T, m, n)`` for each step.
        R: covariance ``(m, m)`` of the measurement noise, ``(m,)`` variances, or a number for all elements.

    Raises:
        ValueError: matrices that do not fit each other, or an ``R`` that is no covariance or has no inverse; in a step,
            ``u`` that is missing.

    Source: Kalman (1960), "A New Approach to Linear Filtering and Prediction Problems".

    Example:
        >>> torchfra.sensors.Linear([[1, 0.5]], 0.1)(torch.tensor([1.0, 2.0]))
        tensor([2.])
    """

    def __init__(self, H: ArrayLike, R: ArrayLike) -> None:
        matrix = Entries(H, "H")
        if matrix.fixed.dim() < 2 or (matrix.fixed.dim() > 2 and matrix.places):
            raise ValueError(f"H: expected a matrix (m, n), received {tuple(matrix.shape)}")
        m, n = matrix.shape[-2:]
        noise = as_numbers(R, "R").double()
        if noise.shape not in ((), (m,), (m, m)):
            hint = ": pass std= or noise= to the filter where it differs from step to step" if noise.dim() > 2 else ""
            raise ValueError(
                f"R: expected ({m}, {m}), ({m},) variances or a number, received {tuple(noise.shape)}{hint}"
            )
        if noise.dim() < 2:
            if not bool((noise > 0).all()):
                raise ValueError(f"R: expected variances above 0, received {noise.tolist()}")
            super().__init__(n, [False] * m, noise.sqrt())
        else:
            super().__init__(n, [False] * m, noise=covariance_root(noise, "R"))
        fixed = matrix.fixed.dim() == 2
        self.H: Entries | None = matrix if fixed else None
        self.each: Entries | None = None if fixed else matrix

    @property
    def linear(self) -> bool:  # type: ignore[override]  # of this sensor, not of the class
        """Whether one matrix is that of all steps."""
        return self.H is not None

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """``H x (..., m)`` of states ``x (..., n)``.

        ``u (..., k)`` ends with the matrix of the step, row by row, if that differs from step to step.
        """
        x = x[..., : self.reads]
        if self.H is not None:
            return apply(self.H(x), x)
        count = self.size * self.reads
        if u is None or u.shape[-1] < count:
            expected = f"(..., {count}) or more, sensor.inputs(), as H differs from step to step"
            raise ValueError(f"u: expected {expected}, received {None if u is None else tuple(u.shape)}")
        return apply(u[..., u.shape[-1] - count :].unflatten(-1, (self.size, self.reads)).to(x), x)

    def inputs(self) -> Tensor:
        """The inputs ``u (..., T, m n)`` of all steps: the matrices, row by row.

        Raises:
            ValueError: one matrix is that of all steps.
        """
        if self.each is None:
            raise ValueError("inputs: expected H with one matrix for each step, received a fixed one")
        matrices: Tensor = self.each.fixed.flatten(-2)
        return matrices

"""Linear motions by their matrices."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import signature
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn
from torch.distributions import constraints

from torchfra.entries import Entries
from torchfra.hyper import Hyper, one_given
from torchfra.linalg.covariance import covariance_root
from torchfra.linalg.triangular import apply
from torchfra.motion.base import Motion
from torchfra.numbers import as_numbers

Function = Callable[..., Tensor]
Values = ArrayLike | Sequence["float | Hyper"] | Sequence[Sequence["float | Hyper"]]
"""Numbers, of which some may be hyperparameters."""


class Linear(Motion):
    """A linear motion by its matrices, ``x' = F x + B u + w`` with ``w`` of covariance ``Q``.

    A matrix is fixed, one for each step, or a function of the time between steps::

        Linear([[1, 1], [0, 1]], [0.1, 0.01])                         one step of a level and a slope
        Linear(F, Q)                                                  F (T, n, n): one for each step
        Linear(lambda dt: matrix_exp(A * dt[..., None, None]), Q)     in continuous time

    Fixed matrices are those of one step, however long it is; after a ``dt`` of 0 the state is as it was, so that
    ``dt = [0, 1, 1, ...]`` begins with a measurement at the time of the prior.  An entry of ``F``, ``B`` or ``root``,
    and a variance, may be a ``Hyper``, with a constraint, which learns::

        Linear([[Hyper(0.9, constraints.interval(-1, 1), learn=True)]], [Hyper(0.5)], components=["level"])

    Matrices that differ from step to step are part of the inputs, so that a filter in a loop has them too:
    ``f(z, prior, u=motion.inputs())``, with ``motion.inputs(control)`` where there is a ``B``.

    Args:
        F: transition ``(n, n)``, or ``(T, n, n)`` or ``(..., T, n, n)`` for each step, or a function of ``dt (...)``,
            or of ``dt (...)`` and ``u (..., k)``, that gives ``(..., n, n)``.
        Q: covariance ``(n, n)`` of the process noise, of any rank, or ``(n,)`` variances, for each step with ``T`` in
            front, or such a function that gives ``(..., n, n)``.
        root: instead of ``Q``, a root ``(n, r)`` of the covariance, in the same ways.
        B: ``(n, k)`` matrix of the control ``u (..., k)``.
        dims: number of positions, the first components; as many velocities follow, as far as there are components.
            None for a state without positions, which a map or a model for targets cannot read.
        components: names of the components of the state.
        kinds: kinds of the components, of ``torchfra.motion.KINDS``.
        size: components of the state; needed where ``F`` is a function of ``u``.

    Raises:
        ValueError: matrices that do not fit each other, a ``Q`` that is no covariance, both or neither of ``Q`` and
            ``root``; in a step, ``u`` that is missing or of another size.

    Source: Kalman (1960), "A New Approach to Linear Filtering and Prediction Problems".

    Example:
        >>> level = torchfra.motion.Linear([[1, 1], [0, 1]], [0.1, 0.01], components=["level", "slope"])
        >>> level(torch.tensor([5.0, 2.0]), torch.tensor(1.0))
        tensor([7., 2.])
    """

    linear = True

    def __init__(
        self,
        F: Values | Function,
        Q: Values | Function | None = None,
        *,
        root: Values | Function | None = None,
        B: Values | None = None,
        dims: int | None = None,
        components: Sequence[str] | None = None,
        kinds: Sequence[str] | None = None,
        size: int | None = None,
    ) -> None:
        name, noise = one_given(Q=Q, root=root)
        matrix = _part(F, "F")
        if size is None:
            size = _size(matrix, components)
        nowhere = slice(0, 0)
        where = {} if dims is not None else {"position": nowhere, "velocity": nowhere}
        names = [f"x{i}" for i in range(size)] if dims is None and components is None else components
        orders = 1 if dims is None else max(size // max(dims, 1), 1)
        super().__init__(dims or 1, orders, None, size=size, components=names, kinds=kinds, **where)  # type: ignore[arg-type]
        self.F, self.root, self.B = matrix, _noise(noise, name, size), None if B is None else Entries(B, "B")
        self.covariance = callable(noise) and name == "Q"
        for argument, part, shape in (
            ("F", self.F, (size, size)),
            (name, self.root, (size, None)),
            ("B", self.B, (size, None)),
        ):
            _check(argument, part, shape)
        steps = {len_ for part in (self.F, self.root) if (len_ := _steps(part)) is not None}
        if len(steps) > 1:
            raise ValueError(f"F, {name}: expected as many steps in both, received {' and '.join(map(str, steps))}")

    def transition(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """``F (..., n, n)`` for ``dt (...)`` and the inputs ``u (..., k)`` of a step."""
        matrix, fixed = self._of(self.F, dt, u)
        return torch.where(_still(dt), torch.eye(self.size).to(dt), matrix) if fixed else matrix

    def process_noise(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """Root of the process noise ``(..., n, r)`` for ``dt (...)`` and the inputs ``u (..., k)`` of a step."""
        root, fixed = self._of(self.root, dt, u)
        root = covariance_root(root, "Q") if self.covariance else root
        return torch.where(_still(dt), 0.0, root) if fixed else root

    def shift(self, dt: Tensor, u: Tensor | None) -> Tensor | None:
        """``B u (..., n)`` for the control in ``u (..., k)``, 0 for a ``dt`` of 0; None without ``B``."""
        if self.B is None:
            return None
        first = self._own
        if u is None or u.shape[-1] < first + self.B.shape[-1]:
            raise ValueError(
                f"u: expected (..., {first + self.B.shape[-1]}), received {None if u is None else tuple(u.shape)}"
            )
        shift = apply(self.B(u), u[..., first : first + self.B.shape[-1]])
        return torch.where(_still(dt).squeeze(-1), 0.0, shift)

    def inputs(self, control: Tensor | None = None) -> Tensor:
        """The inputs ``u (..., T, k)`` of all steps: the matrices that differ from step to step, then the control.

        Args:
            control: ``(..., T, k)``; None for none.

        Raises:
            ValueError: nothing differs from step to step.
        """
        each = [part.each.flatten(-2) for part in (self.F, self.root) if isinstance(part, _EachStep)]
        if not each:
            raise ValueError("inputs: expected F or Q with one matrix for each step, received fixed ones")
        if control is not None:
            each.append(as_numbers(control, "control"))
        batch = torch.broadcast_shapes(*(x.shape[:-1] for x in each))
        return torch.cat([x.expand(*batch, x.shape[-1]).to(each[0]) for x in each], -1)

    @property
    def _own(self) -> int:
        """The number of entries of ``u`` that are matrices of a step."""
        return sum(part.count for part in (self.F, self.root) if isinstance(part, _EachStep))

    def _of(self, part: _Part, dt: Tensor, u: Tensor | None) -> tuple[Tensor, bool]:
        """A matrix of a step, and whether it is that of a step of any length."""
        if isinstance(part, Entries | _Variances):
            return part(dt), True
        if isinstance(part, _Function):
            return part(dt, u), False
        first = 0 if part is self.F or not isinstance(self.F, _EachStep) else self.F.count
        if u is None or u.shape[-1] < self._own:
            received = None if u is None else tuple(u.shape)
            expected = f"(..., {self._own}) or more, motion.inputs(), as a matrix differs from step to step"
            raise ValueError(f"u: expected {expected}, received {received}")
        return u[..., first : first + part.count].unflatten(-1, part.shape).to(dt), True


class _EachStep(nn.Module):
    """Matrices ``(..., T, n, r)`` of each step, which a filter finds in its inputs."""

    each: Tensor

    def __init__(self, each: Tensor) -> None:
        super().__init__()
        self.register_buffer("each", each.detach().clone(), persistent=False)

    @property
    def shape(self) -> torch.Size:
        """Of the matrix of a step."""
        return self.each.shape[-2:]

    @property
    def count(self) -> int:
        """Number of entries."""
        return self.shape.numel()


class _Function(nn.Module):
    """A function of ``dt``, or of ``dt`` and ``u``; a module's values learn with the filter."""

    def __init__(self, function: Function, name: str) -> None:
        super().__init__()
        self.function, self.name = function, name
        self.inputs = len(signature(function).parameters) > 1

    def forward(self, dt: Tensor, u: Tensor | None = None) -> Tensor:
        """The matrices ``(..., n, r)``."""
        found = self.function(dt, u) if self.inputs else self.function(dt)
        if not isinstance(found, Tensor):
            hint = "make it of torch's functions, so that it has gradients and batches"
            raise ValueError(
                f"{self.name}: expected a function that gives a tensor, received {type(found).__name__}: {hint}"
            )
        return found.to(dt)


class _Variances(nn.Module):
    """Independent noise of each component, by variances ``(n,)`` that may be hyperparameters."""

    def __init__(self, variances: Sequence[Any], name: str) -> None:
        super().__init__()
        each = [
            v if isinstance(v, Hyper) else Hyper(float(v), constraints.nonnegative, finite=True, name=name)
            for v in variances
        ]
        self.variances, self.shape = nn.ModuleList(each), torch.Size((len(each), len(each)))

    def forward(self, like: Tensor) -> Tensor:
        """The root ``(n, n)``."""
        return torch.stack([variance(like) for variance in self.variances], -1).sqrt().diag_embed()


_Part = Entries | _EachStep | _Function | _Variances


def _part(values: Values | Function, name: str) -> Entries | _EachStep | _Function:
    """A matrix that is fixed, of each step, or a function."""
    if callable(values) and not isinstance(values, Tensor):
        return _Function(values, name)
    entries = Entries(values, name)
    if entries.fixed.dim() < 2:
        raise ValueError(f"{name}: expected a matrix, received {tuple(entries.shape)}")
    if entries.fixed.dim() == 2:
        return entries
    if entries.places:
        raise ValueError(
            f"{name}: expected hyperparameters in one matrix for all steps, received {tuple(entries.shape)}"
        )
    return _EachStep(entries.fixed)


def _noise(values: Values | Function, name: str, size: int) -> _Part:
    """The root of the process noise, from a root or a covariance."""
    if name == "root" or (callable(values) and not isinstance(values, Tensor)):
        return _part(values, name)
    entries = Entries(values, "Q")
    if entries.fixed.dim() < 2:
        if entries.shape != (size,):
            raise ValueError(f"Q: expected ({size}, {size}) or ({size},) variances, received {tuple(entries.shape)}")
        return _Variances(values if isinstance(values, list | tuple) else entries.fixed.tolist(), "Q")
    if entries.places:
        expected = "numbers in a covariance: take root=, or variances (n,), to learn some"
        raise ValueError(f"Q: expected {expected}, received hyperparameters at {list(entries.places)}")
    return _part(covariance_root(entries.fixed, "Q"), "Q")


def _size(matrix: Entries | _EachStep | _Function, components: Sequence[str] | None) -> int:
    """Number of components by a matrix or by their names."""
    if not isinstance(matrix, _Function):
        return int(matrix.shape[-1])
    if components is not None:
        return len(components)
    if matrix.inputs:
        raise ValueError("size: expected the number of components where F is a function of u, received none")
    return int(matrix(torch.ones((), dtype=torch.float64)).shape[-1])


def _check(name: str, part: _Part | None, shape: tuple[int, int | None]) -> None:
    """Checks the shape of a matrix that is known."""
    if part is None or isinstance(part, _Function):
        return
    received = tuple(part.shape)
    if len(received) != 2 or received[0] != shape[0] or shape[1] not in (None, received[1]):
        expected = ", ".join("r" if n is None else str(n) for n in shape)
        raise ValueError(f"{name}: expected ({expected}), received {received}")


def _steps(part: object) -> int | None:
    """Number of steps of a matrix for each; None for others."""
    return int(part.each.shape[-3]) if isinstance(part, _EachStep) else None


def _still(dt: Tensor) -> Tensor:
    """Where no time has passed, ``(..., 1, 1)``."""
    return (dt == 0)[..., None, None]

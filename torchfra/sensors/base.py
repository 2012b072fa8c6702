"""The base of all sensors: a function of the state, the difference of two measurements, and the measurement noise."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchfra.angles import wrap
from torchfra.hyper import Hyper, Part, Value
from torchfra.linalg.triangular import hstack, tria
from torchfra.numbers import as_numbers
from torchfra.tree import event_ranks


@event_ranks(std=1, scale=1, root=2, inverse_root=2, log_norm=0)
class MeasurementNoise(NamedTuple):
    """Measurement noise of a step, in the form that whitening needs.  A missing element has no weight."""

    std: Tensor
    """``(..., m)``, 1 where missing."""
    scale: Tensor
    """``(..., m)`` 1 / std, 0 where missing."""
    root: Tensor | None
    """``(..., m, m)`` lower root of a covariance with correlated elements; else None."""
    inverse_root: Tensor | None
    """``(..., m, m)`` inverse of ``root``, rows of missing elements zero; None without it."""
    log_norm: Tensor
    """``(...)`` log of the normalising factor of the measured elements' density, constants included."""

    def whiten(self, x: Tensor) -> Tensor:
        """``x (..., m, k)`` in units of the measurement noise."""
        return x * self.scale.unsqueeze(-1) if self.inverse_root is None else self.inverse_root @ x

    def scaled(self, variance: Tensor) -> MeasurementNoise:
        """The noise whose variances are ``variance (..., m)`` times as large, 1 where missing.

        Elements that are correlated must have the same factor.
        """
        std = variance.sqrt()
        root = None if self.root is None else std.unsqueeze(-1) * self.root
        inverse = None if self.inverse_root is None else self.inverse_root / std.unsqueeze(-1)
        return MeasurementNoise(std * self.std, self.scale / std, root, inverse, self.log_norm - std.log().sum(-1))

    def colour(self, x: Tensor) -> Tensor:
        """``x (..., m, k)`` converted from units of the noise back to those of the measurement."""
        return x * self.std.unsqueeze(-1) if self.root is None else self.root @ x


Expected = Sequence[tuple[int, tuple[str, ...]]]


class Sensor(Part):
    """Abstract: what is measured of a state, and with what noise.

    To write your own sensor, subclass this, define ``forward(x, u)`` and pass sizes and noise to this class.  All
    else is optional: ``blocks`` where several devices measure; ``locates`` with ``locate``, and
    ``measures_each_direction`` with ``units_per_metre``, for gates in metres and clutter that is uniform in space.

    Shapes: filters call ``forward`` with states ``x (..., d)`` (or more components) and ``u (..., k)`` (or None) that
    have the same ``...``, the sigma points first: it must treat every entry of ``...`` alike and return ``(..., m)``.
    Values that may be learned are ``Hyper``s, read as ``self.std(x)`` in the dtype and on the device of ``x``.

    Args:
        reads: number of leading state components that it reads, ``d``.
        angles: for each of the ``m`` elements of a measurement, whether it is an angle in rad: differences wrap then.
        std: standard deviation of the measurement noise, a number or ``(..., m)`` that broadcasts with the batch, as a
            tensor, a list or an array.
        noise: instead of ``std``, a root ``(..., m, r)`` of a covariance of measurement noise, which may be correlated.

    Raises:
        ValueError: both or neither of ``std`` and ``noise``, a shape that does not fit, a std that is not above 0, a
            covariance that is singular, ``angles`` that are not True or False.
        TypeError: (where the class is defined) a class that declares ``locates`` without a ``locate``, or
            ``measures_each_direction`` without ``units_per_metre``.
    """

    size: int
    """Elements of a measurement, ``m``."""
    dims: int | None = None
    """Dimensions of space that its motion must have at least; None for any number."""
    reads: int
    """Number of leading state components that the sensor reads, ``d``."""
    angles: Tensor
    std: Hyper | None
    root: Tensor | None
    blocks: tuple[tuple[int, ...], ...]
    """Elements that come from the same device, which share an estimate of the measurement noise; one block by default.
    """
    expects: Expected = ()
    """Index and accepted kinds of state components that it reads, as far as it expects any; a property where they
    depend on the instance."""
    linear: bool = False
    """Whether ``forward`` is a matrix times the state, the same for all ``u``."""
    locates: bool = False
    """Whether a measurement locates the target in space, by ``locate``; a property where it depends on the instance."""
    measures_each_direction: bool = False
    """Whether there is one element for each direction of space, as ``units_per_metre`` needs; it may be a property."""

    def __init_subclass__(cls, **keywords: object) -> None:
        super().__init_subclass__(**keywords)
        if "forward" in vars(cls):  # with another function, what was declared for the inherited one does not hold
            cls.linear = vars(cls).get("linear", False)
            cls.expects = vars(cls).get("expects", ())
        for declared, method in (("locates", "locate"), ("measures_each_direction", "units_per_metre")):
            if getattr(cls, declared) is True and getattr(cls, method) is getattr(Sensor, method):
                raise TypeError(f"{cls.__name__}: {declared} is True: expected a {method}, received none")

    def __init__(
        self, reads: int, angles: Sequence[bool], std: Value | None = None, noise: Tensor | None = None
    ) -> None:
        self._lay_out(reads, angles)
        self.register_buffer("root", None)
        if (std is None) == (noise is None):
            raise ValueError(f"std, noise: expected one of the two, received {'none' if std is None else 'both'}")
        if std is not None:
            self.std = elementwise(std, self.size, "std")
        if noise is not None:
            self.root = _checked_root(as_numbers(noise, "noise"), self.size)

    def _lay_out(self, reads: int, angles: Sequence[bool]) -> None:
        """Sets the layout of a measurement: everything but the noise."""
        super().__init__()
        angles = list(getattr(angles, "tolist", lambda: angles)())
        if not all(isinstance(angle, bool) for angle in angles):
            expected = "True or False for each element of a measurement"
            raise ValueError(f"angles: expected {expected}, received {angles}")
        self.reads, self.size = reads, len(angles)
        self.blocks = (tuple(range(self.size)),)
        self.std = None
        self._some, self._all = any(angles), all(angles)
        self.register_buffer("angles", torch.tensor(angles), persistent=False)

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)``, without noise, of states ``x (..., d)`` or longer and inputs ``u (..., k)``."""
        raise TypeError(f"{type(self).__name__}: expected a forward, received none")

    def at_points(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """``forward`` for points ``x (p, ..., d)`` of one step with ``u (..., k)``, expanded to them: ``(p, ..., m)``.

        Rules call this.
        """
        u = u if u is None else u.expand(*x.shape[:-1], -1)
        try:
            z = self.forward(x, u)
        except NotImplementedError:  # raised by a kernel, with a message of its own
            raise
        except (RuntimeError, IndexError) as error:
            inputs = f"states {tuple(x.shape)} in {x.dtype}, u {None if u is None else tuple(u.shape)}"
            raise type(error)(f"{type(self).__name__}.forward: {inputs}: {error}") from error
        if z.dim() < x.dim() or z.shape[-1] != self.size:
            expected, received = (*x.shape[:-1], self.size), tuple(z.shape)
            raise ValueError(f"{type(self).__name__}.forward: expected measurements {expected}, received {received}")
        return z

    def difference(self, a: Tensor, b: Tensor) -> Tensor:
        """``a - b`` of measurements ``(..., m)``, angles wrapped."""
        gap = a - b
        if self._all:
            return wrap(gap)
        return torch.where(self.angles, wrap(gap), gap) if self._some else gap

    def locate(self, z: Tensor) -> Tensor:
        """Where in space ``(..., dims)`` a measurement ``(..., m)`` lies, m, relative to the sensor.

        Raises:
            ValueError: this sensor does not locate targets (``locates``).
        """
        raise ValueError(f"sensor: expected one that measures where the target is, received {self.describe()}")

    def units_per_metre(self, z: Tensor) -> Tensor:
        """Change of each element of a measurement ``(..., m)`` per metre of space in its direction.

        Raises:
            ValueError: the elements are not one for each direction (``measures_each_direction``).
        """
        raise ValueError(f"sensor: expected one that measures each direction of space once, received {self.describe()}")

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """The noise of measurements ``z (..., m)``, of which NaN are missing.

        Args:
            z: the measurements.
            std: ``(..., m)`` standard deviations of these measurements, instead of the sensor's.
            root: ``(..., m, m)`` roots of their covariances, instead of the sensor's.
        """
        measured = ~z.isnan()
        if std is None and root is None:
            std, root = (None if self.std is None else self.std.elements()), self.root
        if std is not None:
            std = torch.where(measured, std.to(z), 1.0)
            return MeasurementNoise(std, measured / std, None, None, _log_norm(std, measured))
        assert root is not None
        # A missing element gets independent noise of variance 1, so that it is uncorrelated with all others.
        root = torch.where(measured.unsqueeze(-1), root.to(z), 0.0)
        lower = tria(hstack(root, torch.diag_embed(1.0 - measured.to(z))))
        eye = torch.eye(self.size, dtype=z.dtype, device=z.device).expand_as(lower)
        inverse = torch.linalg.solve_triangular(lower, eye, upper=False) * measured.unsqueeze(-1)
        diagonal = lower.diagonal(dim1=-2, dim2=-1)
        return MeasurementNoise(diagonal, measured / diagonal, lower, inverse, _log_norm(diagonal, measured))

    def describe(self) -> str:
        """The sensor in a few words, for tables and messages: by default the words of the class's name."""
        return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(self).__name__).lower()

    def extra_repr(self) -> str:
        """Number of elements of a measurement, and of state components that it reads."""
        return f"size={self.size}, reads={self.reads}"


def elementwise(value: Value, size: int, name: str) -> Hyper:
    """A hyperparameter above 0: a number, or ``(..., size)`` with one for each element.

    Raises:
        ValueError: no numbers, numbers not above 0, or another shape.
    """
    values = as_numbers(value, name)
    if values.dim() and values.shape[-1] != size:
        raise ValueError(f"{name}: expected a number or (..., {size}), received {tuple(values.shape)}")
    return Hyper(values, event_dim=int(values.dim() > 0), finite=True, name=name)


def _checked_root(noise: Tensor, size: int) -> Tensor:
    """The lower root ``(..., m, m)`` of a covariance from any root of it; a singular one is refused."""
    if noise.dim() < 2 or noise.shape[-2] != size:
        raise ValueError(f"noise: expected (..., {size}, r), received {tuple(noise.shape)}")
    root = tria(noise)
    rounding = 10 * torch.finfo(noise.dtype).eps * torch.linalg.vector_norm(noise, dim=-1)
    if not bool((root.diagonal(dim1=-2, dim2=-1) > rounding).all()):
        raise ValueError("noise: expected a root of a covariance that has an inverse, received a singular one")
    return root


def _log_norm(std: Tensor, measured: Tensor) -> Tensor:
    return -(std.log() + 0.5 * math.log(2 * math.pi) * measured.to(std)).sum(-1)

"""Gates: which measurements are considered for a target at all."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import constraints
from torch.nn.functional import logsigmoid

from torchfra.hyper import Hyper, Part, Value
from torchfra.linalg.safe import safe_log, safe_sqrt
from torchfra.numbers import as_number, as_numbers, as_tensor
from torchfra.sensors.base import Sensor

_LOWEST_MEMBERSHIP = -30.0
"""Log membership of a soft gate below which a measurement counts as outside."""


class Candidates(NamedTuple):
    """The J measurements of a scan, compared with the predictions of N targets."""

    z: Tensor
    """``(..., N, J, m)`` measurements; a missing element has its predicted value."""
    predicted: Tensor
    """``(..., N, J, m)`` predicted measurements."""
    measured: Tensor
    """``(..., 1, J, m)`` 1 where an element was measured, 0 where it is missing."""
    nis: Tensor
    """``(..., N, J)`` normalised innovation squared."""


class Gate(Part):
    """Abstract: a subclass defines ``beyond``, and ``gate_probability`` if it is not 1."""

    def check(self, sensor: Sensor) -> None:
        """Checks that the gate fits a sensor.

        Raises:
            ValueError: it does not.
        """

    def forward(self, candidates: Candidates, sensor: Sensor, temperature: float | Tensor) -> Tensor:
        """Log membership ``(..., N, J)``: 0 for measurements inside the gate, minus infinity outside.

        A ``temperature`` above 0 makes the edge soft, and is its width as a fraction of the gate: gradients then reach
        the size of the gate.
        """
        beyond = self.beyond(candidates, sensor)
        if isinstance(temperature, Tensor) or temperature > 0:  # the value of a tensor is not read: it may be traced
            soft = logsigmoid(-beyond / temperature)
            return torch.where(soft > _LOWEST_MEMBERSHIP, soft, -torch.inf)
        return torch.zeros_like(beyond).masked_fill(beyond > 0, -torch.inf)

    def beyond(self, candidates: Candidates, sensor: Sensor) -> Tensor:
        """``(..., N, J)`` distance beyond the edge of the gate, as a fraction of its size; negative inside."""
        raise TypeError(f"{type(self).__name__} must define beyond")

    def gate_probability(self) -> Tensor | None:
        """Probability that the measurement of a target lies inside its gate, the ``P_G`` of the papers; None for 1."""
        return None


class Euclidean(Gate):
    """A sphere in space around the predicted measurement.

    Args:
        size: radius, m.
        probability: the gate also contains the ellipsoid of the innovation covariance with this probability, in
            [0, 1), for predictions that are less certain than the sphere is wide, such as a wide prior.  0 for the
            sphere alone.

    The sensor must know where in space a measurement lies (``Sensor.locate``).  The gate probability is taken as 1.

    Raises:
        ValueError: ``size`` is not above 0, or ``probability`` not in [0, 1).

    Source: Chen, Zou & Wu, section 4, who print gates of 100 and 150.  Differs: they state neither unit nor form,
    metres and sphere are our reading; ``probability`` is an addition.
    """

    def __init__(self, size: Value = 100.0, probability: float = 0.0) -> None:
        super().__init__()
        if not 0 <= as_number(probability) < 1:
            raise ValueError(f"probability: expected a probability of 0 or more and below 1, received {probability!r}")
        self.size = Hyper(size, name="size")
        self.probability = probability

    def check(self, sensor: Sensor) -> None:
        """Checks that the sensor measures where a target is.

        Raises:
            ValueError: it does not.
        """
        if not sensor.locates:
            raise ValueError(f"sensor: expected one that measures where the target is, received {sensor.describe()}")

    def beyond(self, candidates: Candidates, sensor: Sensor) -> Tensor:
        """Distance in space less the radius, as a fraction of the radius."""
        gap = sensor.locate(candidates.z) - sensor.locate(candidates.predicted)
        beyond: Tensor = safe_sqrt(gap.square().sum(-1)) / self.size(gap) - 1
        if not self.probability:
            return beyond
        return torch.minimum(beyond, _beyond_ellipsoid(candidates, as_tensor(self.probability, beyond)))


class ChiSquare(Gate):
    """The ellipsoid of the innovation covariance with a given probability, for as many elements as were measured.

    Args:
        probability: probability that the measurement of a target lies inside, above 0 and below 1.

    The width of a soft edge is measured in the log of the tail probability.

    Raises:
        ValueError: ``probability`` is not above 0 and below 1.

    Source: Bar-Shalom & Fortmann (1988), section 5.
    """

    def __init__(self, probability: Value = 0.999) -> None:
        super().__init__()
        value = as_numbers(probability, "probability")
        if not bool(((value > 0) & (value < 1)).all()):
            raise ValueError(f"probability: expected a value above 0 and below 1, received {probability}")
        self.probability = Hyper(probability, constraints.interval(0.0, 1.0), name="probability")

    def beyond(self, candidates: Candidates, sensor: Sensor) -> Tensor:
        """Log tail probability beyond the measurement, relative to that beyond the ellipsoid."""
        probability: Tensor = self.probability(candidates.nis)
        return _beyond_ellipsoid(candidates, probability)

    def gate_probability(self) -> Tensor | None:
        """The probability of the ellipsoid."""
        probability: Tensor = self.probability()
        return probability


def _beyond_ellipsoid(candidates: Candidates, probability: Tensor) -> Tensor:
    """Distance ``(..., N, J)`` beyond the ellipsoid of a probability, as ``log tail / log(1 - probability) - 1``.

    ``tail`` is the probability of a larger normalised innovation squared; where it underflows the result is infinity.
    """
    degrees_of_freedom = candidates.measured.sum(-1).expand(candidates.nis.shape)
    tail = _tail(candidates.nis.clamp(1e-12, 1e4), degrees_of_freedom, candidates.measured.shape[-1])
    normal = tail >= torch.finfo(tail.dtype).tiny
    beyond: Tensor = torch.where(normal, safe_log(tail, fill=0.0) / torch.log1p(-probability) - 1, torch.inf)
    return beyond


def _tail(nis: Tensor, degrees_of_freedom: Tensor, most: int) -> Tensor:
    """Probability ``(..., N, J)`` that chi squared of so many degrees of freedom, ``most`` at most, exceeds ``nis``.

    By ``Q(a + 1, x) = Q(a, x) + x^a exp(-x) / gamma(a + 1)``, from ``Q(1/2, x) = erfc(sqrt(x))`` and ``Q(1, x) =
    exp(-x)``; for no degree of freedom it is that of one.
    """
    half = nis / 2
    root, density = half.sqrt(), (-half).exp()
    tails: list[Tensor] = [torch.special.erfc(root), density]
    power = [root, half]  # x^a, of the last two
    for degrees in range(1, most - 1):
        tails.append(tails[-2] + power[-2] * density / math.gamma(degrees / 2 + 1))
        power.append(power[-2] * half)
    tail: Tensor = tails[0]
    for degrees in range(2, most + 1):
        tail = torch.where(degrees_of_freedom == degrees, tails[degrees - 1], tail)
    return tail

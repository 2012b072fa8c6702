"""Gates: which measurements may be a target's at all."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import constraints
from torch.nn.functional import logsigmoid

from torchfra.hyper import Hyper, Value
from torchfra.sensors.base import Sensor

_NOTHING = -30.0
"""Log of how far inside a soft gate a measurement must be to count at all."""


class Candidates(NamedTuple):
    """All measurements of a scan against the prediction of each target."""

    z: Tensor
    """``(..., N, J, m)`` measured; where an element is missing, what was predicted."""
    predicted: Tensor
    """``(..., N, J, m)``."""
    seen: Tensor
    """``(..., 1, J, m)`` 1 where measured, 0 where missing."""
    nis: Tensor
    """``(..., N, J)`` normalised innovation squared."""


class Gate(nn.Module):
    """Abstract: a subclass gives ``beyond``, and ``inside`` if a target's measurement may lie outside."""

    def check(self, sensor: Sensor) -> None:
        """Whether this goes with a sensor.

        Raises:
            ValueError: it does not.
        """

    def forward(self, candidates: Candidates, sensor: Sensor, temperature: float) -> Tensor:
        """Log ``(..., N, J)`` of how far each measurement counts: 0 inside, minus infinity outside.

        With a temperature the edge is soft, that wide as a share of the gate: gradients then reach its size.
        """
        beyond = self.beyond(candidates, sensor)
        if temperature > 0:
            soft = logsigmoid(-beyond / temperature)
            return torch.where(soft > _NOTHING, soft, -torch.inf)
        return torch.where(beyond > 0, -torch.inf, 0.0)

    def beyond(self, candidates: Candidates, sensor: Sensor) -> Tensor:
        """``(..., N, J)`` how far outside the edge a measurement lies, as a share of the gate; negative inside."""
        raise TypeError(f"{type(self).__name__} needs a beyond")

    def inside(self) -> Tensor | None:
        """Probability that a target's own measurement lies inside; None for 1."""
        return None


class Euclidean(Gate):
    """Within so many metres of the predicted measurement.

    Args:
        size: m.
        least: the gate holds at least the ellipsoid of the innovation's covariance that has this probability: a
            prediction may be less certain than the gate is wide, that of a poor start say.  0 for metres alone.

    The sensor must tell where in space a measurement lies (``Sensor.locate``).  Targets are taken to be inside always.

    Raises:
        ValueError: ``size`` not above 0, ``least`` not in [0, 1).

    Source: Chen, Zou & Wu, section 4, who print gates of 100 and 150; unit and form are our reading.  Differs:
    ``least`` is ours.
    """

    def __init__(self, size: Value = 100.0, least: float = 0.0) -> None:
        super().__init__()
        if not 0 <= least < 1:
            raise ValueError(f"least: expected a probability of 0 or more and below 1, received {least}")
        self.size = Hyper(size, name="size")
        self.least = least

    def check(self, sensor: Sensor) -> None:
        """Whether the sensor measures where a target is.

        Raises:
            ValueError: it does not.
        """
        if not sensor.locates:
            raise ValueError(f"sensor: expected one that measures where the target is, received {sensor.describe()}")

    def beyond(self, candidates: Candidates, sensor: Sensor) -> Tensor:
        """See ``Gate``."""
        gap = sensor.locate(candidates.z) - sensor.locate(candidates.predicted)
        squared, size = gap.square().sum(-1), self.size(gap)
        distance = torch.where(squared > 0, torch.where(squared > 0, squared, 1.0).sqrt(), 0.0)
        beyond: Tensor = distance / size - 1
        if not self.least:
            return beyond
        return torch.minimum(beyond, _tail(candidates, beyond.new_tensor(self.least)))


class ChiSquare(Gate):
    """Within the ellipsoid of the innovation's covariance that has a probability, whatever elements were seen.

    Args:
        probability: that the target's own measurement lies inside, below 1.

    Softness counts in the log of the probability to lie still farther out.

    Source: Bar-Shalom & Fortmann (1988), section 5.
    """

    def __init__(self, probability: Value = 0.999) -> None:
        super().__init__()
        given = torch.as_tensor(probability)
        if not bool(((given > 0) & (given < 1)).all()):
            raise ValueError(f"probability: expected a value above 0 and below 1, received {probability}")
        self.probability = Hyper(probability, constraints.interval(0.0, 1.0), name="probability")

    def beyond(self, candidates: Candidates, sensor: Sensor) -> Tensor:
        """See ``Gate``."""
        probability: Tensor = self.probability(candidates.nis)
        return _tail(candidates, probability)

    def inside(self) -> Tensor | None:
        """See ``Gate``."""
        probability: Tensor = self.probability()
        return probability


def _tail(candidates: Candidates, probability: Tensor) -> Tensor:
    """How far ``(..., N, J)`` beyond the ellipsoid of a probability, in the log of the one to lie still farther out."""
    nis, seen = candidates.nis, candidates.seen.sum(-1).expand(candidates.nis.shape)
    tail = torch.special.gammaincc(seen.clamp_min(1.0) / 2, nis.clamp_min(1e-12) / 2)
    some = tail > 0
    beyond = torch.where(some, tail, 1.0).log() / torch.log1p(-probability) - 1
    outside: Tensor = torch.where(some, beyond, torch.inf)
    return outside

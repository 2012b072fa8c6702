"""Sensors made of others: several as one, and biases that are in the state."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

import torch
from numpy.typing import ArrayLike
from torch import Tensor, nn

from torchfra.linalg.batches import joined
from torchfra.linalg.triangular import block_diagonal
from torchfra.numbers import is_integer
from torchfra.sensors.base import Expected, MeasurementNoise, Sensor
from torchfra.sensors.places import finite, heading_at


class Stacked(Sensor):
    """Several sensors that measure at the same instant, as one: their measurements one after the other.

    Elements of a sensor that did not measure are NaN.  Noise is independent between sensors; each sensor keeps its
    blocks, angles and noise, which learn by the sensor's names.

    Args:
        sensors: the parts.
        inputs: number of entries of ``u`` that each gets, in order; by default each gets all of ``u``.

    Raises:
        ValueError: no sensors, or not one number in ``inputs`` for each of them.
    """

    def __init__(self, *sensors: Sensor, inputs: Sequence[int] | None = None) -> None:
        if len(sensors) == 1 and isinstance(sensors[0], list | tuple):
            raise ValueError("sensors: expected them one by one, Stacked(*sensors), received a list")
        if not sensors or not all(isinstance(sensor, Sensor) for sensor in sensors):
            received = ", ".join(type(sensor).__name__ for sensor in sensors) or "none"
            raise ValueError(f"sensors: expected one or more, received {received}")
        if inputs is not None and (len(inputs) != len(sensors) or min(inputs) < 0):
            raise ValueError(f"inputs: expected entries of u for each of {len(sensors)} sensors, received {inputs}")
        angles = [angle for sensor in sensors for angle in sensor.angles.tolist()]
        self._lay_out(max(sensor.reads for sensor in sensors), angles)
        self.parts, self.inputs = nn.ModuleList(sensors), None if inputs is None else tuple(inputs)
        self._sizes = [sensor.size for sensor in sensors]
        starts = [0, *accumulate(self._sizes)]
        self.blocks = tuple(
            tuple(start + i for i in block)
            for start, sensor in zip(starts, sensors, strict=False)
            for block in sensor.blocks
        )
        dims = [sensor.dims for sensor in sensors if sensor.dims is not None]
        self.dims = max(dims) if dims else None

    @property
    def linear(self) -> bool:  # type: ignore[override]  # of these sensors, not of the class
        """Whether all parts are linear, and get the same ``u``."""
        return self.inputs is None and all(part.linear for part in self._parts)

    @property
    def locates(self) -> bool:  # type: ignore[override]  # of these sensors, not of the class
        """Whether one of the parts locates the target."""
        return any(part.locates for part in self._parts)

    @property
    def root(self) -> Tensor | None:  # type: ignore[override]  # of these sensors
        """A root ``(..., m, m)`` of the noise covariance if a part has correlated noise; else None."""
        if all(part.root is None for part in self._parts):
            return None
        return block_diagonal([noise_root(part) for part in self._parts])

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The components that the parts expect."""
        return [each for part in self._parts for each in part.expects]

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)`` of each part, one after the other."""
        return joined([part(x, own) for part, own in zip(self._parts, self._inputs(u), strict=True)])

    def difference(self, a: Tensor, b: Tensor) -> Tensor:
        """``a - b`` of measurements ``(..., m)``, by ``difference`` of each part."""
        each = zip(self._parts, a.split(self._sizes, -1), b.split(self._sizes, -1), strict=True)
        return joined([part.difference(x, y) for part, x, y in each])

    def locate(self, z: Tensor) -> Tensor:
        """Where the first part that locates targets locates this one: see ``Sensor.locate``."""
        for part, own in zip(self._parts, z.split(self._sizes, -1), strict=True):
            if part.locates:
                return part.locate(own)
        return super().locate(z)

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """The noise of measurements ``z (..., m)``: that of each part, unless ``std`` or ``root`` is given."""
        if std is not None or root is not None:
            return super().measurement_noise(z, std, root)
        each = [part.measurement_noise(own) for part, own in zip(self._parts, z.split(self._sizes, -1), strict=True)]
        std, scale = joined([part.std for part in each]), joined([part.scale for part in each])
        log_norm = torch.stack(torch.broadcast_tensors(*(part.log_norm for part in each))).sum(0)
        if all(part.inverse_root is None for part in each):
            return MeasurementNoise(std, scale, None, None, log_norm)
        roots = [part.std.diag_embed() if part.root is None else part.root for part in each]
        inverses = [part.scale.diag_embed() if part.inverse_root is None else part.inverse_root for part in each]
        return MeasurementNoise(std, scale, block_diagonal(roots), block_diagonal(inverses), log_norm)

    def describe(self) -> str:
        """All parts."""
        return " and ".join(part.describe() for part in self._parts)

    def _inputs(self, u: Tensor | None) -> Sequence[Tensor | None]:
        """The entries of ``u`` for each part."""
        if self.inputs is None:
            return [u] * len(self._parts)
        if u is None or u.shape[-1] != sum(self.inputs):
            received = None if u is None else f"(..., {u.shape[-1]})"
            raise ValueError(
                f"u: expected (..., {sum(self.inputs)}), {self.inputs} of each sensor, received {received}"
            )
        bounds = pairwise([0, *accumulate(self.inputs)])
        return [u[..., first:last] if last > first else None for first, last in bounds]

    @property
    def _parts(self) -> list[Sensor]:
        return list(self.parts)  # type: ignore[arg-type]  # a ModuleList does not know what it holds


class Around(Sensor):
    """Abstract: a sensor around another one, ``inside``, whose elements, angles, blocks and noise it has."""

    @property
    def inside(self) -> Sensor:
        """The sensor inside."""
        raise TypeError(f"{type(self).__name__}: expected an inside, received none")

    def _surround(self, sensor: Sensor, reads: int) -> None:
        """Lays out a measurement as that of the sensor inside, and reads so many components or more."""
        self._lay_out(max(sensor.reads, reads), sensor.angles.tolist())
        self.blocks, self.dims = sensor.blocks, sensor.dims

    @property
    def linear(self) -> bool:  # type: ignore[override]  # of this sensor, not of the class
        """Whether the sensor inside is linear."""
        return self.inside.linear

    @property
    def root(self) -> Tensor | None:  # type: ignore[override]  # of that sensor
        """Root of the noise covariance of the sensor inside; None for independent elements."""
        return self.inside.root

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The components that the sensor inside expects."""
        return self.inside.expects

    def difference(self, a: Tensor, b: Tensor) -> Tensor:
        """``a - b`` of measurements ``(..., m)``, angles wrapped."""
        return self.inside.difference(a, b)

    def measurement_noise(self, z: Tensor, std: Tensor | None = None, root: Tensor | None = None) -> MeasurementNoise:
        """The noise of measurements ``z (..., m)``: see ``Sensor.measurement_noise``."""
        return self.inside.measurement_noise(z, std, root)


class Biased(Around):
    """A sensor with biases that are components of the state, such as the offset of a clock.

    ``Augmented(motion, RandomWalk(q, 1, kind="bias"))`` has such a component behind those of the target.

    Args:
        sensor: the sensor without biases.
        bias: index of the component that is added to every element, or one for each element, None for no bias.

    Raises:
        ValueError: no sensor, indices below 0, or not one for each element.
    """

    bias_kinds: tuple[str, ...] = ("bias", "clock", "angle", "rate")
    """Kinds of components that may be added."""

    def __init__(self, sensor: Sensor, bias: int | Sequence[int | None]) -> None:
        if not isinstance(sensor, Sensor):
            raise ValueError(f"sensor: expected a sensor, received {type(sensor).__name__}")
        each = list(bias) if isinstance(bias, Sequence) else [bias] * sensor.size
        if len(each) != sensor.size or not all(i is None or is_integer(i, 0) for i in each):
            expected = f"a component of the state, or one for each of {sensor.size} elements"
            raise ValueError(f"bias: expected {expected}, received {bias}")
        self._surround(sensor, max((i + 1 for i in each if i is not None), default=0))
        self.unbiased, self.bias = sensor, tuple(None if i is None else int(i) for i in each)

    @property
    def inside(self) -> Sensor:
        """The sensor without biases."""
        return self.unbiased

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The components that the sensor without biases expects, and the biases."""
        return [*self.unbiased.expects, *((i, self.bias_kinds) for i in self.bias if i is not None)]

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)`` with its biases."""
        zero = torch.zeros_like(x[..., 0])
        added: Tensor = self.unbiased(x, u) + torch.stack([zero if i is None else x[..., i] for i in self.bias], -1)
        return added

    def describe(self) -> str:
        """The sensor, and that it is biased."""
        return f"{self.unbiased.describe()} with a bias"


class Mounted(Around):
    """A sensor beside the point of a vehicle that the state describes, as an antenna on its roof: a lever arm.

    Args:
        sensor: in the plane; it measures as from the place where it is mounted.
        at: ``(2,)`` where that is in the vehicle's axes: m ahead and m to the left.
        heading: index of the component that is the vehicle's heading, rad counter-clockwise from +x.

    Raises:
        ValueError: no sensor, a place of another shape or not finite, an index below 0.

    Example:
        >>> antenna = torchfra.sensors.Mounted(torchfra.sensors.Position(0.1), at=[2.0, 0.5])
        >>> antenna(torch.tensor([10.0, 0.0, torch.pi / 2]))  # the vehicle looks along +y
        tensor([9.5000, 2.0000])
    """

    at: Tensor

    def __init__(self, sensor: Sensor, at: ArrayLike, heading: int = 2) -> None:
        if not isinstance(sensor, Sensor):
            raise ValueError(f"sensor: expected a sensor, received {type(sensor).__name__}")
        self._surround(sensor, heading_at(heading) + 1)
        self.mounted, self.heading = sensor, heading
        self.register_buffer("at", finite(at, 2, name="at"), persistent=False)

    @property
    def inside(self) -> Sensor:
        """The sensor as if it were not mounted elsewhere."""
        return self.mounted

    @property
    def linear(self) -> bool:  # type: ignore[override]  # of this sensor, not of the class
        """False, as it turns with the vehicle."""
        return False

    @property
    def expects(self) -> Expected:  # type: ignore[override]  # of this sensor, not of the class
        """The components that the sensor expects, and a heading."""
        return [*self.inside.expects, (self.heading, ("angle",))]

    def forward(self, x: Tensor, u: Tensor | None = None) -> Tensor:
        """The measurement ``(..., m)`` from where the sensor is mounted."""
        ahead, left = self.at.to(x)
        cos, sin = x[..., self.heading].cos(), x[..., self.heading].sin()
        place = x[..., :2] + torch.stack([ahead * cos - left * sin, ahead * sin + left * cos], -1)
        measured: Tensor = self.mounted(torch.cat([place, x[..., 2:]], -1), u)
        return measured

    def describe(self) -> str:
        """The sensor, and that it is mounted elsewhere."""
        return f"{self.mounted.describe()} on a lever arm"


def noise_root(sensor: Sensor) -> Tensor:
    """A root ``(..., m, m)`` of the covariance of a sensor's noise."""
    if sensor.root is not None:
        return sensor.root
    if sensor.std is None:  # made of others, whose noise is that of a complete measurement
        like = torch.zeros(sensor.size, dtype=torch.float64, device=sensor.angles.device)
        std = sensor.measurement_noise(like).std
    else:
        std = sensor.std.elements()
    root: Tensor = std.expand(*std.shape[:-1], sensor.size).diag_embed()
    return root

"""What GPB has to do with its sensor, and with others."""

from __future__ import annotations

import torch
from torch import nn

from torchfra.filters.gpb.hindsight import WayBack
from torchfra.filters.gpb.qualities import Qualities
from torchfra.filters.gpb.seeing import by_points_or_slope, exactly
from torchfra.filters.gpb.states import GPBState
from torchfra.filters.other_sensors import sharing
from torchfra.gaussian.inputs import Frame, Measurements
from torchfra.sensors.base import Sensor
from torchfra.types import Gaussian, Whitened


class Sensing(WayBack):
    """The part of ``GPB`` that depends on the sensor."""

    qualities: Qualities

    def _batch(self, measurements: Measurements, prior: Gaussian, name: str = "prior") -> torch.Size:
        """The batch of all that was handed in, checked."""
        batch = super()._batch(measurements, prior, name)
        self.qualities.check_noise("noise", measurements.noise)
        return batch

    def parts_for(self, sensor: Sensor) -> dict[str, nn.Module]:
        """Its parts, by name, that are others around another sensor."""
        qualities = sharing(self.qualities, Qualities, blocks=tuple(map(tuple, sensor.blocks)))
        qualities.check(sensor)
        return super().parts_for(sensor) | {"qualities": qualities}

    def unremembered(self, state: GPBState) -> GPBState:
        """A state whose last measurement says nothing of outliers in the next."""
        return state._replace(
            outlier=state.belief.mean.new_zeros((*state.belief.mean.shape[:-1], len(self.qualities.blocks)))
        )

    def remembering(self, state: GPBState, before: GPBState) -> GPBState:
        """Likewise, in the form of the one ``before``: outliers of another sensor say nothing of this one's."""
        return state._replace(outlier=torch.zeros_like(before.outlier))

    def compare(self, belief: Gaussian, frame: Frame) -> Whitened:
        """The measurement against a predicted belief; by the slope at its mean where its points show none.

        From points on all sides of an anchor ranges do not tell where the target is: a belief that wide would learn
        nothing, and widen on.
        """
        if self.sensor.linear:
            return exactly(self.sensor, belief, frame)
        return by_points_or_slope(lambda x: super(Sensing, self).compare(x, frame), belief)

    def predict_innovation(self, state: GPBState, beliefs: Gaussian, frame: Frame) -> Gaussian:
        """What is measured, less what hypotheses ``(K, ..., n)`` expect: ``(K, ..., m)`` in units of the noise."""
        return super().predict_innovation(state, self.read(beliefs), frame)

    def read(self, predicted: Gaussian) -> Gaussian:
        """Of states, what the sensor reads."""
        d = self.sensor.reads
        return Gaussian(predicted.mean[..., :d], predicted.scale_tril[..., :d, :d])

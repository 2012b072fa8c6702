"""Sensors: what is measured of a target, and with what noise."""

from typing import TYPE_CHECKING

from torchfra.loading import when_named

if TYPE_CHECKING:  # isort: off
    from torchfra.sensors.base import MeasurementNoise as MeasurementNoise, Sensor as Sensor
    from torchfra.sensors.camera import Camera as Camera, facing as facing
    from torchfra.sensors.composed import Biased as Biased, Mounted as Mounted, Stacked as Stacked
    from torchfra.sensors.correlated import Correlated as Correlated
    from torchfra.sensors.correlations import CrossCorrelated as CrossCorrelated, cross_correlated as cross_correlated
    from torchfra.sensors.direction import Bearings as Bearings, RangeBearing as RangeBearing
    from torchfra.sensors.infrared import InfraredLaser as InfraredLaser
    from torchfra.sensors.linear import Linear as Linear
    from torchfra.sensors.position import Position as Position
    from torchfra.sensors.ranges import RangeRates as RangeRates, Ranges as Ranges
    from torchfra.sensors.signals import Pseudoranges as Pseudoranges, TimeDifferences as TimeDifferences
else:
    __all__, __getattr__, __dir__ = when_named(__name__, {
        "sensors.base": "MeasurementNoise Sensor",
        "sensors.camera": "Camera facing",
        "sensors.composed": "Biased Mounted Stacked",
        "sensors.correlated": "Correlated",
        "sensors.correlations": "CrossCorrelated cross_correlated",
        "sensors.direction": "Bearings RangeBearing",
        "sensors.infrared": "InfraredLaser",
        "sensors.linear": "Linear",
        "sensors.position": "Position",
        "sensors.ranges": "RangeRates Ranges",
        "sensors.signals": "Pseudoranges TimeDifferences",
    })  # fmt: skip

"""Sensors: what is measured of a target, and with what noise."""

from torchfra.sensors.base import MeasurementNoise, Sensor
from torchfra.sensors.camera import Camera, facing
from torchfra.sensors.composed import Biased, Mounted, Stacked
from torchfra.sensors.correlated import Correlated
from torchfra.sensors.cross_correlated import CrossCorrelated, cross_correlated
from torchfra.sensors.direction import Bearings, RangeBearing
from torchfra.sensors.infrared import InfraredLaser
from torchfra.sensors.linear import Linear
from torchfra.sensors.position import Position
from torchfra.sensors.ranges import RangeRates, Ranges
from torchfra.sensors.signals import Pseudoranges, TimeDifferences

__all__ = [
    "Bearings",
    "Biased",
    "Camera",
    "Correlated",
    "CrossCorrelated",
    "InfraredLaser",
    "Linear",
    "MeasurementNoise",
    "Mounted",
    "Position",
    "Pseudoranges",
    "RangeBearing",
    "RangeRates",
    "Ranges",
    "Sensor",
    "Stacked",
    "TimeDifferences",
    "cross_correlated",
    "facing",
]

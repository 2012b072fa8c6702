"""What sensors measure."""

from torchfra.sensors.base import MeasurementNoise, Sensor
from torchfra.sensors.camera import Camera, facing
from torchfra.sensors.direction import Bearings, RangeBearing
from torchfra.sensors.infrared import InfraredLaser
from torchfra.sensors.position import Position
from torchfra.sensors.ranges import Ranges

__all__ = [
    "Bearings",
    "Camera",
    "InfraredLaser",
    "MeasurementNoise",
    "Position",
    "RangeBearing",
    "Ranges",
    "Sensor",
    "facing",
]

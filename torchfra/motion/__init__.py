"""How targets move."""

from torchfra.motion.bank import Bank, Embedded, aircraft, people, ships, vehicles
from torchfra.motion.base import Adaptation, Motion
from torchfra.motion.correlated import CurrentStatistical, Singer, WhiteJerk
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.motion.spherical import Spherical
from torchfra.motion.turn import CoordinatedTurn

__all__ = [
    "Adaptation",
    "Bank",
    "ConstantAcceleration",
    "ConstantVelocity",
    "CoordinatedTurn",
    "CurrentStatistical",
    "Embedded",
    "Motion",
    "Singer",
    "Spherical",
    "WhiteJerk",
    "aircraft",
    "people",
    "ships",
    "vehicles",
]

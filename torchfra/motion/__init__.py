"""Motions: how targets move, and with what process noise."""

from torchfra.motion.augmented import Augmented
from torchfra.motion.bank import Bank, Embedded, aircraft, people, ships, vehicles
from torchfra.motion.base import KINDS, Adaptation, Motion
from torchfra.motion.bicycle import Bicycle
from torchfra.motion.correlated import CurrentStatistical, GaussMarkov, IntegratedOrnsteinUhlenbeck, Singer, WhiteJerk
from torchfra.motion.level import Level
from torchfra.motion.linear import Linear
from torchfra.motion.odometry import BodyOdometry, Odometry, body_velocities
from torchfra.motion.polynomial import ConstantAcceleration, ConstantVelocity
from torchfra.motion.speed import ConstantSpeed
from torchfra.motion.spherical import Spherical
from torchfra.motion.turn import CoordinatedTurn, UnknownTurn
from torchfra.motion.walks import Clock, RandomWalk

__all__ = [
    "KINDS",
    "Adaptation",
    "Augmented",
    "Bank",
    "Bicycle",
    "BodyOdometry",
    "Clock",
    "ConstantAcceleration",
    "ConstantSpeed",
    "ConstantVelocity",
    "CoordinatedTurn",
    "CurrentStatistical",
    "Embedded",
    "GaussMarkov",
    "IntegratedOrnsteinUhlenbeck",
    "Level",
    "Linear",
    "Motion",
    "Odometry",
    "RandomWalk",
    "Singer",
    "Spherical",
    "UnknownTurn",
    "WhiteJerk",
    "aircraft",
    "body_velocities",
    "people",
    "ships",
    "vehicles",
]

"""Motions: how targets move, and with what process noise."""

from typing import TYPE_CHECKING

from torchfra.loading import when_named

if TYPE_CHECKING:  # isort: off
    from torchfra.motion.augmented import Augmented as Augmented
    from torchfra.motion.bank import (
        Bank as Bank,
        Embedded as Embedded,
        aircraft as aircraft,
        people as people,
        ships as ships,
        vehicles as vehicles,
    )
    from torchfra.motion.base import KINDS as KINDS, Adaptation as Adaptation, Motion as Motion
    from torchfra.motion.bicycle import Bicycle as Bicycle
    from torchfra.motion.correlated import (
        CurrentStatistical as CurrentStatistical,
        GaussMarkov as GaussMarkov,
        IntegratedOrnsteinUhlenbeck as IntegratedOrnsteinUhlenbeck,
        Singer as Singer,
        WhiteJerk as WhiteJerk,
    )
    from torchfra.motion.level import Level as Level
    from torchfra.motion.linear import Linear as Linear
    from torchfra.motion.odometry import (
        BodyOdometry as BodyOdometry,
        Odometry as Odometry,
        body_velocities as body_velocities,
    )
    from torchfra.motion.polynomial import (
        ConstantAcceleration as ConstantAcceleration,
        ConstantVelocity as ConstantVelocity,
    )
    from torchfra.motion.speed import ConstantSpeed as ConstantSpeed
    from torchfra.motion.spherical import Spherical as Spherical
    from torchfra.motion.turn import CoordinatedTurn as CoordinatedTurn, UnknownTurn as UnknownTurn
    from torchfra.motion.walks import Clock as Clock, RandomWalk as RandomWalk
else:
    __all__, __getattr__, __dir__ = when_named(__name__, {
        "motion.augmented": "Augmented",
        "motion.bank": "Bank Embedded aircraft people ships vehicles",
        "motion.base": "KINDS Adaptation Motion",
        "motion.bicycle": "Bicycle",
        "motion.correlated": "CurrentStatistical GaussMarkov IntegratedOrnsteinUhlenbeck Singer WhiteJerk",
        "motion.level": "Level",
        "motion.linear": "Linear",
        "motion.odometry": "BodyOdometry Odometry body_velocities",
        "motion.polynomial": "ConstantAcceleration ConstantVelocity",
        "motion.speed": "ConstantSpeed",
        "motion.spherical": "Spherical",
        "motion.turn": "CoordinatedTurn UnknownTurn",
        "motion.walks": "Clock RandomWalk",
    })  # fmt: skip

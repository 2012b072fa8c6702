"""Independent reference filters: plain numpy, one track, explicit loops, covariance form; torchfra is never imported.

Each file is written straight from the equations of the paper that its docstring names. Shapes: n states, m measured
elements, T steps. Row k of `z` (counted from 0) is measured after the transition F(k), Q(k) from the step before (row
0: from the initial state). NaN elements of `z` are missing. Every filter returns a dict of arrays with one row per
step; those of Wang et al. (2021) have

    mean (T,n), P (T,n,n), weights (T,m), fading (T,)
    nis (T,), log_likelihood (T,)   of the unweighted innovation, nominal R, unfaded prediction, elements not missing

weights and fading are 1 where nothing was down-weighted or faded; nis and log_likelihood are 0 in a missing step.
"""

from oracles.alphabeta import alphabeta_bank
from oracles.basics import Model, bearings, ca, cv, turn, wrap
from oracles.cubature import third_degree, unscented
from oracles.events import every_event, joint_events
from oracles.fading import asrckf, rmckf
from oracles.fra import fra, soft_fra
from oracles.huber import huber_regression, huber_score
from oracles.imm import imm
from oracles.jpda import jpda
from oracles.kalman import ekf, kalman
from oracles.noise import Tuned, iaukf
from oracles.robust import mr_ckf, rsrckf, srckf, ukf
from oracles.smoothing import every_history, models_smoother, smoother, through, whole_track
from oracles.spherical import msc_from_cartesian, msc_jacobian, msc_to_cartesian
from oracles.two_filters import believed, joined, jumps
from oracles.vsimm import likely_set, vsimm

__all__ = [
    "Model",
    "Tuned",
    "alphabeta_bank",
    "asrckf",
    "bearings",
    "believed",
    "ca",
    "cv",
    "ekf",
    "every_event",
    "every_history",
    "fra",
    "huber_regression",
    "huber_score",
    "iaukf",
    "imm",
    "joined",
    "joint_events",
    "jpda",
    "jumps",
    "kalman",
    "likely_set",
    "models_smoother",
    "mr_ckf",
    "msc_from_cartesian",
    "msc_jacobian",
    "msc_to_cartesian",
    "rmckf",
    "rsrckf",
    "smoother",
    "soft_fra",
    "srckf",
    "third_degree",
    "through",
    "turn",
    "ukf",
    "unscented",
    "vsimm",
    "whole_track",
    "wrap",
]  # fmt: skip

"""Unscented filters of several targets with joint association; Chen, Zou & Wu, eqs. (10)-(30)."""

from __future__ import annotations

import math

import numpy as np

from oracles.basics import Array, Result, collect, difference
from oracles.events import joint_events
from oracles.kalman import fit
from oracles.noise import MeasurementNoise, Tuned, sage_husa, wrapped_azimuth
from oracles.spherical import MEASURED_ANGLES, msc_axes, msc_predict


def place(z: Array) -> Array:
    """Where a measurement of azimuth, elevation and range lies, Cartesian, m."""
    return z[2] * msc_axes(z[0], z[1])[0]


def jpda(
    z: Array, mean0: Array, P0: Array, F: Array, QC: Array, R0: Array, *, PD: float, gate: float, volume: float,
    how: Tuned | None = None, rate: float | None = None,
) -> Result:  # fmt: skip
    """IAUKF-JPDA, eqs. (10)-(30), on scans z (T,J,3); mean0 (N,6), P0 (N,6,6), F (N,6,6); a gate in metres."""
    N = len(mean0)
    means, Ps, noises = list(mean0), list(P0), [MeasurementNoise(R0, np.zeros(3)) for _ in range(N)]
    steps = []
    for scan in z:
        there = [j for j in range(len(scan)) if not np.isnan(scan[j]).any()]
        us = [msc_predict(means[t], Ps[t], F[t], QC) for t in range(N)]
        nu, L = np.zeros((N, len(scan), 3)), np.zeros((len(scan), N))
        c = np.ones(len(scan))
        for j in there:
            c[j] = (1.0 if rate is None else rate) * scan[j, 2] ** 2 * math.cos(scan[j, 1]) / volume
            for t in range(N):
                nu[t, j] = difference(scan[j], us[t].zhat, MEASURED_ANGLES)
                if np.linalg.norm(place(scan[j]) - place(us[t].zhat)) <= gate:
                    nis, density = fit(nu[t, j], us[t].Pzz + np.diag(noises[t].R))
                    L[j, t] = math.exp(density + max(nis / 2 - 600.0, 0.0))  # inside the gate, if barely possible
        beta, missed = joint_events(L, PD, c, rate is None)
        for t in range(N):
            u, b = us[t], beta[:, t]
            if how is not None and 1 - missed[t] >= 0.5:
                target = (b[:, None] * nu[t] ** 2).sum(0) / b.sum() - np.diag(u.Pzz)
                noises[t] = sage_husa(noises[t], R0, target, np.full(3, b.sum()), how)
            S = u.Pzz + np.diag(noises[t].R)
            K = u.Pxz @ np.linalg.inv(S)
            bar = b @ nu[t]
            scatter = sum((b[j] * np.outer(nu[t, j], nu[t, j]) for j in there), np.zeros((3, 3))) - np.outer(bar, bar)
            means[t] = wrapped_azimuth(u.mean + K @ bar)
            Ps[t] = u.P - b.sum() * K @ S @ K.T + K @ scatter @ K.T
        association = np.vstack([missed, beta]).T
        R = np.array([n.R for n in noises])
        steps.append({"mean": np.array(means), "P": np.array(Ps), "association": association, "R": R})
    return collect(steps)

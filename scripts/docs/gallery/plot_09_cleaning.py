"""A track cleaned.

``torchfra.clean`` finds the noise, rejects outliers and lists manoeuvres, without any of it given.
"""

import numpy as np

import torchfra
from torchfra.cleaning import figures

rng = np.random.default_rng(0)
time = np.arange(0.0, 300.0, 2.0)
course = np.radians(3.0 * (time - 120.0).clip(0.0, 30.0))  # straight on, a left turn of 3 deg/s, straight on
path = 160.0 * np.cumsum(np.stack([np.cos(course), np.sin(course)], 1), 0)
fixes = path + 20.0 * rng.standard_normal(path.shape)
fixes[[40, 90, 120]] += [[2000.0, 500], [-300, 250], [900, -900]]

cleaned = torchfra.clean((time, fixes))
print(f"sigma {cleaned.found.sigma:.1f} m; error {np.hypot(*(cleaned.position - path).T).mean():.1f} m")
figure = figures.cleaned(cleaned)

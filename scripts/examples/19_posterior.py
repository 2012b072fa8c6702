"""The posterior of five hyperparameters by NUTS: ``LogLikelihood`` is a plain function for any sampler.

You learn how the compiled likelihood and its gradient, numpy in and numpy out, go into a sampler: here one of some
lines, as well BlackJAX, PyMC or emcee.  Source: Hoffman & Gelman (2014), "The No-U-Turn Sampler".
"""

import numpy as np
from torch.distributions import constraints

from torchfra import Gaussian, Hyper, fitting, motion, presets, sensors

USUAL, WIDE = np.array([1.4, -3.2, -4.6, 0.0, 0.7]), 0.5  # of the prior of unconstrained values


def simulated(raw, tracks, steps, rng):
    """The likelihood of tracks with values ``raw``: two sensors of a level, with a slope of which a share is kept."""
    x, z = np.zeros((tracks, 2)), np.empty((tracks, steps, 2))
    for k in range(steps):
        x = x @ np.array([[1, 0], [1, 1 / (1 + np.exp(-raw[0]))]]) + rng.normal(size=x.shape) * np.exp(raw[1:3] / 2)
        z[:, k] = x[:, :1] + rng.normal(size=x.shape) * np.exp(raw[3:])
    kept = Hyper(0.8, constraints.interval(0, 1), learn=True)
    moves = motion.Linear([[1, 1], [0, kept]], [Hyper(0.04, learn=True), Hyper(0.01, learn=True)])
    f = presets.srckf(moves, sensors.Linear([[1, 0], [1, 0]], [1.0, 4.0]), learn=("std",))
    return fitting.LogLikelihood(f, {"z": z, "prior": Gaussian.from_std(np.zeros((tracks, 2)), 0.0)})


def density(likelihood, raw):
    value, slope = likelihood(raw)
    return value - ((raw - USUAL) ** 2).sum(-1) / (2 * WIDE**2), slope - (raw - USUAL) / WIDE**2


def draws(likelihood, count, rng, step=0.5):
    """Draws ``(count, 5)`` from the posterior: trajectories double, to either side, until they turn back."""
    mode, small, y, found = USUAL, 1e-4 * np.eye(5), np.zeros(5), []
    for _ in range(15):  # Newton's method; in coordinates of this scale the posterior is about standard normal
        bent = (density(likelihood, mode - small)[1] - density(likelihood, mode + small)[1]) / 2e-4
        size, axes = np.linalg.eigh((bent + bent.T) / 2)
        scale = axes / np.sqrt(np.maximum(np.abs(size), 1 / WIDE**2))
        mode = mode + np.clip(scale @ (scale.T @ density(likelihood, mode)[1]), -1, 1)

    def leap(at, step):
        r = at[1] + step / 2 * at[2]
        y = at[0] + step * r
        value, slope = density(likelihood, mode + scale @ y)
        return y, r + step / 2 * (slope @ scale), slope @ scale, value

    def turns(a, b):
        return not min((b[0] - a[0]) @ a[1], (b[0] - a[0]) @ b[1]) >= 0  # as where the filter fails

    for _ in range(count):
        path, n, going = [leap((y, rng.normal(size=5), np.zeros(5)), 0.0)], 1, True
        least = path[0][3] - path[0][1] @ path[0][1] / 2 - rng.exponential()
        while going and len(path) < 1024:
            ahead, more = bool(rng.integers(2)), []
            for _ in path:
                more.append(leap(more[-1] if more else path[-ahead], step if ahead else -step))
            more = more if ahead else more[::-1]
            sizes = [2**k for k in range(1, len(more).bit_length())]
            if any(turns(more[i], more[i + size - 1]) for size in sizes for i in range(0, len(more), size)):
                break
            fits = [at[0] for at in more if at[3] - at[1] @ at[1] / 2 >= least]
            y = fits[rng.integers(len(fits))] if rng.uniform() * n < len(fits) else y
            path, n = path + more if ahead else more + path, n + len(fits)
            going = not turns(path[0], path[-1])
        found.append(mode + scale @ y)
    return np.array(found)


def main(count=500):
    """Prints 95 % intervals and true values of a data set of 64 tracks of 100 steps."""
    rng = np.random.default_rng(0)
    truth = USUAL + WIDE * rng.normal(size=5)
    likelihood = simulated(truth, 64, 100, rng)
    found = likelihood.natural(draws(likelihood, count, rng))
    for name, each, true in zip(likelihood.names, found.T, likelihood.natural(truth), strict=True):
        print(f"{name:<26} {np.quantile(each, 0.025):6.3f} to {np.quantile(each, 0.975):6.3f}, true {true:6.3f}")


if __name__ == "__main__":
    main()

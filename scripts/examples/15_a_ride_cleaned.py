"""A ride on a bicycle, as a phone records it, cleaned by one call.

You learn what ``torchfra.clean`` takes and gives: times and positions go in; the path, how sure it is, which fixes are
outliers and where it turned come out.  The ride is made up: streets with corners, a fix each second that is off by 4 m
per axis, and one in thirty by up to 100 m.
"""

import argparse
from pathlib import Path

import numpy as np

import torchfra
from torchfra.cleaning import figures
from torchfra.plotting import save


def ride(seconds: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times ``(k,)`` s, the path and the fixes ``(k, 2)`` m, and which fixes are outliers."""
    rng = np.random.default_rng(4)
    corners = np.repeat(rng.choice([-1, 0, 1], seconds // 40 + 1), 40)[:seconds] * (np.arange(seconds) % 40 < 8)
    heading = np.cumsum(corners * np.pi / 16)
    speed = 5.0 - 2.0 * np.abs(corners)
    path = np.cumsum(speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], 1), 0)
    wrong = rng.random(seconds) < 1 / 30
    off = 4.0 * rng.normal(size=path.shape)
    off[wrong] += rng.uniform(-100.0, 100.0, (wrong.sum(), 2))
    return np.arange(seconds, dtype=float), path, path + off, wrong


def main(arguments: list[str] | None = None) -> None:
    """Cleans the ride."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=600, help="of the ride (default: 600)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="PNG: the ride, before and after")
    options = parser.parse_args(arguments)
    time, path, fixes, wrong = ride(options.seconds)
    cleaned = torchfra.clean((time, fixes))
    before, after = (float(np.sqrt(np.square(x - path).sum(1).mean())) for x in (fixes, cleaned.position))
    found = cleaned.flag == "outlier"
    print(f"{before:.1f} m off before, {after:.1f} m after; {(found & wrong).sum()} of {wrong.sum()} outliers found, "
          f"{(found & ~wrong).sum()} others rejected; sigma {cleaned.found.sigma:.1f} m")  # fmt: skip
    if options.plot is not None:
        save(figures.cleaned(cleaned), options.plot)


if __name__ == "__main__":
    main()

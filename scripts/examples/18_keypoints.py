"""Keypoints of animals in a video, as movement and DeepLabCut have them: cleaned, and compared with usual filters.

You learn how poses in an ``xarray.Dataset`` are cleaned by a line, with confidence as their noise.  Two mice with three
keypoints are simulated at 30 frames a second: keypoints jitter by 2 pixels, are taken for others for some frames, or
are hidden, most of these with a low confidence.  Usual filters drop what has a low confidence, interpolate, and take a
rolling median or the filter of Savitzky and Golay.  Needs the extras
``frames`` and ``compiler``.
"""

import argparse

import numpy as np
import xarray
from numpy.lib.stride_tricks import sliding_window_view

from torchfra.adapters import poses

FPS, STD, SPEED = 30, 2.0, 60.0  # frames a second, pixels, pixels a second
NAMES = {"keypoints": ["snout", "centre", "tail"], "individuals": ["a", "b"], "space": ["x", "y"]}


def simulate(frames: int, seed: int) -> tuple[xarray.Dataset, xarray.DataArray]:
    """Poses as they are found in a video, and the true positions."""
    rng, shape = np.random.default_rng(seed), (frames, 2, 3, 2)  # time, space, keypoints, individuals
    kept = np.exp(-1 / FPS)  # of a velocity from frame to frame
    change = rng.normal(size=(frames, 3, 2))  # of velocities, and of the rates at which mice turn
    for k in range(1, frames):
        change[k] = kept * change[k - 1] + np.sqrt(1 - kept**2) * change[k]
    heading = np.cumsum(2 * change[:, 2], 0)[:, None] / FPS
    ahead = 20 * np.stack([np.cos(heading), np.sin(heading)], 1) * np.array([1, 0, -1])[:, None]
    velocity = SPEED * change[:, :2, None]
    truth = 300 + np.cumsum(velocity, 0) / FPS + ahead
    found, confidence = truth + STD * rng.normal(size=shape), rng.uniform(0.9, 1.0, (frames, 3, 2))
    for i, j in np.ndindex(3, 2):
        k = rng.geometric(1 / 60)
        while k < frames - 1:
            part = slice(k, min(k + rng.geometric(1 / 4), frames - 1))
            off = 60 * rng.normal(size=(1, 2)) if rng.uniform() < 0.5 else 25 * rng.normal(size=(part.stop - k, 2))
            found[part, :, i, j] += off
            confidence[part, i, j] = rng.uniform(0.05, 0.75)
            k = part.stop + rng.geometric(1 / 60)
    time, dims = np.arange(frames) / FPS, ("time", "space", "keypoints", "individuals")
    values = {"position": (dims, found), "confidence": (("time", *dims[2:]), confidence)}
    data = xarray.Dataset(values, {"time": time, **NAMES}, {"fps": FPS, "time_unit": "seconds"})
    return data, data.position.copy(data=truth)


def usual(data: xarray.Dataset) -> dict[str, xarray.DataArray]:
    """Confidence, interpolation, and a rolling median of 0.1 s or Savitzky and Golay's parabolas over 0.2 s."""
    sure = data.position.where(data.confidence >= 0.6)
    filled = sure.interpolate_na("time", use_coordinate=False)

    def rolling(window: int, weights: np.ndarray | None) -> xarray.DataArray:
        ends = [(window // 2, window // 2)] + [(0, 0)] * 3
        windows = sliding_window_view(np.pad(filled, ends, mode="reflect"), window, 0)
        return filled.copy(data=np.median(windows, -1) if weights is None else windows @ weights)

    parabolas = np.linalg.pinv(np.vander(np.arange(-3, 4), 3, increasing=True))[0]
    return {"rolling median": rolling(3, None), "Savitzky-Golay": rolling(7, parabolas)}


def error(position: xarray.DataArray, truth: xarray.DataArray) -> float:
    """Root of the mean square of the distance from the truth, pixels."""
    return float(((position - truth) ** 2).sum("space").mean() ** 0.5)


def main(arguments: list[str] | None = None) -> None:
    """Prints the error of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=900, help="frames (default: 900)")
    parser.add_argument("--seed", type=int, default=0, help="of the mice (default: 0)")
    options = parser.parse_args(arguments)
    data, truth = simulate(options.frames, options.seed)
    cleaned = poses.clean(data, compile=True)
    for name, found in {"as found": data.position, **usual(data), "poses.clean": cleaned.position}.items():
        print(f"{name:<15} error {error(found, truth):5.2f} pixels")


if __name__ == "__main__":
    main()

"""A recording after a filter: its columns, its table as text, its summary."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchfra.readers.recording import Recording

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Filtered:
    """A recording after a filter; ``T`` steps, ``d`` dimensions of space."""

    recording: Recording
    time: Array
    """``(T,)`` seconds since the first fix."""
    raw: Array
    """``(T, d)`` positions as recorded, m; NaN at steps between fixes."""
    position: Array
    """``(T, d)`` m."""
    velocity: Array
    """``(T, d)`` m/s."""
    std: Array
    """``(T, d)`` standard deviation of the position, m."""
    nis: Array
    """``(T,)`` normalised innovation squared."""
    flags: dict[str, NDArray[np.bool_]]
    """``missing``, ``outlier``, ``manoeuvre``: ``(T,)`` each."""
    decided: bool = True
    """Whether the filter tells outliers from manoeuvres; the flags of others only say that a step is above the gate."""
    models: tuple[str, ...] = ()
    """Names of the models, where some interact."""
    leading: NDArray[np.intp] | None = None
    """``(T,)`` the most probable of them."""

    def columns(self) -> dict[str, Any]:
        """The columns of a table, by name; with latitude and longitude where the recording has an origin."""
        axes = "xyz"[: self.raw.shape[1]]
        table: dict[str, Any] = {"time": self.recording.time[0] + self.time}
        for prefix, values in (("raw_", self.raw), ("", self.position), ("v", self.velocity), ("std_", self.std)):
            table |= {prefix + axis: values[:, i] for i, axis in enumerate(axes)}
        if self.recording.origin is not None:
            table |= self._geodetic(self.recording.origin)
        table |= {"nis": self.nis} | {name: flag.astype(int) for name, flag in self.flags.items()}
        return table if self.leading is None else table | {"model": np.array(self.models)[self.leading]}

    @property
    def failed(self) -> NDArray[np.bool_]:
        """``(T,)`` which steps have an estimate that is not finite."""
        together = np.concatenate([self.position, self.velocity, self.std], 1)
        return np.asarray(~np.isfinite(together).all(1))

    def marks(self) -> dict[str, NDArray[np.bool_]]:
        """The steps to point out, by what they are: ``(T,)`` each."""
        if self.decided:
            return {name: self.flags[name] for name in ("outlier", "manoeuvre")}
        return {"above the gate": self.flags["outlier"] | self.flags["manoeuvre"]}

    def csv(self) -> str:
        """The columns as comma-separated text; an empty cell is NaN."""
        table = self.columns()
        digits = {"time": 3, "latitude": 7, "longitude": 7}
        cells = [
            [str(v) if v.dtype.kind in "iU" else "" if np.isnan(v) else f"{v:.{digits.get(name, 3)}f}" for v in column]
            for name, column in table.items()
        ]
        return "\n".join([",".join(table), *(",".join(row) for row in zip(*cells, strict=True))]) + "\n"

    def summary(self) -> dict[str, Any]:
        """Counts and distances: what ``--json`` writes of a track."""
        counts = {name: int(flag.sum()) for name, flag in self.flags.items()}
        off = np.linalg.norm(self.raw - self.position, axis=1)
        off = off[~np.isnan(off)] if not np.isnan(off).all() else np.array([np.nan])
        return {
            "name": self.recording.name,
            "steps": len(self.time),
            "seconds": float(self.time[-1]),
            **counts,
            "median_correction": float(np.median(off)),
            "largest_correction": float(off.max()),
            "failed": bool(self.failed.any()),
            "repairs": self.recording.repairs,
            **({} if self.leading is None else {"steps_led": self._steps_led(self.leading)}),
        }

    def _steps_led(self, leading: NDArray[np.intp]) -> dict[str, int]:
        counts = np.bincount(leading, minlength=len(self.models)).tolist()
        return dict(zip(self.models, counts, strict=True))

    def _geodetic(self, origin: tuple[float, float, float]) -> dict[str, Array]:
        from pymap3d import enu2geodetic  # there, or the recording could not have been read

        up = self.position[:, 2] if self.position.shape[1] == 3 else 0.0
        latitude, longitude, _ = enu2geodetic(self.position[:, 0], self.position[:, 1], up, *origin)
        return {"latitude": latitude, "longitude": longitude}

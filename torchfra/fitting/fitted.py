"""The result of a fit: values, their standard errors, and their loss on held-out tracks."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchfra.filters import Filter
from torchfra.fitting.data import Batch
from torchfra.fitting.errors import Bootstrap, Certainty, Profile, bootstrap, profile
from torchfra.fitting.judging import HeldOutComparison, Judged, judged
from torchfra.fitting.minibatches import Settings
from torchfra.fitting.newton import Sums
from torchfra.fitting.objective import Objective
from torchfra.pictures import picture_format
from torchfra.running.atomic_write import write_json
from torchfra.running.versions import versions
from torchfra.tables import text_table

QUANTITIES = {
    "likelihood": "minus log likelihood per measurement",
    "smoothed": "minus log density per hidden measurement",
    "robust": "robust loss",
    "mse": "mean squared error",
    "nll": "minus log density of the truth",
}
"""Losses in words."""


@dataclass(frozen=True)
class FitTracks:
    """The tracks of a fit, and their losses."""

    objective: Objective
    sums: Sums
    """Losses of the tracks for learning."""
    test: Batch

    @property
    def measured(self) -> Tensor | None:
        """``(N,)`` number of measured steps of the test tracks, which weights likelihoods; None for other losses."""
        if self.objective.loss not in ("likelihood", "smoothed"):
            return None
        return (~self.test.z.isnan()).flatten(2).any(-1).sum(1).cpu()

    def judge(self, before: Tensor, after: Tensor, seed: int) -> Judged:
        """Losses ``(N,)`` of test tracks, per measurement where they are likelihoods."""
        steps = self.measured
        scale = 1.0 if steps is None else 1.0 / steps.clamp_min(1)
        return judged(before * scale, after * scale, weights=steps, seed=seed)


@dataclass(frozen=True)
class Fitted:
    """The result of ``torchfra.fit``; ``print`` shows it as tables."""

    filter: Filter
    """The filter with the learned values, which are fixed now."""
    start: dict[str, float]
    """The values before the fit, in natural units."""
    learned: dict[str, float]
    """The learned values, in natural units."""
    certainty: Certainty
    """Standard errors, intervals, what is identified."""
    held_out: dict[str, Judged]
    """Losses before and after, by quantity, on tracks used neither for learning nor for stopping."""
    rows: list[dict[str, float]]
    """The learning curve: one row for each iteration."""
    restarts: list[float]
    """The final validation loss from each start."""
    settings: Settings
    compiled: bool
    """Whether the filter ran as compiled kernels."""
    dtype: str
    """Precision of the descent; standard errors are computed in float64."""
    counts: dict[str, int]
    """Numbers of tracks for learning, stopping and judging, and left out."""
    seconds: float
    notes: list[str]
    """Warnings, and departures from the arguments."""
    _tracks: FitTracks = field(repr=False)
    _raw: Tensor = field(repr=False)

    @property
    def errors(self) -> dict[str, float]:
        """Standard errors of the learned values, in natural units."""
        return dict(zip(self.learned, self.certainty.errors.tolist(), strict=True))

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """95 % intervals of the learned values."""
        return dict(
            zip(self.learned, zip(self.certainty.low.tolist(), self.certainty.high.tolist(), strict=True), strict=True)
        )

    def compare(self, others: Mapping[str, Filter | Fitted]) -> HeldOutComparison:
        """This filter, named ``"fitted"``, and others on the held-out tracks.

        Args:
            others: by name; filters with the same state, or fits with the same data, seed and loss.

        Raises:
            ValueError: no filters by name, fits of other tracks, or a filter of other measurements.
        """
        if not isinstance(others, Mapping) or not all(isinstance(other, Filter | Fitted) for other in others.values()):
            raise ValueError(f"others: expected filters or fits by name, received {others!r:.80}")
        if "fitted" in others:
            raise ValueError("others: expected names other than 'fitted', which is this filter, received 'fitted'")
        tracks = self._tracks
        mine = tracks.objective.losses(self._raw[None, None], tracks.test)[0]
        rows = {"fitted": tracks.judge(mine, mine, self.settings.seed)}
        for name, other in others.items():
            f = other.filter if isinstance(other, Fitted) else other
            test = other._tracks.test if isinstance(other, Fitted) else tracks.test
            if test.z.shape != tracks.test.z.shape or not torch.equal(test.z.nan_to_num(), tracks.test.z.nan_to_num()):
                raise ValueError(f"others: expected fits with the same data and seed, {name} has other tracks")
            if f.sensor.size != test.z.shape[-1]:
                raise ValueError(f"others: expected sensors of {test.z.shape[-1]} elements, {name} has {f.sensor.size}")
            loss = tracks.objective.of_filter(f, test)
            rows[name] = tracks.judge(mine, loss, self.settings.seed)
        return HeldOutComparison(f"{self.quantity}, {_those_that_judge(tracks.test, self.counts['test'])}", rows)

    def profile(self, name: str, *, points: int = 9, reach: float = 3.0) -> Profile:
        """Profile of the loss over one number, minimised over all others: ``fitting.errors.profile``."""
        return profile(self._tracks.sums, self._raw, self.certainty, name, points=points, reach=reach)

    def bootstrap(self, resamples: int = 100) -> Bootstrap:
        """Standard errors by fits to tracks drawn with replacement: ``fitting.errors.bootstrap``."""
        return bootstrap(self._tracks.sums, self._raw, resamples, self.settings.seed)

    @property
    def quantity(self) -> str:
        """The loss in words."""
        return QUANTITIES.get(self.settings.loss, "loss")

    def to_json(self, path: str | Path | None = None) -> dict[str, Any]:
        """The result with settings and versions; also written to ``path`` if that is not None."""
        certainty = self.certainty
        data = {
            "values": {
                name: {"start": self.start[name], "learned": self.learned[name], "error": self.errors[name],
                       "interval": list(self.intervals[name]), "identified": identified}
                for name, identified in zip(self.learned, certainty.identified, strict=True)
            },
            "condition": certainty.condition, "weakest": certainty.weakest, "gradient": certainty.gradient_size,
            "held_out": {name: {when: figure._asdict() for when, figure in row.figures.items()}
                         for name, row in self.held_out.items()},
            "restarts": self.restarts, "tracks": self.counts, "settings": dataclasses.asdict(self.settings),
            "dtype": self.dtype, "compiled": self.compiled, "seconds": self.seconds, "notes": self.notes,
            "versions": versions(), "curve": self.rows,
        }  # fmt: skip
        if path is not None:
            write_json(path, data)
        return data

    def plot(self, path: str | Path | None = None) -> Any:
        """The learning curve, a figure of matplotlib; written to ``path`` if there is one, as PDF, SVG or PNG.

        Raises:
            ValueError: a file name with another ending.
            OSError: it cannot be written.
        """
        if path is not None:
            picture_format(path)
        from torchfra import plotting

        title = f"fit by {self.settings.loss}, seed {self.settings.seed}"
        figure = plotting.learning_curve(self.rows, self.start, title)
        if path is not None:
            plotting.save(figure, Path(path))
        return figure

    def __str__(self) -> str:
        certainty = self.certainty
        rows = [
            [name, f"{self.start[name]:.5g}", f"{value:.5g}", f"{self.errors[name]:.2g}",
             "[{:.5g}, {:.5g}]".format(*self.intervals[name]), "yes" if identified else "no"]
            for (name, value), identified in zip(self.learned.items(), certainty.identified, strict=True)
        ]  # fmt: skip
        text = text_table(["value", "start", "learned", "standard error", "95 %", "identified"], rows, align="<>>>>>")
        text += f"\ncondition {certainty.condition:.3g}; least identified: {certainty.weakest}\n"
        rows = [[name, *map(str, row.figures.values())] for name, row in self.held_out.items()]
        heads = next(iter(self.held_out.values())).figures
        text += text_table([_those_that_judge(self._tracks.test, self.counts["test"]), *heads], rows) + "\n"
        how = "compiled" if self.compiled else "interpreted"
        text += f"{len(self.rows)} iterations, {self.seconds:.1f} s, {self.dtype}, {how}, seed {self.settings.seed}"
        return "\n".join([text, *(f"note: {line}" for line in self.notes)])


def _those_that_judge(tracks: Batch, held_out: int) -> str:
    """The tracks that values are judged by, in words."""
    return f"{held_out} held-out tracks" if held_out else f"{len(tracks.z)} tracks, none held out"

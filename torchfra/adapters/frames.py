"""Tables of pandas and polars, in and out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import pandas as pd
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchfra.motion.base import Motion
from torchfra.types import Estimate


def estimates(estimate: Estimate, motion: Motion, time: ArrayLike | None = None) -> pd.DataFrame:
    """An estimate of one track as a table: means by the names of the components, ``std_*`` beside them, and ``nis``.

    Args:
        estimate: ``mean (T, n)``.
        motion: whose components they are.
        time: ``(T,)`` of the rows, which becomes the index; None for none.

    Raises:
        ValueError: a batch of tracks.
    """
    if estimate.mean.dim() != 2:
        raise ValueError(f"estimate: expected one track (T, n), received {tuple(estimate.mean.shape)}")
    std = estimate.scale_tril.square().sum(-1).sqrt()
    columns = {name: estimate.mean[:, i] for i, name in enumerate(motion.components)}
    columns |= {f"std_{name}": std[:, i] for i, name in enumerate(motion.components)} | {"nis": estimate.nis}
    index = None if time is None else pd.Index(time, name="time")
    return pd.DataFrame({name: x.detach().numpy() for name, x in columns.items()}, index=index)


class Exported(Protocol):
    """A table that pandas takes, such as one of polars."""

    def to_pandas(self) -> pd.DataFrame:
        """The table in pandas."""
        ...


def measurements(frame: pd.DataFrame | Exported, names: Sequence[str], *, time: str) -> tuple[Tensor, Tensor]:
    """Columns of a table as measurements, rows in order of time.

    Args:
        frame: a row for each measurement; of pandas or polars.
        names: of the columns that are measured.
        time: of the column that tells when, in seconds or moments.

    Returns:
        ``z (T, m)`` and ``dt (T - 1,)`` seconds from each to the next.

    Raises:
        ValueError: a column that is not there.
    """
    if not isinstance(frame, pd.DataFrame):
        frame = frame.to_pandas()
    for name in (*names, time):
        if name not in frame:
            raise ValueError(f"names: expected some of {', '.join(map(str, frame.columns))}, received {name}")
    frame = frame.sort_values(time, kind="stable")
    when = frame[time]
    seconds = (when - when.iloc[0]).dt.total_seconds() if pd.api.types.is_datetime64_any_dtype(when.dtype) else when
    z = torch.from_numpy(frame[list(names)].to_numpy(dtype=float, na_value=np.nan).copy())
    return z, torch.from_numpy(np.diff(seconds.to_numpy(dtype=float)))

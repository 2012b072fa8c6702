"""Filters of the catalogue on recorded tracks: their estimates, and probabilities of outliers."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchfra.catalogue import FILTERS, make_filter
from torchfra.cleaning.batches import Steps, padded
from torchfra.cleaning.flags import GATE
from torchfra.cleaning.kinds import UNKNOWN
from torchfra.cleaning.positions import Settings
from torchfra.filters import Filter
from torchfra.motion.bank import Bank, aircraft, people, ships, vehicles
from torchfra.motion.polynomial import ConstantVelocity
from torchfra.sensors.position import Position
from torchfra.steps.records import SmoothInfo
from torchfra.types import Estimate, Gaussian

LONGEST_GAP = 60.0
"""Seconds without a usable fix after which a filter of constant gains restarts."""
BANKS = {
    "person": people, "ship": ships, "vehicle": vehicles, "aircraft": aircraft,
    "marine": people, "animal": people, "bird": vehicles, UNKNOWN: vehicles,
}  # fmt: skip
"""Motions of each kind, for filters with several."""


def make(name: str, d: int, sigma: Tensor, q: Tensor, period: Tensor, bank: Bank | None = None) -> Filter:
    """The filter of this name for positions in ``d`` dimensions, for a batch ``(B,)`` of each value.

    Raises:
        ValueError: an unknown filter, or a bank whose motions are of another space.
    """
    entry, options = FILTERS.get(name), dict[str, object]()
    if entry is not None and entry.gated:
        options["gate"] = GATE[d]
    if entry is not None and entry.constant_gains:
        options |= {"max_gap": LONGEST_GAP, "period": period}
    if bank is not None and bank.dims != d:
        raise ValueError(f"bank: expected motions in {d} dimensions, received {bank.dims}")
    motion = ConstantVelocity(q, d, orders=3, continuous=True)
    sensor = Position(sigma.unsqueeze(-1).expand(-1, d), dims=d)
    return make_filter(name, motion, sensor, bank or aircraft(q, d, continuous=True), **options)


def estimated(f: Filter, tracks: Sequence[Steps], sigma: Tensor, settings: Settings) -> Estimate:
    """Estimates of a filter for tracks as one batch."""
    z, gaps, std = padded(tracks)
    n, d = f.motion.size, z.shape[-1]
    first = torch.nan_to_num(z[:, 0])
    mean = torch.cat([first, first.new_zeros(len(z), n - d)], -1)
    spread = torch.tensor([1.0, 300.0, 5.0], dtype=z.dtype).repeat_interleave(d)[:n]
    root = torch.cat([10 * sigma.unsqueeze(-1).expand(-1, d), torch.ones_like(mean[:, d:])], -1) * spread
    own = None if bool((std == 1).all()) else std * sigma[:, None, None]
    arguments = {"z": z, "prior": Gaussian(mean, root.diag_embed()), "dt": gaps, "std": own}
    with torch.no_grad():
        return (f.smooth if settings.smooth else f)(**arguments)  # type: ignore[arg-type]


def outlier_of(estimate: Estimate) -> Tensor:
    """Probability ``(..., T)`` that a fix is an outlier: the largest of ``info.outlier``; NaN where there is none."""
    info = estimate.info
    if isinstance(info, SmoothInfo) and info.outlier is None:
        info = info.filtered.info
    found = getattr(info, "outlier", None)
    return torch.full_like(estimate.nis, torch.nan) if found is None else found.to(estimate.nis).amax(-1)

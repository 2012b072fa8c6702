"""The closed form of ``cleaning.closed_form`` as a module, ``filters.GPB``."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.cleaning.closed_form import Levels, OutlierModel
from torchfra.filters import GPB, Outliers, Regimes
from torchfra.motion.bank import Bank
from torchfra.motion.polynomial import ConstantVelocity
from torchfra.sensors.position import Position


def as_gpb(levels: Levels, sigma: Tensor, model: OutlierModel, dims: int) -> GPB:
    """This filter as a module: a bank of one motion with several densities of process noise.

    A step without a fix is a prediction here (``GPB.predict``) and no step.

    Args:
        levels: of the process noise, two or more.
        sigma: ``(B,)`` standard deviations of fixes, m.
        model: how likely outliers are.
        dims: the number of axes.
    """
    outliers = Outliers(
        [range(dims)],
        outlier_transition=model.transition(sigma).permute(2, 1, 0),
        outlier_sizes=(max(model.least_size, float((model.least_offset / sigma).square().max())),),
        outlier_shares=(1.0,),
        outliers_update=False,
        same_offset=float(model.same_offset) or None,
    )
    regimes = Regimes(
        len(levels.q), noise_levels=(1.0,), jump_factors=(), durations=levels.duration.T,
        restart=levels.log_restart.exp().T,
    )  # fmt: skip
    bank = Bank([
        ConstantVelocity(q, dims, continuous=True) if not walk.any() else _Walking(q, walk, dims)
        for q, walk in zip(levels.q, levels.walk, strict=True)
    ])  # fmt: skip
    sensor = Position(sigma.unsqueeze(-1).expand(-1, dims), dims=dims)
    share = model.share(sigma)
    return GPB(bank, sensor, regimes=regimes, outliers=outliers, prior_outlier=share, prior_inflation=1.0)


class _Walking(ConstantVelocity):
    """Constant velocity with white acceleration noise, and a random walk of the position."""

    def __init__(self, q: Tensor, walk: Tensor, dims: int) -> None:
        super().__init__(q, dims, continuous=True)
        self.register_buffer("walk", walk)

    def process_noise(self, dt: Tensor) -> Tensor:
        """``S_Q (..., n, 3 dims)``."""
        root = super().process_noise(dt)
        step = (self.get_buffer("walk") * dt).sqrt()
        return torch.cat([root, step[..., None, None] * torch.eye(self.size, self.dims).to(root)], -1)

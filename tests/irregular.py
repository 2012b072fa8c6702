"""A plane target that is measured at irregular times, with gaps."""

import torch

from torchfra.motion import ConstantVelocity
from torchfra.types import Gaussian

F64 = {"dtype": torch.float64}
MOTION = ConstantVelocity(0.3, continuous=True)
PRIOR = Gaussian(torch.tensor([1.0, -2, 3, 4], **F64), torch.tensor([5.0, 6, 2, 1], **F64).diag())
DT = torch.tensor([0.5, 1, 3, 1, 0.2, 8, 1, 1, 2, 1], **F64)


def close(a, b, tolerance=1e-9):
    """Whether both are the same but for rounding."""
    torch.testing.assert_close(a, torch.as_tensor(b, **F64), rtol=tolerance, atol=tolerance)


def measured(*batch):
    """Measurements ``(..., T, 2)`` of which some are missing, in whole or in part."""
    z = 10 * torch.randn(*batch, len(DT), 2, generator=torch.Generator().manual_seed(3), **F64)
    z[..., 3, 0], z[..., 6, :] = torch.nan, torch.nan
    return z

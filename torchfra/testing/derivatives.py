"""Checks of gradients: finite, right, and the same compiled."""

from __future__ import annotations

import torch
from torch import Tensor

from torchfra.testing.case import STEPS, Case, check, gradients, says
from torchfra.testing.expectations import expect, expect_finite, expect_same
from torchfra.types import Gaussian


@check("eager")
def gradients_are_finite_and_none_comes_from_missing_data(case: Case) -> None:
    """With respect to data, prior and every value; exactly 0 where nothing was measured."""
    found = gradients(case)
    expect_finite(found, "gradient")
    missing = found["z"][case.z.isnan()]
    expect(not bool(missing.any()), "gradient of missing elements", 0, missing.abs().max().item())


@check("eager")
def gradients_are_those_of_small_differences(case: Case) -> None:
    """Along some direction of all data, in units of their gradients, and of each value that learns."""
    found = gradients(case)
    for name, value in case.filter.named_parameters():
        with torch.no_grad():
            kept, direction, size = value.clone(), torch.ones_like(value), 1e-6
            sides = []
            for step in (size, -size):
                value.copy_(kept + step * direction)
                sides.append(says(case(), case.prior))
            value.copy_(kept)
        _expect_slope(sides, size, found[name].sum(), f"gradient of {name}")
    for name in ("z", "prior.mean"):
        direction = found[name] / found[name].abs().max().clamp_min(1e-12)
        sides, size = [], 1e-6 * float(case.std.min())
        with torch.no_grad():
            for step in (size, -size):
                moved = {"z": case.z, "prior.mean": case.prior.mean}
                moved[name] = moved[name] + step * direction
                sides.append(says(case(moved["z"], Gaussian(moved["prior.mean"], case.prior.scale_tril)), case.prior))
        _expect_slope(sides, size, (found[name] * direction).sum(), f"gradient of {name}")


def _expect_slope(sides: list[Tensor], size: float, slope: Tensor, what: str) -> None:
    difference = (sides[0] - sides[1]) / (2 * size)
    rounding = 1e-14 * float(sides[0].abs()) / size  # of the difference
    allowed = 1e-3 * float(slope.abs()) + 10 * rounding + 1e-6
    expect(bool((difference - slope).abs() <= allowed), what, difference.item(), slope.item())


@check("eager", "compiled")
def checkpoints_leave_the_gradient_and_truncation_cuts_it(case: Case) -> None:
    """``checkpoint=`` changes no number; with ``truncate=`` the last estimate says nothing of the first steps."""
    expect_same(gradients(case, checkpoint=2)["z"], gradients(case)["z"], "gradient with checkpoint=2")
    truncated = gradients(case, truncate=STEPS - 1, checkpoint=2)
    expect_finite(truncated, "gradient with truncate")
    z = case.z.clone().requires_grad_()
    estimate = case(z, truncate=STEPS - 2)
    expect_same(estimate.mean.detach(), case.estimate.mean, "mean with truncate")


@check("eager")
def single_precision_has_finite_gradients(case: Case) -> None:
    """In float32 too, near those of float64 as far as rounding lets them."""
    expect_finite(gradients(case, torch.float32), "gradient in float32")


@check("compiled")
def compiled_gradients_are_those_of_eager(case: Case) -> None:
    """With respect to data, prior and every value."""
    assert case.eager is not None
    slow, fast = gradients(case.eager), gradients(case)
    for name, gradient in slow.items():
        expect_same(fast[name], gradient, f"compiled gradient of {name}", 1e-7)
    if case.thorough:
        expect_finite(gradients(case, torch.float32), "compiled gradient in float32")

"""Checks of gradients: finite, equal to finite differences, and equal when compiled."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchfra.testing.case import STEPS, Case, check, gradients, one_number, own_gradients
from torchfra.testing.expectations import LOOSER, expect, expect_finite, expect_same


@check("eager")
def gradients_are_finite_and_none_comes_from_missing_data(case: Case) -> None:
    """Gradients by data, prior and every value are finite, and exactly 0 for missing measurements."""
    found = own_gradients(case)
    expect_finite(found, "gradient")
    missing = found["z"][case.z.isnan()]
    expect(not bool(missing.any()), "gradient of missing elements", 0, missing.abs().max().item())


@check("eager")
def gradients_are_those_of_small_differences(case: Case) -> None:
    """Gradients by learnable values, and along the gradient by the data, agree with central differences.

    Steps within which a decision flips are not compared.
    """
    found = own_gradients(case)
    for name, value in case.filter.named_parameters():
        kept = value.detach().clone()
        along = torch.linspace(1.0, 2.0, value.numel(), dtype=value.dtype).reshape(value.shape)

        def moved(step: float, value: Tensor = value, target: tuple[Tensor, Tensor] = (kept, along)) -> Tensor:
            value.copy_(target[0] + step * target[1])
            return one_number(case(), case.prior)

        try:
            _expect_slope(moved, 1e-5, (found[name] * along).sum(), f"gradient of {name}")
        finally:  # or the checks that follow would compare filters with different values
            with torch.no_grad():
                value.copy_(kept)
    spread = case.prior.covariance.diagonal(dim1=-2, dim2=-1).min().sqrt()
    for name, std in (("z", case.std.min()), ("prior.mean", torch.minimum(case.std.min(), spread))):
        along = found[name] / found[name].abs().max().clamp_min(1e-12)

        def pushed(step: float, name: str = name, along: Tensor = along) -> Tensor:
            given = {"z": case.z, "prior.mean": case.prior.mean}
            given[name] = given[name] + step * along
            prior = case.prior._replace(mean=given["prior.mean"])
            return one_number(case(z=given["z"], prior=prior), case.prior)

        _expect_slope(pushed, 1e-5 * float(std), (found[name] * along).sum(), f"gradient of {name}")


@torch.no_grad()
def _expect_slope(moved: Callable[[float], Tensor], size: float, slope: Tensor, what: str) -> None:
    """Expects a central difference, up to rounding: of this step, or of finer ones where the slope bends strongly.

    Not at a jump, whose difference grows as the step shrinks.
    """
    differences = []
    for step in (size, size / 10, size / 100, size / 1000, size / 10_000):
        high, low = moved(step), moved(-step)
        differences.append((high - low) / (2 * step))
        rounding = LOOSER.get() * 1e-12 * high.abs() / step
        if step < size and bool(rounding > 0.01 * slope.abs()):
            break  # it would hide a wrong gradient
        if bool((differences[-1] - slope).abs() <= 1e-4 * slope.abs() + rounding + 1e-6):
            return
    jump = bool(differences[1].abs() > 5 * differences[0].abs())
    expect(jump, what, differences[0].item(), slope.item())


@check("eager", "compiled")
def checkpoints_leave_the_gradient_and_truncation_cuts_it(case: Case) -> None:
    """``checkpoint=`` changes no number; with ``truncate=`` the last estimate has no gradient in the first steps."""
    for name, gradient in gradients(case, checkpoint=2).items():
        expect_same(gradient, own_gradients(case)[name], f"gradient of {name} with checkpoint=2")
    truncated = gradients(case, truncate=STEPS - 1, checkpoint=2)
    expect_finite(truncated, "gradient with truncate")
    z = case.z.clone().requires_grad_()
    estimate = case(z=z, truncate=STEPS - 2)
    expect_same(estimate.mean.detach(), case.estimate.mean, "mean with truncate")


@check("eager")
def single_precision_has_finite_gradients(case: Case) -> None:
    """In float32 too, near those of float64 as far as rounding lets them."""
    expect_finite(gradients(case, torch.float32), "gradient in float32")


@check("compiled")
def compiled_gradients_are_those_of_eager(case: Case) -> None:
    """With respect to data, prior and every value."""
    assert case.eager is not None
    slow, fast = own_gradients(case.eager), own_gradients(case)
    nothing = 1e-14 * max(float(x.abs().nan_to_num().max()) for x in slow.values() if x.numel())
    for name, gradient in slow.items():
        # What a value that does not matter has is rounding of the others.
        found, expected = (torch.where(x.abs() < nothing, 0.0, x) for x in (fast[name], gradient))
        expect_same(found, expected, f"compiled gradient of {name}", 1e-7)
    if case.thorough:
        expect_finite(gradients(case, torch.float32), "compiled gradient in float32")

"""Checks of results: independent of batching, streaming, memory layout, precision, compilation, copies, transforms."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchfra import tree
from torchfra.filters.srckf import SRCKF
from torchfra.linalg.triangular import apply
from torchfra.metrics.errors import error, nees
from torchfra.motion.bank import Bank
from torchfra.motion.base import Motion
from torchfra.testing.case import STEPS, TRACKS, Case, SkipCheck, check, drawn
from torchfra.testing.expectations import TOLERANCE, difference, expect, expect_finite, expect_same
from torchfra.types import Cause, Estimate, Gaussian

ROUNDINGS = 30.0
"""Change of an estimate by a filter in float32, as a multiple of that by data rounded to float32, at most."""
FIELDS = ("mean", "scale_tril", "nis", "log_likelihood")
RUNS, LENGTH, FIRST = 100, 60, 20
"""Number of tracks, of their steps, and the first step that counts."""
BEHIND = 0.02
"""Relative increase of the position error over that of ``srckf``, at most."""
CONSISTENT = 0.9, 1.1
"""Bounds of the mean normalised estimation error squared, per component of the state."""


@check("eager", "compiled")
def estimates_are_finite_and_of_the_promised_shape(case: Case) -> None:
    """Means, roots and scores have the shapes of the tracks, and hold numbers."""
    estimate, n = case.estimate, case.filter.motion.size
    batch = case.prior.mean.shape[:-1]
    scores = batch[: len(batch) - case.filter.scans] if estimate.nis.dim() == 2 else batch
    shapes = {"mean": (*batch, STEPS, n), "scale_tril": (*batch, STEPS, n, n), "nis": (*scores, STEPS)}
    for name, shape in shapes.items():
        expect(getattr(estimate, name).shape == shape, name, shape, tuple(getattr(estimate, name).shape))
    expect_finite({name: getattr(estimate, name) for name in FIELDS}, "estimate")
    expect(not bool(estimate.failed.any()), "failed", "no track", estimate.failed.tolist())
    for leaf in tree.flatten(estimate.info):
        expect(leaf.shape[: len(batch)] == batch, "info", f"tensors that begin with {tuple(batch)}", tuple(leaf.shape))


@check("eager")
def a_single_track_needs_no_batch_and_no_company(case: Case) -> None:
    """Every track has the estimate that it has alone."""
    for i in range(TRACKS):
        z, prior, u = case.alone(i)
        expect_same(case(z=z, prior=prior, u=u), _track(case.estimate, i), f"estimate of track {i} alone", 1e-7)


@check("eager", "compiled")
def steps_give_what_whole_tracks_give(case: Case) -> None:
    """Single steps give the estimates of the whole sequence."""
    estimate, state = case.estimate, case.filter.init(case.prior)
    now = getattr(estimate.info, "provisional", getattr(estimate.info, "filtered", estimate))
    for k in range(STEPS):
        state, innovation = case.step(state=state, z=case.z[:, k], u=case.u_at(k))
        expect_same(state.belief.mean, now.mean.select(-2, k), f"mean of step {k}")
        expect_same(innovation.log_likelihood, estimate.log_likelihood[..., k], f"log_likelihood of step {k}")
        expect_same(innovation.nis, estimate.nis[..., k], f"nis of step {k}")
        if k and hasattr(state, "lagged"):
            settled = getattr(estimate.info, "lagged", estimate)
            expect_same(state.lagged.mean, settled.mean.select(-2, k - 1), f"mean of step {k - 1}, settled by the next")


@check("eager")
def time_steps_may_differ_per_step_and_per_track(case: Case) -> None:
    """``dt`` of ``(T,)``, ``(B, 1)`` and ``(B, T)`` is that of each track and step."""
    per_step = case.dt * torch.linspace(0.8, 1.2, STEPS, dtype=torch.float64)
    per_track = torch.linspace(0.9, 1.1, TRACKS, dtype=torch.float64).unsqueeze(-1)
    ways = {"dt (T,)": per_step, "dt (B, T)": per_track * per_step, "dt (B, 1)": case.dt * per_track}
    for name, dt in ways.items():
        together = case(dt=dt)
        for i in range(TRACKS) if case.thorough else (1,):
            z, prior, u = case.alone(i)
            own = dt if dt.dim() == 1 else dt[i]
            expect_same(
                case(z=z, prior=prior, u=u, dt=own), _track(together, i), f"estimate of track {i} with {name}", 1e-7
            )


@check("eager")
def noise_may_come_with_the_measurements(case: Case) -> None:
    """``std=`` is the noise of its measurements, and ``noise=`` a root of the covariance."""
    std, plain = case.std, case.estimate.log_likelihood
    other = case(std=std)
    expect(not torch.equal(other.log_likelihood, plain), "std", "an estimate that follows it", "the one without")
    if getattr(case.filter.sensor, "std", None) is None or not _takes(case, noise=torch.diag_embed(std)):
        return
    expect_same(case(noise=torch.diag_embed(std)), other, "estimate with noise= for std=", 1e-7)


@check("eager", "compiled")
def no_tracks_are_no_error(case: Case) -> None:
    """An empty batch has an empty estimate."""
    prior, u = Gaussian(*(x[:0] for x in case.prior)), case.u
    estimate = case(z=case.z[:0], prior=prior, u=u if u is None or u.dim() == 2 else u[:0])
    expected = (0, *case.estimate.mean.shape[1:])
    expect(estimate.mean.shape == expected, "mean", expected, tuple(estimate.mean.shape))


@check("eager", "compiled")
def one_step_is_enough(case: Case) -> None:
    """A track of one step has the scores of the first step of a longer one."""
    u = case.u if case.u is None else case.u[..., :1, :]
    estimate = case(z=case.z[:, :1], u=u)
    expect_same(estimate.log_likelihood, case.estimate.log_likelihood[..., :1], "log_likelihood of one step")


@check("eager", "compiled")
def memory_layout_does_not_matter(case: Case) -> None:
    """Expanded and strided tensors give the results of contiguous ones."""
    strided = case.z.transpose(0, 1).contiguous().transpose(0, 1)
    wide = torch.stack([case.z, -case.z], -1)[..., 0]
    for name, z in {"transposed": strided, "every second number": wide}.items():
        prior = Gaussian(case.prior.mean.mT.contiguous().mT, case.prior.scale_tril.mT.contiguous().mT)
        expect_same(case(z=z, prior=prior), case.estimate, f"estimate of z {name}")
    expanded, repeated = (
        case(z=x, prior=Gaussian(*priors))
        for x, *priors in (
            [x[2].expand(TRACKS, *x.shape[1:]) for x in (case.z, *case.prior)],
            [x[2].repeat(TRACKS, *[1] * (x.dim() - 1)) for x in (case.z, *case.prior)],
        )
    )
    expect_same(expanded, repeated, "estimate of expanded tensors")


@check("eager")
def nothing_that_is_handed_in_changes(case: Case) -> None:
    """Tensors stay as they were, and a second call gives the same bits."""
    given: tuple[Any, ...] = (case.z, *case.prior, case.u)
    before = tree.map_tensors(torch.clone, given)
    first, second = case(), case()
    expect_same(given, before, "what was handed in", 0.0)
    expect_same(second, first, "the second estimate", 0.0)


@check("eager")
def single_precision_stays_single(case: Case) -> None:
    """In float32 all is float32, near what float64 gives; ``info`` has the dtypes that it has in float64.

    How near goes by what a change of data in the last digit of float32 does in float64: models may amplify that.
    """
    single = case(z=case.z.float(), u=case.u if case.u is None else case.u.float())
    for name in FIELDS:
        dtype = getattr(single, name).dtype
        expect(dtype == torch.float32, name, torch.float32, dtype)
    expected = [torch.float32 if x.is_floating_point() else x.dtype for x in tree.flatten(case.estimate.info)]
    found = [x.dtype for x in tree.flatten(single.info)]
    expect(found == expected, "dtypes of info", expected, found)
    digit = 1 + torch.finfo(torch.float32).eps
    moved = case(z=digit * case.z, prior=case.prior._replace(mean=digit * case.prior.mean))
    tolerance = max(TOLERANCE[torch.float32], ROUNDINGS * difference(moved.mean, case.estimate.mean))
    expect_same(single.mean.double(), case.estimate.mean, "mean in float32", tolerance)


@check("eager", "compiled")
def a_track_that_fails_leaves_the_others_alone(case: Case) -> None:
    """A track with a NaN prior and one with an infinite measurement are reported as failed; a third is unaffected."""
    mean, z = case.prior.mean.clone(), case.z.clone()
    mean[0].select(-1, 0)[...] = torch.nan
    z[1, 4] = torch.inf
    estimate = case(z=z, prior=Gaussian(mean, case.prior.scale_tril))
    failed = estimate.failed.reshape(TRACKS, -1).any(-1).tolist()
    expect(failed[0] and not failed[2], "failed", "the first track and not the third", failed)
    expect_same(_track(estimate, 2), _track(case.estimate, 2), "estimate of the track beside those that fail")
    expect(estimate.failure is not None, "failure", "when and why", None)
    assert estimate.failure is not None
    steps, causes = (x.reshape(TRACKS, -1)[:2, 0].tolist() for x in estimate.failure[:2])
    expect(
        (steps[0], causes[0]) == (0, Cause.PRIOR), "failure of the first track", "step 0, its prior", (steps, causes)
    )
    if failed[1]:
        right = steps[1] in (3, 4) and causes[1] == Cause.MEASUREMENT
        expect(right, "failure of the second track", "step 4 (or 3), a measurement", (steps, causes))


@check("compiled")
def compiled_gives_what_eager_gives(case: Case) -> None:
    """Kernels give the same results, ``info`` and its dtypes included, in both precisions and with all options."""
    std, slow = torch.where(case.z.isnan(), torch.nan, case.std), case.eager
    assert slow is not None
    expect_same(case.estimate, slow.estimate, "compiled estimate")
    dt = case.dt * torch.linspace(0.8, 1.2, TRACKS * STEPS, dtype=torch.float64).reshape(TRACKS, STEPS)
    z, u = case.z.float(), case.u if case.u is None else case.u.float()
    ways: list[dict[str, Tensor]] = [{"dt": dt, "std": std}]
    if case.thorough:
        ways += [{"dt": dt[0]}, {"dt": dt[:, :1]}, {"std": std}]
        ways += [{"noise": torch.diag_embed(std)}] if _takes(case, noise=torch.diag_embed(std)) else []
        for options in ways:
            expect_same(case(**options), slow(**options), f"compiled estimate with {', '.join(options)}")
    for options in ways:
        expected, found = slow(z=z, u=u, **options), case(z=z, u=u, **options)
        expect_same(_dtypes(found), _dtypes(expected), "dtypes of the compiled estimate")
        expect_same(found.mean, expected.mean, f"compiled mean in float32 with {', '.join(options)}")


@check("eager", "compiled")
def it_maps_over_tracks(case: Case) -> None:
    """``torch.func.vmap`` over tracks gives what the batch gives."""
    if case.u is not None and case.u.dim() > 2:
        case = replace(case, u=case.u[0], _kept={})
    mapped = torch.func.vmap(lambda z, mean, root: case(z=z, prior=Gaussian(mean, root)).mean)
    with torch.no_grad():
        expect_same(mapped(case.z, *case.prior), case.estimate.mean, "mean of vmap", 1e-7)


@check("eager")
def a_state_dict_holds_every_value(case: Case) -> None:
    """A copy with other values gives the original's results after loading its ``state_dict``."""
    other = copy.deepcopy(case.filter)
    with torch.no_grad():
        for value in other.parameters():
            value.add_(0.1)
    missing, unexpected = other.load_state_dict(case.filter.state_dict())
    expect(not (missing or unexpected), "state_dict", "all keys", [*missing, *unexpected])
    expect_same(replace(case, filter=other, _kept={}).estimate, case.estimate, "estimate with a loaded state_dict", 0.0)


@check("eager", "compiled")
def copies_and_pickles_give_the_same(case: Case) -> None:
    """``copy.deepcopy``, and ``pickle`` of the copy, keep everything but kernels."""
    other = copy.deepcopy(case.filter)
    try:
        other = pickle.loads(pickle.dumps(other))
    except (pickle.PicklingError, AttributeError) as error:  # a class of a function or of a session
        raise SkipCheck(f"not pickled: {error}") from None
    expect_same(replace(case, filter=other, _kept={}).estimate, case.estimate, "estimate of a copy", 0.0)


def _dtypes(estimate: Estimate) -> Any:
    return tree.map_tensors(lambda x: x.new_zeros(x.shape), estimate)


def _takes(case: Case, **options: Tensor) -> bool:
    """Whether the filter accepts these options; some raise an error for correlated noise."""
    try:
        case(**options)
    except ValueError:
        return False
    return True


def _track(estimate: Estimate, i: int) -> Any:
    """One track of an estimate."""
    return tree.map_tensors(lambda x: x[i], estimate)


@check("eager")
def where_its_models_hold_it_is_no_worse_than_a_kalman_filter(case: Case) -> None:
    """Position errors at most 2 % above those of ``srckf``, and consistent covariances.

    Skip this check for robust filters that trade some accuracy for robustness.
    """
    f, seconds = case.filter, torch.tensor(case.dt, dtype=torch.float64)
    motions = f.motion[:] if isinstance(f.motion, Bank) else [f.motion]
    if f.scans or len(motions) > 1:
        raise SkipCheck("it is for filters of one target and one motion")
    motion: Motion = motions[0]
    if motion.adaptation(seconds) is not None:
        raise SkipCheck("the process noise of the motion follows the estimate, so that no truth is drawn from it")
    u = None if case.u is None else case.u.flatten(0, -2)[:1].expand(RUNS, -1)
    inputs = None if u is None else u[:1].expand(LENGTH, -1)
    prior = Gaussian(*(x[:1].expand(RUNS, *x.shape[1:]) for x in case.prior))
    generator = torch.Generator().manual_seed(7)
    start = torch.randn(RUNS, motion.size, dtype=torch.float64, generator=generator)
    with torch.no_grad():
        x = prior.mean + apply(prior.scale_tril, start)
        truth, z = drawn(motion, f.sensor, x, seconds, u, LENGTH, generator, process_noise=True)
        plain, found = (g(z, prior, dt=case.dt, u=inputs) for g in (SRCKF(motion, f.sensor), f))
        errors = (error(e.mean, truth, motion.position)[:, FIRST:] for e in (found, plain))
        squares, of_plain = (e.square().mean(-1) for e in errors)  # mean square position error of each track, (RUNS,)
        consistency, plain_consistency = (float(nees(e, truth)[:, FIRST:].mean()) / motion.size for e in (found, plain))
    ratio = float(squares.mean() / of_plain.mean())
    margin = 3 * float((squares - ratio * of_plain).std() / of_plain.mean()) / RUNS**0.5
    limit = (1 + BEHIND) ** 2 + margin
    what = "position error where its models hold"
    expect(ratio <= limit, what, f"at most {limit**0.5:.3f} times that of srckf", f"{ratio**0.5:.3f} times")
    low, high = (function(x, x * plain_consistency) for function, x in zip((min, max), CONSISTENT, strict=True))
    what = "normalised estimation error squared per component where its models hold"
    expect(low <= consistency <= high, what, f"from {low:.2f} to {high:.2f}", f"{consistency:.2f}")

"""Checks of copies and transforms of a filter."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace

import torch

from torchfra.testing.case import Case, SkipCheck, check
from torchfra.testing.expectations import expect, expect_same
from torchfra.types import Gaussian


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

"""Scenarios of the first steps only, for tests of what is done with tracks and not of how well they are followed."""

import contextlib
import dataclasses

import pytest
import torch

from torchfra.scenarios import Scenario
from torchfra.types import Gaussian

STEPS = 20
"""The most that a simulated track has."""


@contextlib.contextmanager
def short():
    """Scenarios that are made within have few steps, but for the one of which single steps are asked for."""
    made = Scenario.__init__

    def make_short(scenario, *arguments, **named):
        made(scenario, *arguments, **named)
        if scenario.name == "alpha-beta":
            return
        block, law = scenario.block, scenario.law
        first = {"steps": min(scenario.steps, STEPS), "block": lambda rng, runs: beginning(block(rng, runs))}
        for name, value in (first | {"law": law and beginning_of_law(law)}).items():
            object.__setattr__(scenario, name, value)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Scenario, "__init__", make_short)
        yield


def beginning(tracks):
    """The first steps of tracks or scans."""
    u = tracks.u if tracks.u is None else tracks.u[..., :STEPS, :]
    return tracks._replace(truth=tracks.truth[..., :STEPS, :], z=tracks.z[:, :STEPS], u=u)


def beginning_of_law(law):
    """The same of what may be said of each step."""
    motion = law.motion[:STEPS] if isinstance(law.motion, list | tuple) else law.motion
    std, information = (
        x[:STEPS] if isinstance(x, torch.Tensor) and x.dim() == steps else x
        for x, steps in ((law.std, 2), (law.information, 1))
    )
    return dataclasses.replace(law, motion=motion, std=std, information=information)


def alone(tracks, steps=8):
    """The first track."""
    return {"z": tracks.z[0, :steps], "prior": Gaussian(tracks.prior.mean[0], tracks.prior.scale_tril),
            "u": tracks.u[:steps]}  # fmt: skip


SMALL_GPB = {
    "noise_levels": (1.0, 37.0), "jump_factors": (5.0,), "self_transition": (0.999, 0.969, 0.999, 0.004),
    "restart": (0.5, 0.3, 0.1, 0.1), "outlier_sizes": (100.0,), "outlier_shares": (1.0,),
}  # fmt: skip
"""Settings of ``gpb`` with few hypotheses of each kind, as the time to compile its kernels goes by their number."""

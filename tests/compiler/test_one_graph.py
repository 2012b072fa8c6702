"""torch.compile sees a whole filter as one graph: whatever its steps are made of."""

import pytest
import torch
from alike import close
from gpb_cases import FEWER
from one_graph import needs_one_graph

from torchfra import presets
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position

pytestmark = [needs_one_graph, pytest.mark.slow]


def sees_one_graph(f, z, prior, u=None):
    torch._dynamo.reset()
    graph = torch.compile(f, backend="eager", fullgraph=True)
    close(graph(z, prior, u=u).mean, f(z, prior, u=u).mean, 1e-9)


@pytest.mark.parametrize(
    ("name", "options"), [("ekf", {}), ("fra", {"plain": 1.0, "provisional": "likeliest", "final": "likeliest"})]
)
def test_a_filter_is_one_graph(name, options, make, tracks):
    """Slopes; points, weights of outliers, fading, branches that are decided between."""
    z = tracks.z[:, :1].clone()
    z[0, 0] += 0.4
    sees_one_graph(make(name, **options), z, tracks.prior, tracks.u[:1])


def test_a_bank_of_hypotheses_is_one_graph(tracks):
    f = presets.gpb([ConstantVelocity(0.1), ConstantVelocity(3.0)], Position(2.0), **FEWER, noise="stated")
    sees_one_graph(f, tracks.truth[:, :1, :2], tracks.prior)

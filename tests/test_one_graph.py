"""torch.compile sees a whole filter as one graph: whatever its steps are made of."""

import pytest
import torch
from one_graph import needs_one_graph
from test_branches import THREE
from test_compile import close
from test_gpb import FEWER, PRIOR, measured
from test_gpb_promises import bank

pytestmark = [needs_one_graph, pytest.mark.slow]


def sees_one_graph(f, z, prior, u=None):
    torch._dynamo.reset()
    graph = torch.compile(f, backend="eager", fullgraph=True)
    close(graph(z, prior, u=u).mean, f(z, prior, u=u).mean, 1e-9)


@pytest.mark.parametrize(("name", "options"), [("ekf", {}), ("mr_ckf", {}), ("iaukf", {}), ("fra", THREE)])
def test_a_filter_is_one_graph(name, options, make, tracks):
    """Slopes, points, weights of outliers, an estimated noise, fading, branches that are decided between."""
    z = tracks.z[:, :2].clone()
    z[0, 0] += 0.4  # of which the second step decides
    sees_one_graph(make(name, **options), z, tracks.prior, tracks.u[:2])


def test_a_bank_of_hypotheses_is_one_graph():
    sees_one_graph(bank("two ranges", **FEWER), measured("ranges", 3)[:, :2, :2], PRIOR)

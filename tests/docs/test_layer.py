"""The patterns of the page about filters as layers do what it says of them."""

import json
import re

import layer
import pytest
import torch
from one_graph import needs_one_graph
from torch import distributed, nn
from torch.nn.parallel import DistributedDataParallel
from two_processes import run_in_two

from torchfra import Gaussian, losses, presets, tree
from torchfra.motion import ConstantVelocity
from torchfra.running.distributed import share, team
from torchfra.sensors import Position


@pytest.fixture(scope="module")
def page():
    """What the page defines, without the lines that use it."""
    return layer.code_of(layer.PAGE.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """All that the page leaves when it has run from its first line to its last."""
    scope: dict[str, object] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("page"))
        for block in re.findall(
            r"^```python\n(.*?)^```$", layer.PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE
        ):
            exec(compile(block, str(layer.PAGE), "exec"), scope)
    return scope


@pytest.fixture
def model(page):
    """A layer whose head has learned nothing in particular."""
    made = page["layer"](presets.srckf(ConstantVelocity(q=0.1), Position(2.0)))
    nn.init.normal_(made.head.last.weight, std=0.1)
    return made


def test_a_head_begins_with_the_data_sheet(page):
    f = presets.srckf(ConstantVelocity(q=0.1), Position(2.0))
    z, features, _, prior = page["simulate"](4, 6, 0)
    torch.testing.assert_close(page["layer"](f)(z, features, prior).mean, f(z, prior).mean)


def test_padded_tracks_are_what_they_are_alone(page, model):
    model.double()  # in float32 a batch may be rounded otherwise than a track alone, by the number of threads
    z, features, _, prior = page["simulate"](3, 8, 0)
    items = [(z[i, : 4 + 2 * i], features[i, : 4 + 2 * i].double()) for i in range(3)]
    padded, with_features, dt, lengths = page["ragged"](items)
    estimate = model(padded, with_features, prior, dt=dt)
    for i, (one, of_one) in enumerate(items):
        alone = model(one, of_one, prior)
        torch.testing.assert_close(estimate.mean[i, -1], alone.mean[-1])
        torch.testing.assert_close(estimate.log_likelihood[i].sum(), alone.log_likelihood.sum())
        assert lengths[i] == len(one)


def test_the_density_of_hidden_measurements_is_that_of_a_joint_gaussian(page, model):
    """Conditional density of every fifth position given all others, from the joint covariance of positions."""
    z, features, _, prior = page["simulate"](1, 7, 0)
    std, bias = (x[0].detach().double() for x in model.head(features))
    motion = model.filter.motion
    one = torch.ones(()).double()
    step, noise = motion.transition(one), motion.process_noise(one)
    cov, crossed, rows = prior.covariance.double(), [], []
    for _ in range(7):
        cov = step @ cov @ step.mT + noise @ noise.mT
        rows = [block @ step.mT for block in rows]
        crossed.append([*rows, cov])
        rows = [*rows, cov]
    joint = torch.zeros(7, 2, 7, 2).double()
    for k, blocks in enumerate(crossed):
        for j, block in enumerate(blocks):
            joint[j, :, k] = block[:2, :2]
            joint[k, :, j] = block[:2, :2].mT
    joint = joint.reshape(14, 14) + std.reshape(-1).square().diag()
    hidden = torch.tensor([0, 1, 10, 11])
    seen = torch.tensor([i for i in range(14) if i not in hidden.tolist()])
    y = (z[0] - bias).reshape(-1)
    gain = torch.linalg.solve(joint[seen][:, seen], joint[seen][:, hidden]).mT
    rest = joint[hidden][:, hidden] - gain @ joint[seen][:, hidden]
    parts = [
        torch.distributions.MultivariateNormal((gain @ y[seen])[at], rest[at, at]).log_prob(y[hidden][at])
        for at in (slice(0, 2), slice(2, 4))
    ]
    found = page["hidden_nll"](model, z, features, prior)
    torch.testing.assert_close(found, -torch.stack(parts).mean().unsqueeze(0), rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_the_step_that_the_page_exports_and_loads_again_runs_for_other_numbers_of_tracks(ran):
    assert not [node for node in ran["program"].graph.nodes if "torchfra" in str(node.target)]
    z, features, _, prior = ran["simulate"](3, 4, 1)
    step = ran["Step"](ran["model"], Gaussian(prior.mean.expand(3, -1), prior.scale_tril))
    state = expected = [x.clone() for x in tree.flatten(step.like)]
    for k in range(4):
        state, expected = (run(now, z[:, k], features[:, k]) for run, now in ((ran["run"], state), (step, expected)))
    torch.testing.assert_close(state, expected)


@needs_one_graph
@pytest.mark.slow
def test_torch_compile_and_half_precision_together_are_the_layer(page, model):
    model.filter.compile()
    z, features, _, prior = page["simulate"](4, 6, 0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        expected = model(z, features, prior).mean
        found = torch.compile(model, fullgraph=True, backend="aot_eager")(z, features, prior).mean
    assert found.dtype == torch.float64
    torch.testing.assert_close(found, expected, rtol=1e-2, atol=1e-2)  # of bfloat16 in the network


def learn(arguments):
    """Two steps of descent of the page's layer on the tracks of this process; the first one prints what it learned."""
    scope = layer.code_of(layer.PAGE.read_text(encoding="utf-8"))
    with team():
        model = scope["layer"](presets.srckf(ConstantVelocity(q=0.1), Position(2.0), learn=("q",)))
        replica = DistributedDataParallel(model) if distributed.is_initialized() else model
        optimiser, mine = torch.optim.SGD(model.parameters(), lr=0.1), share(4)
        z, features, truth, prior = scope["simulate"](4, 6, 0)
        own = slice(mine.start, mine.stop)
        for _ in range(2):
            estimate = replica(z[own], features[own], prior)
            optimiser.zero_grad()
            losses.robust_mse(estimate.mean, truth[own], slice(0, 2), scale=10.0).mean().backward()
            optimiser.step()
        print(*(f"{x.detach().double().square().sum():.9g}" for x in model.parameters()))
        del replica, estimate  # before the group: who frees that last waits for its threads, at times for ever


@pytest.mark.slow
def test_two_processes_learn_the_layer_that_one_learns(capsys, tmp_path):
    learn([])
    alone = [float(x) for x in capsys.readouterr().out.split()]
    run_in_two(learn, [], tmp_path / "out")
    assert [float(x) for x in (tmp_path / "out").read_text().split()] == pytest.approx(alone, rel=1e-5)
    assert len(alone) == 5


@pytest.mark.slow
def test_the_script_prints_and_writes_the_error_of_each_network(tmp_path, capsys):
    out = tmp_path / "layer.json"
    small = ["--steps", "4", "--tracks", "6", "--teachers", "truth", "--quiet", "--json", str(out)]
    assert layer.main(small) == 0
    assert capsys.readouterr().out == ""
    errors = json.loads(out.read_text())["errors"]
    assert [*errors] == ["srckf", "rsrckf", "perceptron, truth", "encoder, truth"]
    assert all(later < now for now, later in errors.values())
    assert errors["perceptron, truth"][0] < errors["srckf"][0]

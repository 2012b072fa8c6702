"""A compiled filter gives what the filter gives: results, gradients, errors."""

import copy
import pickle
import warnings
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from alike import both, close
from conftest import STEPS
from short_tracks import SMALL_GPB
from torch import nn

from torchfra import Hyper, learnable, presets
from torchfra.compiler import jit, run
from torchfra.compiler.entries import Entries, as_entries
from torchfra.compiler.expressions import Expressions
from torchfra.compiler.program import Program, batch_first
from torchfra.compiler.source import Port, Scan
from torchfra.compiler.step import Input, Step
from torchfra.filters import SRCKF
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Bearings, Position, Sensor
from torchfra.types import CompileError, Gaussian

# ---------------------------------------------------------------- results


def test_a_single_track_and_a_grid_of_tracks_and_a_batch_of_hyperparameters(make, tracks, scenario):
    f = make("rsrckf", threshold=torch.tensor([0.5, 1.345, 3.0], dtype=torch.float64).unsqueeze(-1))
    close(*both(f, tracks.z, tracks.prior, u=tracks.u))  # 3 thresholds, 4 tracks
    f = make("rsrckf")
    fast = copy.deepcopy(f).compile()
    mean, root = tracks.prior
    close(f(tracks.z[0], Gaussian(mean[0], root), u=tracks.u), fast(tracks.z[0], Gaussian(mean[0], root), u=tracks.u))
    z, prior = tracks.z.unflatten(0, (2, 2)), Gaussian(mean.unflatten(0, (2, 2)), root)
    close(f(z, prior, u=tracks.u), fast(z, prior, u=tracks.u))
    close(f(z.mT.contiguous().mT, prior, u=tracks.u), fast(z.mT.contiguous().mT, prior, u=tracks.u))
    many = scenario.simulate(37, 5)  # no multiple of any register
    close(f(many.z, many.prior, u=many.u), fast(many.z, many.prior, u=many.u))


@pytest.mark.slow
def test_what_a_filter_begins_with_may_differ_between_tracks(make, tracks, scenario):
    poor = torch.linspace(0.1, 0.4, len(tracks.z), dtype=torch.float64)
    chances = torch.stack([poor, 1 - 2 * poor, poor], -1)
    bank = presets.imm_srckf(scenario.bank, scenario.sensor, initial=chances)
    for f in (make("gpb", prior_outlier=poor, prior_inflation=1 / poor, **SMALL_GPB), bank):
        close(*both(f, tracks.z, tracks.prior, u=tracks.u))


class Curved(Sensor):
    """A sensor of one's own, with a parameter in it."""

    def __init__(self):
        super().__init__(2, [False, True], 1.0, None)
        self.bend = nn.Parameter(torch.tensor([0.3, 0.1], dtype=torch.float64))

    def forward(self, x, u=None):
        a, b = x[..., 0], x[..., 1]
        return torch.stack([torch.exp(self.bend[0] * a) + b.tanh(), torch.sin(self.bend[1] * b).abs() + a**2], -1)


def test_sensors_of_ones_own_and_their_parameters():
    f = SRCKF(ConstantVelocity(0.1), Curved())
    prior = Gaussian(torch.tensor([0.5, 1.0, 0.0, 0.0], dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    z = torch.rand(5, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    fast = copy.deepcopy(f).compile()
    slow, quick = f(z, prior), fast(z, prior)
    close(slow, quick)
    for e in (slow, quick):
        e.mean.sum().backward()
    close(f.sensor.bend.grad, fast.sensor.bend.grad)


# ---------------------------------------------------------------- gradients


def test_every_track_has_the_gradient_it_has_alone(make, tracks):
    """What training rests on: hyperparameters of its own for each track."""
    f = make("srckf", learn="all").compile()
    own = {k: p.detach().expand(4).clone().requires_grad_() for k, p in f.named_parameters()}
    estimate = torch.func.functional_call(f, own, (tracks.z, tracks.prior), {"u": tracks.u})
    together = torch.autograd.grad(estimate.mean.square().sum(), list(own.values()))
    for i in range(4):
        alone = f(tracks.z[i], Gaussian(tracks.prior.mean[i], tracks.prior.scale_tril), u=tracks.u)
        grads = torch.autograd.grad(alone.mean.square().sum(), list(f.parameters()))
        for whole, single in zip(together, grads, strict=True):
            torch.testing.assert_close(whole[i], single, rtol=1e-9, atol=0)


@pytest.mark.slow
def test_what_is_too_much_to_remember_is_computed_anew_for_the_gradient(make, tracks, monkeypatch):
    f, data = make("fra", learn="all").compile(), {"z": tracks.z, "prior": tracks.prior, "u": tracks.u}
    slopes = []
    for most in (1 << 26, 0):
        monkeypatch.setattr(run, "_REMEMBERED", most)
        slopes.append(torch.autograd.grad(f(**data).mean.square().sum(), list(f.parameters())))
    close(*slopes)


# ---------------------------------------------------------------- what is made anew, and what is not


@pytest.mark.slow
def test_kernels_are_made_once_for_a_form_of_call(make, tracks, monkeypatch):
    made = []
    load = jit.load
    monkeypatch.setattr(jit, "load", lambda source: made.append(source) or load(source))
    f = make("fra", temperature=1.0).compile()
    with torch.no_grad():
        f(tracks.z, tracks.prior, u=tracks.u)
        assert len(made) == 1
        f.gate.set(7.0)
        f.motion.q.set(0.5)
        f.temperature = 0.3  # another number, not another form
        f(tracks.z * 1.01, tracks.prior, u=tracks.u)
        f(tracks.z[:2, :5], Gaussian(tracks.prior.mean[:2], tracks.prior.scale_tril), u=tracks.u[:5], dt=0.7)
        assert len(made) == 1
        f.temperature = 0.0
        hard = f(tracks.z, tracks.prior, u=tracks.u)
        assert len(made) == 2
        f.temperature = 0.3
        f(tracks.z, tracks.prior, u=tracks.u)
        assert len(made) == 2  # both are remembered
    slow = make("fra")
    slow.load_state_dict(f.state_dict())
    close(slow(tracks.z, tracks.prior, u=tracks.u), hard)


@pytest.mark.slow
def test_what_changes_in_the_filter_changes_its_kernels(make, tracks):
    f = make("rmckf").compile()
    before = f(tracks.z, tracks.prior, u=tracks.u).mean
    f.fading.rcond = 0.9
    slow = make("rmckf", rcond=0.9)
    after = f(tracks.z, tracks.prior, u=tracks.u).mean
    assert not torch.equal(before, after)
    close(slow(tracks.z, tracks.prior, u=tracks.u).mean, after)
    f = presets.srckf(f.motion, Bearings(0.02, stations=torch.tensor([[0.0, 0.0], [2000.0, 0.0]]).double())).compile()
    f(tracks.z, tracks.prior)
    f.sensor.stations += 100.0
    close(presets.srckf(f.motion, f.sensor)(tracks.z, tracks.prior).mean, f(tracks.z, tracks.prior).mean)


def test_the_disk_keeps_kernels_and_a_copy_of_a_filter_compiles_by_itself(make, tracks):
    f = make("srckf").compile()
    expected = f(tracks.z, tracks.prior, u=tracks.u).mean
    count = jit.compiled
    for other in (copy.deepcopy(f), pickle.loads(pickle.dumps(f))):
        assert torch.equal(other(tracks.z, tracks.prior, u=tracks.u).mean, expected)
    assert jit.compiled == count
    assert f.state_dict().keys() == make("srckf").state_dict().keys()


# ---------------------------------------------------------------- errors


FUNCTIONS = {
    "exp": torch.exp, "expm1": torch.expm1, "log": lambda x: x.square().log(), "log1p": lambda x: x.square().log1p(),
    "erf": torch.erf, "sin": torch.sin, "cos": torch.cos, "tan": torch.tan, "asin": lambda x: torch.asin(x.tanh()),
    "acos": lambda x: torch.acos(x.tanh()), "atan": torch.atan, "sinh": torch.sinh, "cosh": torch.cosh,
    "tanh": torch.tanh, "sigmoid": torch.sigmoid, "softplus": torch.nn.functional.softplus, "relu": torch.relu,
    "sinc": torch.sinc, "sqrt": lambda x: x.abs().sqrt(), "rsqrt": lambda x: x.abs().rsqrt(), "abs": torch.abs,
    "sign": torch.sign, "round": torch.round, "floor": torch.floor, "ceil": torch.ceil, "trunc": torch.trunc,
    "remainder": lambda x: torch.remainder(x, 1.3), "atan2": lambda x: torch.atan2(x, x - 1),
    "hypot": lambda x: torch.hypot(x, x + 1), "powers": lambda x: x**3 + x**-2 + x.abs() ** 1.5 + x.abs() ** 0.3,
    "norm": torch.linalg.norm, "mean": lambda x: x.mean() + x.prod(), "extremes": lambda x: x.max() - x.amin(0),
    "largest": lambda x: torch.stack([y.to(x) for y in x.max(0)]),
    "softmax": lambda x: torch.softmax(x, 0), "log_softmax": lambda x: torch.log_softmax(x, 0),
    "logsumexp": lambda x: torch.logsumexp(x, 0),
    "clamp": lambda x: x.clamp(-1, 1), "nan": lambda x: torch.where(x.log().isnan(), x, 0.0).nan_to_num(),
    "moves": lambda x: torch.cat([x.flip(0), x.roll(1)]).reshape(2, 3).mT.tril()[[0, 2]],
    "logic": lambda x: ((x > 0) & ~(x < 1) | (x == x[0])).to(x), "outer": lambda x: torch.einsum("i,j->ij", x, x) @ x,
    "cross": lambda x: torch.linalg.cross(x, x + 1), "whole": lambda x: (3 * x).to(torch.int64).to(x) / 3,
    "count": lambda x: ((x > 0).sum() + (x > 1).to(x).amax()).to(x), "mixed": lambda x: torch.where(x > 1, x > 2, x),
    "picked": lambda x: x[torch.tensor([True, False, True])] * x[torch.tensor([2, 0], dtype=torch.int32)],
    "any": lambda x: (x > 0).any().to(x) + (x > -1).all(), "in place": lambda x: (x + 1).mul_(x).sub_(3.0),
    "row": lambda x: x @ torch.stack([x, x + 1, x - 1]), "shaped in place": lambda x: (x + 1).unsqueeze_(0).t_() * x,
}  # fmt: skip


def test_what_torch_does_to_numbers_kernels_do_as_well():
    """All at once, in one kernel: 500 triples through each function."""
    book = Expressions()
    x = Entries.inputs(book, (3,), torch.float64)
    written = [as_entries(book, function(x)) for function in FUNCTIONS.values()]
    ports = [Port(y.ids.flatten().tolist(), y.shape, timed=True) for y in written]
    program = Program(Scan(book, [], [], [Port(x.ids.tolist(), x.shape)], ports))
    values = 3 * torch.randn(500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    for (name, function), found in zip(FUNCTIONS.items(), program(torch.Size([500]), 1, [values]), strict=True):
        expected = torch.stack([function(v) for v in values])
        torch.testing.assert_close(
            batch_first(found, 1)[:, 0], expected, rtol=1e-12, atol=1e-12, msg=lambda m, n=name: f"{n}: {m}"
        )


class Writing(Position):
    """Writes its measurement in place, part by part."""

    def __init__(self):
        super().__init__(2.0)
        self.gain = Hyper(2.0, learn=True)

    def forward(self, x, u=None):
        z = torch.zeros_like(x[..., :2])
        z[..., 0] = self.gain(x) * x[..., 0]
        z[..., 1] = x[..., 1]
        z[..., 1] *= self.gain(x)
        return z


def test_writes_in_place_reach_what_is_viewed_and_have_gradients():
    f = SRCKF(ConstantVelocity(0.1), Writing())
    fast = copy.deepcopy(f).compile()
    prior = Gaussian(torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    z = torch.rand(5, 3, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    slow, quick = f(z, prior), fast(z, prior)
    close(slow, quick)
    for e in (slow, quick):
        e.mean.square().sum().backward()
    close(f.sensor.gain.raw.grad, fast.sensor.gain.raw.grad)


class Factorial(Position):
    """Its gradient needs an operation that kernels do not have."""

    def forward(self, x, u=None):
        return torch.lgamma(super().forward(x) + 2)


def test_a_gradient_that_kernels_cannot_do_is_named_with_the_filter_the_values_and_the_line():
    f = learnable(SRCKF(ConstantVelocity(0.1), Factorial(1.0)), "all").compile()
    prior = Gaussian(torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    mean = f(torch.ones(3, 2, dtype=torch.float64), prior).mean
    named, line = "SRCKF, gradient of the state, motion.q.raw, sensor.std.raw: ", r"test_compile.py, line \d+: .*lgamma"
    with pytest.raises(NotImplementedError, match=f"{named}.*digamma.*{line}"):
        mean.sum().backward()


def test_without_a_compiler_it_runs_interpreted_and_says_once_what_to_install(make, tracks, no_compiler):
    f = make("srckf")
    with pytest.warns(RuntimeWarning, match=r"llvmlite.* is not installed.*pip install 'torchfra\[compiler\]'"):
        compiled = copy.copy(f).compile()
    assert torch.equal(compiled(tracks.z, tracks.prior, u=tracks.u).mean, f(tracks.z, tracks.prior, u=tracks.u).mean)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        copy.copy(f).compile()


def test_a_kernel_that_llvm_does_not_take_is_quoted_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHFRA_CACHE", str(tmp_path))
    with pytest.raises(CompileError, match=r"(?s)no kernel from LLVM.*expected top-level entity"):
        jit.load("no module")
    assert not [*tmp_path.iterdir()]


class Looking(Position):
    """Decides in Python by what it sees."""

    def forward(self, x, u=None):
        return super().forward(x) if x.sum() > 0 else super().forward(-x)


class Exotic(Position):
    """Uses an operation that kernels do not have."""

    def forward(self, x, u=None):
        return torch.special.bessel_j0(super().forward(x))


class Indexing(Position):
    """Takes the row that the data say."""

    def forward(self, x, u=None):
        return torch.eye(2).to(x)[(x[..., 0] > 0).to(torch.int64)] * super().forward(x)


@pytest.mark.parametrize(
    ("sensor", "message"),
    [
        (Looking(1.0), "torch.where, not by if"),
        (
            Exotic(1.0),
            "^SRCKF: .*bessel_j0.* cannot become part of a kernel.*leave compile.*test_compile.py, line ",
        ),
        (Indexing(1.0), "index.*the index depends on data"),
    ],
)
def test_what_kernels_cannot_do_is_named_with_a_way_out(sensor, message):
    f = SRCKF(ConstantVelocity(0.1), sensor).compile()
    prior = Gaussian(torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    with pytest.raises(NotImplementedError, match=message):
        f(torch.ones(3, 2, dtype=torch.float64), prior)


@pytest.mark.slow
def test_a_minus_sign_that_torch_has_put_off_is_there(make, tracks):
    """The imaginary part of a conjugate is negative by a bit alone: its memory is that of the number itself."""
    f = make("srckf", learn=("q",))
    fast = copy.deepcopy(f).compile()

    def put_off(x):
        lazy = torch.complex(torch.zeros_like(x), -x).conj().imag
        assert lazy.is_neg()
        return lazy

    prior = Gaussian(put_off(tracks.prior.mean), put_off(tracks.prior.scale_tril))
    expected = f(tracks.z, tracks.prior, u=tracks.u)
    found = fast(put_off(tracks.z), prior, u=put_off(tracks.u), dt=put_off(torch.ones(STEPS, dtype=torch.float64)))
    close(expected, found)
    state, step = f.init(tracks.prior), fast.init(prior)
    close(
        f.step(state, tracks.z[:, 0], u=tracks.u[0]), fast.step(step, put_off(tracks.z[:, 0]), u=put_off(tracks.u[0]))
    )
    slopes = [torch.autograd.grad(e.mean, g.motion.q.raw, put_off(torch.ones_like(e.mean))) for e, g in
              ((expected, f), (found, fast))]  # fmt: skip
    close(*slopes, 1e-9)


def test_zeros_that_torch_has_not_written_are_zeros(make, tracks):
    """Differentiation makes such tensors; they have no memory at all."""
    z = torch._efficientzerotensor(tracks.z.shape, dtype=torch.float64)
    close(*both(make("srckf"), z, tracks.prior, u=tracks.u))


@pytest.mark.parametrize(("dtype", "std", "scale"), [(torch.float64, 1e-160, 1.0), (torch.float64, 1e-160, 1e-160),
                                                     (torch.float64, 1e160, 1e160), (torch.float32, 3e19, 3e19),
                                                     (torch.float32, 1e30, 1e30)])  # fmt: skip
def test_scales_whose_squares_leave_the_range_of_the_dtype_are_as_good_as_others(dtype, std, scale):
    f = SRCKF(ConstantVelocity(1.0), Position(std))
    prior = Gaussian(torch.zeros(4, dtype=dtype), scale * torch.eye(4, dtype=dtype))
    z = (scale * torch.tensor([[1.0, 2.0], [2.0, 2.5], [3.0, 3.3]], dtype=dtype)).requires_grad_()
    slow, fast = both(f, z, prior)
    assert not slow.failed
    assert not fast.failed
    tolerance = 100 * torch.finfo(dtype).eps
    close(slow.mean, fast.mean, tolerance)
    close(slow.log_likelihood, fast.log_likelihood, tolerance)
    close(*(torch.autograd.grad(e.mean.sum(), z)[0] for e in (slow, fast)), tolerance)


# ---------------------------------------------------------------- what has gone wrong once


@pytest.mark.slow
def test_a_change_between_forward_and_backward_leaves_the_gradient(make, tracks):
    f = make("srckf", learn=("q",))
    fast = copy.deepcopy(f).compile()
    one, two = (g(tracks.z, tracks.prior, u=tracks.u).mean.square().sum() for g in (f, fast))
    fast.sensor.angles.logical_not_()  # a buffer that kernels take for granted
    (expected,), (found,) = (torch.autograd.grad(y, g.motion.q.raw) for y, g in ((one, f), (two, fast)))
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=0)
    f = make("fra", temperature=1.0, learn=("gate",)).compile()
    loss = f(tracks.z, tracks.prior, u=tracks.u).mean.sum()
    f.temperature = 0.0
    loss.backward()
    assert f.gate.raw.grad.isfinite()


class Decay(nn.Module):
    """A step with a parameter."""

    def __init__(self):
        super().__init__()
        self.rate = nn.Parameter(torch.tensor(0.9, dtype=torch.float64))


def test_traces_in_several_threads_are_equal_and_leave_the_module_alone():
    def advance(module, state, data):
        x = module.rate * state[0] + data["z"]
        return (x,), (x.square(),)

    module = Decay()
    inputs = {"z": Input(torch.Size([2]), True, False), "rate": Input(torch.Size([]), False, True)}
    step = Step(module, lambda *_: (torch.ones(2, dtype=torch.float64),), advance, inputs, torch.float64)
    with ThreadPoolExecutor(4) as pool:
        sources = set(pool.map(lambda _: step.backwards((True,), ("z", "rate")).source(), range(16)))
    assert len(sources) == 1
    assert isinstance(module.rate, nn.Parameter)


def test_several_threads_may_make_the_same_kernel(make, tracks):
    f = make("srckf").compile()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: f(tracks.z, tracks.prior, u=tracks.u).mean, range(4)))
    for x in found[1:]:
        assert torch.equal(x, found[0])


class Scaled(Position):
    """A sensor whose behaviour changes in several ways."""

    def forward(self, x, u=None):
        bias = getattr(self, "bias", 0.0)
        return (2.0 if self.training else 1.0) * super().forward(x) + bias


def test_modes_and_parameters_that_come_later_are_noticed():
    f = SRCKF(ConstantVelocity(0.1), Scaled(1.0))
    fast = copy.deepcopy(f).compile()
    prior = Gaussian(torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    z = torch.ones(3, 2, dtype=torch.float64)
    for change in (lambda g: g, lambda g: g.eval(), lambda g: setattr(g.sensor, "bias", nn.Parameter(torch.ones(2)))):
        change(f)
        change(fast)
        close(f(z, prior), fast(z, prior))


def test_an_attribute_that_is_gone_is_noticed():
    f = SRCKF(ConstantVelocity(0.1), Scaled(1.0))
    f.sensor.bias = 3.0
    fast = copy.deepcopy(f).compile()
    prior = Gaussian(torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    z = torch.ones(3, 2, dtype=torch.float64)
    biased = fast(z, prior).mean
    for g in (f, fast):
        del g.sensor.bias
    assert not torch.equal(fast(z, prior).mean, biased)
    close(f(z, prior), fast(z, prior))


def test_a_value_that_learns_from_now_on_needs_no_new_kernel_and_has_its_gradient(monkeypatch):
    f = SRCKF(ConstantVelocity(0.1), Position(1.0))
    fast = copy.deepcopy(f).compile()
    prior = Gaussian(torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    z = torch.zeros(3, 2, dtype=torch.float64)
    before = fast(z, prior)
    for g in (f, fast):
        g.motion.q.learn()
    with torch.no_grad(), monkeypatch.context() as patch:
        patch.setattr(jit, "load", None)
        assert torch.equal(fast(z, prior).mean, before.mean)
    for g in (f, fast):
        g(z, prior).mean.sum().backward()
    close(f.motion.q.raw.grad, fast.motion.q.raw.grad)


def test_a_noise_that_learns_has_its_gradient():
    root = torch.tensor([[1.0, 0.0], [0.5, 2.0]], dtype=torch.float64, requires_grad=True)
    f = SRCKF(ConstantVelocity(0.1), Position(noise=torch.eye(2, dtype=torch.float64)))
    f.sensor.root = root
    prior = Gaussian(torch.ones(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    z = torch.zeros(3, 2, dtype=torch.float64)
    (slow,) = torch.autograd.grad(f(z, prior).mean.sum(), root)
    (fast,) = torch.autograd.grad(f.compile()(z, prior).mean.sum(), root)
    close(slow, fast)


def test_transforms_over_prior_and_values_see_the_filter_as_it_is(make, tracks):
    f, slow = make("srckf").compile(), make("srckf")

    def end(g, mean):
        return g(tracks.z[0], Gaussian(mean, tracks.prior.scale_tril), u=tracks.u).mean[-1].sum()

    means = tracks.prior.mean
    close(torch.func.vmap(lambda m: end(f, m))(means), torch.stack([end(slow, m) for m in means]))
    close(torch.func.grad(lambda m: end(f, m))(means[0]), torch.func.grad(lambda m: end(slow, m))(means[0]))


def test_a_state_of_ones_own_may_be_shared_by_the_batch(make, tracks):
    f = make("srckf")
    state = f.init(tracks.prior)
    state = state._replace(belief=Gaussian(state.belief.mean, 3 * torch.eye(4, dtype=torch.float64)))
    slow = f.step(state, tracks.z[:, 0], u=tracks.u[0])
    close(slow, f.compile().step(state, tracks.z[:, 0], u=tracks.u[0]))


def test_estimates_may_be_changed_in_place(make, tracks):
    f = make("srckf", learn=("q",)).compile()
    mean = f(tracks.z, tracks.prior, u=tracks.u).mean
    mean[..., 0] += 1.0
    mean.sum().backward()
    assert f.motion.q.raw.grad.isfinite()


def test_truncation_and_checkpoints_go_together(make, tracks):
    grads = []
    for f in (make("srckf", learn=("q",)), make("srckf", learn=("q",)).compile()):
        mean = f(tracks.z, tracks.prior, u=tracks.u, truncate=5, checkpoint=2).mean
        grads.append(torch.autograd.grad(mean.square().sum(), f.motion.q.raw)[0])
    close(*grads, 1e-9)


def test_with_arguments_it_is_the_compile_of_torch(make, monkeypatch):
    calls = []
    monkeypatch.setattr(torch.nn.Module, "compile", lambda self, *args, **options: calls.append((self, args, options)))
    f = make("srckf")
    assert f.compile(backend="inductor", dynamic=True) is f
    assert calls == [(f, (), {"backend": "inductor", "dynamic": True})]
    assert f.compile() is f
    assert len(calls) == 1


def test_values_given_in_single_precision_mean_the_same_compiled():
    z = torch.randn(5, 20, 2, dtype=torch.float64)
    prior = Gaussian(torch.zeros(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    q, std, threshold = torch.tensor([0.37, 1.3, 1.2])
    f = presets.rsrckf(ConstantVelocity(q), Position(std), threshold=threshold)
    close(f(z, prior), copy.deepcopy(f).compile()(z, prior), 1e-12)

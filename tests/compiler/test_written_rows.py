"""What kernels write for many tracks is the same as for few, and lies on lines of the cache."""

import pytest
import torch
from short_tracks import SMALL_GPB

from torchfra import presets, scenarios
from torchfra.compiler.pages import LEAST, rows_of_tracks


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_many_tracks_and_some_of_them_have_the_same_estimates_to_the_bit(dtype):
    scenario = scenarios.bearings_outliers()
    data = scenario.simulate(1003, 0)
    z, u, prior = data.z.to(dtype), data.u.to(dtype), type(data.prior)(*(x.to(dtype) for x in data.prior))
    f = presets.fra(scenario.motion, scenario.sensor).compile()
    with torch.no_grad():
        every = f(z, prior, u=u)
        some = f(z[900:], prior._replace(mean=prior.mean[900:]), u=u)
    assert every.scale_tril.numel() * every.scale_tril.itemsize > LEAST
    assert torch.equal(every.mean[900:], some.mean)
    assert torch.equal(every.scale_tril[900:], some.scale_tril)
    assert torch.equal(every.log_likelihood[900:], some.log_likelihood)


@pytest.mark.slow
def test_what_has_one_entry_a_step_lies_on_rows_of_its_own_too():
    x = rows_of_tracks((100, 1), torch.Size([100]), torch.float64, torch.device("cpu"), past=True)
    assert x.stride() == (104, 104, 1)
    scenario = scenarios.bearings_outliers()
    data = scenario.simulate(100, 0)
    f = presets.gpb(scenario.motion, scenario.sensor, **SMALL_GPB)
    with torch.no_grad():
        interpreted, compiled = (g(data.z, data.prior, u=data.u) for g in (f, f.compile()))
    assert interpreted.info.outlier.shape == (100, 100, 1)
    torch.testing.assert_close(compiled.info.outlier, interpreted.info.outlier)

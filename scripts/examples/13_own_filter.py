"""A filter of your own: ``begin``, ``advance`` and ``retreat``, from which all that filters do here comes."""

from typing import NamedTuple

import torch
from torch.distributions import constraints

from torchfra import Gaussian, Hyper, fit, metrics
from torchfra.filters import SRCKF, Filter, FixedLag, Record
from torchfra.gaussian.update import correct
from torchfra.motion import ConstantVelocity
from torchfra.sensors import Position, RangeBearing
from torchfra.stream import Tracker


class State(NamedTuple):
    """What goes from step to step: a belief, and recent innovations squared, in multiples of what they should be."""

    belief: Gaussian
    level: torch.Tensor  # (...)


class Widening(Filter[State]):
    """Has more process noise while innovations are larger than they should be: by the level, from 1 to 1000."""

    def __init__(self, motion, sensor, memory=0.5):
        super().__init__(motion, sensor)
        self.memory = Hyper(memory, constraints.unit_interval, name="memory")

    def begin(self, belief):
        """The state of a belief."""
        return State(belief, torch.ones_like(belief.mean[..., 0]))

    def advance(self, state, frame):
        """One step forwards: square-root form, any batch, choices by ``torch.where``."""
        predicted, _ = self.widened(state.belief, frame, state.level).belief()
        whitened = self.compare(predicted, frame)  # the measurement against it, in units of its noise
        belief, root, normalised = correct(predicted, whitened)
        count = frame.measured.sum(-1)  # elements that are not missing
        now = torch.lerp(normalised.square().sum(-1) / count.clamp_min(1), state.level, self.memory(belief.mean))
        record = Record(belief, whitened.residual, root, normalised, info=state.level)
        return State(belief, torch.where(count > 0, now, state.level)), record

    def retreat(self, step, after):
        """One step back: Rauch-Tung-Striebel through the prediction as it was made."""
        predicted = self.widened(step.past.belief, step.frame, step.next.info)
        return (smoothed := self.smooth_belief(step.past.belief, predicted, after)).belief, smoothed

    def widened(self, belief, frame, level):
        """A belief propagated over a step."""
        predicted = self.propagate(belief, frame)
        return predicted._replace(process_noise=level.clamp(1, 1000).sqrt()[..., None, None] * predicted.process_noise)


def main(arguments=None):
    """What comes from the three, on 100 targets that turn."""
    motion, gps, radar = ConstantVelocity(0.1), Position(10.0), RangeBearing((10.0, 0.01))
    turn = 0.2 * ((torch.arange(60) - 37).abs() < 7).double().cumsum(0)
    truth = 1000 + 10 * torch.stack([turn.cos(), turn.sin()], -1).cumsum(0)
    z = truth + 10 * torch.randn(100, 60, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    prior = Gaussian(torch.tensor([1000.0, 1000, 10, 0], dtype=torch.float64), 5 * torch.eye(4).double())
    f, which = Widening(motion, gps), [0, 1] * 30
    both = torch.where(torch.tensor(which).bool()[:, None], radar(truth) + (z - truth) * radar.std() / 10, z)
    tracker, fixed = Tracker(f, prior), FixedLag(f, 5)
    state, late = f.init(prior), fixed.init(prior)
    for k in range(60):
        tracker.update(k + 1.0, z[0, k])
        (state, _), (late, _) = f.step(state, z[0, k]), fixed.step(late, z[0, k])
    means = {"srckf": SRCKF(motion, gps)(z, prior).mean, "own": f(z, prior).mean, "smoothed": f.smooth(z, prior).mean}
    means |= {"learned": fit(f, {"z": z, "prior": prior}, learn=["memory"], quiet=True).filter(z, prior).mean}
    means |= {"lag of 5": f.smooth(z, prior, lag=5).mean, "vmap": torch.func.vmap(lambda one: f(one, prior).mean)(z)}
    means |= {"fused": f(both, prior, sensors=[gps, radar], which=which).mean, "compiled": f.compile()(z, prior).mean}
    for name, mean in means.items():
        print(f"{name:<9} position RMSE {metrics.rmse(mean.detach(), truth, motion.position).mean():5.2f} m")
    pairs = (late.lagged, means["lag of 5"][0, 54]), *((x.belief, means["own"][0, 59]) for x in (tracker, state))
    print(f"steps differ by {max((x.mean - mean).abs().max() for x, mean in pairs):.0e}")


if __name__ == "__main__":
    main()

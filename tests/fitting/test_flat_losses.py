"""Values that a step has driven to where the loss is flat stay there for ever: who learns is told."""

import torch
from torch import nn

from torchfra.fitting.descent import Descent, follow


class Saturating:
    """Two starts of one value each, with the loss ``sigmoid(raw)``; a step of 1000 takes the first out of reach."""

    def __init__(self, starts):
        self.values = nn.ParameterDict({"raw": torch.tensor(starts, dtype=torch.float64).unsqueeze(-1)})
        self.optimiser = torch.optim.SGD(self.values.parameters(), lr=0.01)

    def step(self, iteration):
        raw = self.values["raw"].detach().requires_grad_()
        loss = torch.sigmoid(raw).sum()
        follow(self.optimiser, torch.autograd.grad(loss, raw)[0], 0.01)
        return {"loss": loss.item()}

    def validation(self):
        return torch.sigmoid(self.values["raw"].detach()).squeeze(-1)

    def natural(self, start):
        return {}


def descended(starts):
    learner = Saturating(starts)
    settings = {"iterations": 12, "validate_every": 3, "patience": 5}
    descent = Descent(learner, learner.values, learner.validation(), settings)
    for _ in descent.run(descent.remaining):
        pass
    return descent


def test_starts_whose_gradients_are_all_zero_are_counted():
    (note,) = descended([1000.0, 0.0]).notes
    assert note.startswith("1 of 2 starts rest where all gradients are exactly 0")


def test_starts_that_descend_bring_no_note():
    assert descended([1.0, 0.0]).notes == []

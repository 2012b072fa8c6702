"""The search over values of hyperparameters that no gradient reaches."""

from __future__ import annotations

import copy
from collections.abc import Callable

from torchfra.hyper import named
from train.training import Training


def search(training: Training, validate: Callable[[Training], float]) -> None:
    """Coordinate search: each hyperparameter in turn takes the value of the best validation.

    Args:
        training: its ``best`` is where the search begins, and what it improves.
        validate: the score of the present values.
    """
    f = training.filter
    f.load_state_dict(training.best["filter"])
    for name, values in training.config.search.items():
        for hyper in named(f, (name,)).values():
            for value in values:
                hyper.set(value, name)
                score = validate(training)
                if score < training.best["score"]:
                    training.best |= {"score": score, "filter": copy.deepcopy(f.state_dict())}
            f.load_state_dict(training.best["filter"])

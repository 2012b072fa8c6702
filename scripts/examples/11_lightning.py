"""Lightning around a filter: a module whose step is a likelihood, so that its trainer does the rest.

You learn that a filter is a module like any other: its hyperparameters are parameters, so loggers, callbacks and
schedulers work.  Needs Lightning: ``pip install lightning``.
"""

import argparse

import lightning
import torch
from torch.utils.data import DataLoader, TensorDataset

from torchfra import losses, presets, scenarios

SCENARIO = scenarios.bearings_outliers("std", initial="truth")  # outliers of ten standard deviations


class Learner(lightning.LightningModule):
    """Learns the threshold and the process noise of a robust filter from measurements alone."""

    def __init__(self) -> None:
        super().__init__()
        self.filter = presets.rsrckf(SCENARIO.motion, SCENARIO.sensor, threshold=4.0, learn=("threshold", "q"))

    def loss(self, batch: list[torch.Tensor]) -> torch.Tensor:
        """Mean over a batch of ``z (B, T, m)`` and ``u (B, T, k)``."""
        z, u = batch
        return losses.innovation_nll(self.filter(z, SCENARIO.prior, u=u)).mean()

    def training_step(self, batch: list[torch.Tensor], number: int) -> torch.Tensor:
        """The loss that Lightning descends from."""
        return self.loss(batch)

    def validation_step(self, batch: list[torch.Tensor], number: int) -> None:
        """Logs the loss on tracks that are not learned from."""
        self.log("validation", self.loss(batch))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam, on the unconstrained values."""
        return torch.optim.Adam(self.parameters(), lr=0.1)


def loader(runs: int, seed: int) -> DataLoader:
    """Tracks of a seed, 16 at a time."""
    tracks = SCENARIO.simulate(runs, seed)
    return DataLoader(TensorDataset(tracks.z, tracks.u.expand(runs, -1, -1)), batch_size=16)


def main(arguments: list[str] | None = None) -> None:
    """Trains, and prints what was learned."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=10, help="passes over the tracks (default: 10)")
    parser.add_argument("--tracks", type=int, default=64, help="tracks to learn from (default: 64)")
    options = parser.parse_args(arguments)
    quiet = {
        "logger": False,
        "enable_checkpointing": False,
        "enable_progress_bar": False,
        "enable_model_summary": False,
    }
    trainer = lightning.Trainer(max_epochs=options.epochs, accelerator="cpu", gradient_clip_val=10.0, **quiet)
    learner, unseen = Learner(), loader(32, seed=1)
    (before,) = trainer.validate(learner, unseen, verbose=False)
    trainer.fit(learner, loader(options.tracks, seed=0))
    (after,) = trainer.validate(learner, unseen, verbose=False)
    values = f"threshold {learner.filter.robust.threshold():.3f}, q {learner.filter.motion.q():.4f}"
    print(f"minus log likelihood on unseen tracks {before['validation']:.4f}, then {after['validation']:.4f}; {values}")


if __name__ == "__main__":
    main()

"""How networks are trained on simulations, by sbi."""

import copy
import io
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import asdict
from typing import Any

from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor
from torch.utils.data import DataLoader, SubsetRandomSampler, TensorDataset

from sbi_rope.data.pairs import split_pairs
from sbi_rope.npe.sbi import ConditionalDensityEstimator
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.settings import check

# Returns an untrained estimator for pairs (theta, x) like those it is shown.
EstimatorBuilder = Callable[[Tensor, Tensor], Any]


def estimator_builder(density_estimator: Any) -> EstimatorBuilder:
    """Return a builder of untrained estimators, with copies of the given network."""
    check("density_estimator", density_estimator, str | Callable)
    build = density_estimator
    if isinstance(build, str):
        build = posterior_nn(build)
    return lambda theta, x: copy.deepcopy(build(theta, x))


class SimulationTrainer(NPE):
    """sbi's NPE, which holds simulations of the same parameters out together.

    A network can learn a few stored people that are recorded many times by heart; only
    people it has not met say when to stop. Fewer than five are split as by sbi.
    """

    def get_dataloaders(
        self,
        starting_round: int = 0,
        training_batch_size: int = 200,
        validation_fraction: float = 0.1,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[Any, Any]:
        """Return what to train on and what is held out, batch by batch."""
        data = TensorDataset(*self.get_simulations(starting_round))
        theta = data.tensors[0]
        if len(theta.unique(dim=0)) < len(theta):
            rows = split_pairs(theta, validation_fraction)
            # sbi standardises by what is trained on.
            self.train_indices, self.val_indices = rows
            train, held_out = (SubsetRandomSampler(some.tolist()) for some in rows)
            if size := len(held_out):
                batch_size = min(training_batch_size, len(train))
                batches = DataLoader(data, batch_size, sampler=train, drop_last=True)
                return batches, DataLoader(data, size, sampler=held_out)
        return super().get_dataloaders(
            starting_round, training_batch_size, validation_fraction, *args, **kwargs
        )


def train_on_simulations(
    prior: Any,
    build: Any,
    theta: Tensor,
    x: Tensor,
    *,
    training: Training,
    show_progress_bars: bool,
    trainer: type[SimulationTrainer] = SimulationTrainer,
) -> tuple[ConditionalDensityEstimator, History]:
    """Train what ``build`` returns on simulations, with sbi's trainer of NPE.

    ``theta`` has the shape ``(n, d)``, and x, ``(n, *event)``, is on the device to
    train on. A ``trainer`` may have another loss.
    """
    npe = trainer(
        prior=prior,
        density_estimator=build,
        device=str(x.device),
        tracker=_NoTracker(),
        show_progress_bars=show_progress_bars,
    )
    npe.append_simulations(theta, x)
    settings = asdict(training)
    # sbi trains one epoch more than it is told, and at least two.
    settings["max_num_epochs"] = max(1, training.max_num_epochs - 1)
    # sbi prints to stdout, also if it is told not to.
    with redirect_stdout(sys.stderr if show_progress_bars else io.StringIO()):
        estimator = npe.train(**settings)
    losses = npe.summary["validation_loss"]
    best = min(range(len(losses)), key=losses.__getitem__)
    history = History(
        npe.summary["training_loss"], losses, best, training.learning_rate
    )
    return estimator.eval(), history


class _NoTracker:
    """Keeps sbi from writing a folder of logs next to the user's work."""

    log_dir = None

    def flush(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing."""

    log_metric = log_metrics = log_params = add_figure = flush

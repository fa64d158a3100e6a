"""sbi's trainer of NPE, which is told what to hold out and what to add to its loss."""

from collections.abc import Callable
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets.estimators.base import ConditionalDensityEstimator
from torch import Tensor
from torch.utils.data import DataLoader, SubsetRandomSampler

from sbi_rope._progress import progress_bar
from sbi_rope.data import groups_to_hold_out
from sbi_rope.fit import History

__all__ = ["SimulationTrainer", "train_npe"]


def train_npe(
    prior: Any,
    build: Callable[[Tensor, Tensor], Any],
    theta: Tensor,
    x: Tensor,
    *,
    change_x: Callable[[Tensor], Tensor] | None = None,
    penalty: Callable[[Any], Tensor | None] | None = None,
    show_progress_bars: bool,
    learning_rate: float,
    max_num_epochs: int,
    **options: Any,
) -> tuple[ConditionalDensityEstimator, History]:
    """Train an estimator on simulations with sbi's trainer of NPE.

    Args:
        prior: The prior.
        build: Returns the untrained estimator for pairs like those it is shown.
        theta: Parameters, shape ``(n, d)``.
        x: Simulations, shape ``(n, *event)``, on the device to train on.
        change_x: Applied to the x of every batch before its loss is taken.
        penalty: Of the estimator, a term that is added to the loss of every training
            batch; None adds nothing.
        show_progress_bars: Whether to show the number of epochs.
        learning_rate: Step size of Adam.
        max_num_epochs: Most passes over the training data; two at least are made.
        **options: The other options of sbi's ``train``.

    Returns:
        The trained estimator, in evaluation mode, and its losses epoch by epoch.
    """
    trainer = SimulationTrainer(
        change_x=change_x,
        penalty=penalty,
        prior=prior,
        density_estimator=build,
        device=str(x.device),
        tracker=_NoTracker(),
        show_progress_bars=show_progress_bars,
    )
    trainer.append_simulations(theta, x)
    estimator = trainer.train(
        learning_rate=learning_rate,
        # sbi trains one epoch more than it is told, and at least two.
        max_num_epochs=max(1, max_num_epochs - 1),
        **options,
    )
    losses = trainer.summary["validation_loss"]
    best = min(range(len(losses)), key=losses.__getitem__)
    history = History(trainer.summary["training_loss"], losses, best, learning_rate)
    return estimator.eval(), history


class SimulationTrainer(NPE):
    """sbi's NPE, which holds simulations of the same parameters out together.

    Where a few stored people are recorded many times, a network can learn them by
    heart; only people it has not met say when to stop. Recordings of a single person
    are split one by one.

    It shows a progress bar on stderr, or nothing. sbi prints to stdout, a line for each
    epoch in a log file, and prints that it has converged even if it was asked to be
    quiet.
    """

    def __init__(
        self,
        *,
        change_x: Callable[[Tensor], Tensor] | None = None,
        penalty: Callable[[Any], Tensor | None] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._change_x = change_x
        self._penalty = penalty
        self._bar: Any = None

    def get_dataloaders(
        self,
        starting_round: int = 0,
        training_batch_size: int = 200,
        validation_fraction: float = 0.1,
        resume_training: bool = False,  # noqa: FBT001, FBT002
        dataloader_kwargs: dict[str, Any] | None = None,
    ) -> tuple[Any, Any]:
        """Return what to train on and what is held out, batch by batch."""
        theta = self.get_simulations(starting_round)[0]
        split = None if resume_training else _split_by(theta, validation_fraction)
        if split is not None:
            # sbi takes the rows of a training it resumes as they are.
            self.train_indices, self.val_indices = split
            resume_training = True
            # sbi makes no smaller batch of what is left over.
            training_batch_size = min(training_batch_size, len(split[0]))
        train, held_out = super().get_dataloaders(
            starting_round,
            training_batch_size,
            validation_fraction,
            resume_training,
            dataloader_kwargs,
        )
        if split is not None and not len(held_out):
            rows = self.val_indices
            held_out = DataLoader(
                held_out.dataset,
                batch_size=len(rows),
                sampler=SubsetRandomSampler(rows.tolist()),
            )
        return train, held_out

    def _maybe_show_progress(self, show: bool, epoch: int) -> None:  # type: ignore[override]  # noqa: FBT001
        if self._bar is None:
            self._bar = progress_bar(show=show, desc="Training NPE", unit=" epochs")
        self._bar.update()

    def _report_convergence_at_end(self, epoch: int, max_num_epochs: int) -> None:
        self._bar.close()
        if epoch > max_num_epochs:  # sbi warns of that, and prints otherwise
            super()._report_convergence_at_end(epoch, max_num_epochs)

    def _loss(self, theta: Tensor, x: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        if self._change_x is not None:
            x = self._change_x(x)
        loss = super()._loss(theta, x, *args, **kwargs)
        assert self._neural_net is not None
        if self._penalty is None or not self._neural_net.training:
            return loss
        penalty = self._penalty(self._neural_net)
        return loss if penalty is None else loss + penalty


def _split_by(
    theta: Tensor, validation_fraction: float
) -> tuple[Tensor, Tensor] | None:
    """Split rows by their parameters; None if no two rows share theirs, or all do."""
    groups, of_row = theta.unique(dim=0, return_inverse=True)
    if len(groups) in (1, len(theta)):
        return None
    num_held_out = len(theta) - int((1 - validation_fraction) * len(theta))
    order = torch.randperm(len(groups), device=theta.device)
    sizes = torch.bincount(of_row)[order]
    rows = sizes.cumsum(0)
    # As many groups as it takes to fill what sbi makes room for.
    num_groups = int((rows < num_held_out).sum()) + 1
    held_out_groups = order[:num_groups]
    if rows[num_groups - 1] > len(theta) / 2:  # the last of them is a large one
        chosen = groups_to_hold_out(num_held_out, sizes.tolist())
        held_out_groups = order[chosen]
    held_out = torch.isin(of_row, held_out_groups)
    return (~held_out).nonzero()[:, 0], held_out.nonzero()[:, 0]


class _NoTracker:
    """Keeps sbi from writing a folder of logs next to the user's work."""

    log_dir = None

    def log_metric(self, name: str, value: float, step: int | None = None) -> None:
        """Ignore a number."""

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Ignore numbers."""

    def log_params(self, params: dict[str, Any]) -> None:
        """Ignore parameters."""

    def add_figure(self, name: str, figure: Any, step: int | None = None) -> None:
        """Ignore a figure."""

    def flush(self) -> None:
        """Do nothing."""

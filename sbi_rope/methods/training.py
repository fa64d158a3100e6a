"""How networks are trained on simulations, by sbi."""

import copy
import functools
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor
from torch.nn.modules.module import register_module_forward_pre_hook
from torch.utils.data import DataLoader, SubsetRandomSampler

from sbi_rope.data.pairs import groups_to_hold_out
from sbi_rope.npe.sbi import ConditionalDensityEstimator
from sbi_rope.training.fit import History, Training
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.progress import progress_bar
from sbi_rope.utils.settings import check

# Returns an untrained estimator for pairs (theta, x) like those it is shown.
EstimatorBuilder = Callable[[Tensor, Tensor], Any]
MIN_SIMULATIONS = 20


def estimator_builder(density_estimator: Any) -> EstimatorBuilder:
    """Return a builder of untrained estimators, with copies of the given network."""
    check("density_estimator", density_estimator, str | Callable)
    # It holds the name, because sbi's builders cannot be pickled.
    return functools.partial(_build, density_estimator)


def _build(density_estimator: Any, theta: Tensor, x: Tensor) -> Any:
    builder = density_estimator
    if isinstance(builder, str):
        builder = posterior_nn(builder)
    modes: dict[Any, bool] = {}

    def in_evaluation_mode(module: Any, inputs: Any) -> None:
        modes.setdefault(module, module.training)
        module.training = False

    # sbi tries the net on one observation, which moves batch statistics.
    hook = register_module_forward_pre_hook(in_evaluation_mode)
    try:
        built = builder(theta, x)
    finally:
        hook.remove()
        for module, training in modes.items():
            module.training = training
    return copy.deepcopy(built)


def train_on_simulations(
    prior: Any,
    build: EstimatorBuilder,
    theta: Tensor,
    x: Tensor,
    *,
    training: Training,
    show_progress_bars: bool,
    **options: Any,
) -> tuple[ConditionalDensityEstimator, History]:
    """Train what ``build`` returns on simulations, with sbi's trainer of NPE.

    ``theta`` has the shape ``(n, d)``, and x, ``(n, *event)``, is on the device to
    train on. Other options are those of :class:`~sbi_rope.npe.sbi.SimulationTrainer`.
    """
    if len(x) < MIN_SIMULATIONS:
        raise InvalidInputError(
            f"Expected at least {MIN_SIMULATIONS} simulations to train on; got "
            f"{len(x)}."
        )
    trainer = SimulationTrainer(
        prior=prior,
        density_estimator=build,
        device=str(x.device),
        show_progress_bars=show_progress_bars,
        **options,
    )
    trainer.append_simulations(theta, x)
    settings = asdict(training)
    # sbi trains one epoch more than it is told, and at least two.
    settings["max_num_epochs"] = max(1, training.max_num_epochs - 1)
    estimator = trainer.train(**settings)
    losses = trainer.summary["validation_loss"]
    best = min(range(len(losses)), key=losses.__getitem__)
    history = History(
        trainer.summary["training_loss"], losses, best, training.learning_rate
    )
    return estimator.eval(), history


class SimulationTrainer(NPE):
    """sbi's NPE, which holds simulations of the same parameters out together.

    A network can learn a few stored people that are recorded many times by heart; only
    people it has not met say when to stop. Recordings of a single person are split one
    by one. It shows a progress bar on stderr, or nothing, where sbi prints to stdout.

    Args:
        change_x: Applied to the x of every batch before its loss is taken.
        penalty: Of the estimator, a term that is added to the loss of every training
            batch; None adds nothing.
        **options: Those of NPE.
    """

    def __init__(
        self,
        *,
        change_x: Callable[[Tensor], Tensor] | None = None,
        penalty: Callable[[Any], Tensor | None] | None = None,
        **options: Any,
    ) -> None:
        super().__init__(tracker=_NoTracker(), **options)
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
            rows: Any = SubsetRandomSampler(split[1].tolist())
            held_out = DataLoader(held_out.dataset, len(split[1]), sampler=rows)
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
        loss, net = super()._loss(theta, x, *args, **kwargs), self._neural_net
        assert net is not None
        penalty = self._penalty(net) if self._penalty and net.training else None
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

    def flush(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing."""

    log_metric = log_metrics = log_params = add_figure = flush

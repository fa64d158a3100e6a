"""How the baselines are trained: on simulations by sbi, on pairs by our loop."""

import contextlib
import copy
import io
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch
from sbi.inference import NPE
from sbi.neural_nets import posterior_nn
from torch import Tensor
from torch.utils.data import DataLoader, SubsetRandomSampler

from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator
from sbi_rope._training import (
    STEPS_WITHOUT_HOLDOUT,
    History,
    fit,
    groups_to_hold_out,
    warn_without_holdout,
)
from sbi_rope._validation import LARGEST_SETTING, check_integer, check_positive
from sbi_rope.errors import InvalidInputError, InvalidTypeError

__all__ = [
    "EstimatorBuilder",
    "SimulationTrainer",
    "Training",
    "estimator_builder",
    "train_on_pairs",
    "train_with_sbi",
]

# Returns an untrained estimator for pairs (theta, x) like those it is shown.
EstimatorBuilder = Callable[[Tensor, Tensor], Any]
MIN_SIMULATIONS = 20


@dataclass(frozen=True, kw_only=True)
class Training:
    """How a network is trained, in the words of sbi's ``train``; Adam throughout.

    Args:
        training_batch_size: Pairs behind each gradient step, at most all of them.
        learning_rate: Step size of Adam.
        validation_fraction: Share of the data that is held out.
        stop_after_epochs: Epochs without improvement on the held-out data after which
            to stop.
        max_num_epochs: Most passes over the training data; sbi's trainers make two at
            least.
        clip_max_norm: Largest norm of a gradient; None does not clip.

    Raises:
        InvalidInputError: If an argument is outside its range.
    """

    training_batch_size: int = 200
    learning_rate: float = 5e-4
    validation_fraction: float = 0.1
    stop_after_epochs: int = 20
    max_num_epochs: int = 2**31 - 1
    clip_max_norm: float | None = 5.0

    def __post_init__(self) -> None:
        """Check the ranges of all fields."""
        check_integer("training_batch_size", self.training_batch_size)
        check_positive("learning_rate", self.learning_rate, maximum=LARGEST_SETTING)
        check_positive("validation_fraction", self.validation_fraction)
        if self.validation_fraction > 0.5:
            raise InvalidInputError(
                "Expected `validation_fraction` in (0, 0.5]; got "
                f"{self.validation_fraction!r}."
            )
        check_integer("stop_after_epochs", self.stop_after_epochs)
        check_integer("max_num_epochs", self.max_num_epochs)
        if self.clip_max_norm is not None:
            check_positive("clip_max_norm", self.clip_max_norm)


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


def estimator_builder(density_estimator: Any) -> EstimatorBuilder:
    """Return a builder of untrained estimators, from a name or from a builder.

    sbi's builders put the network they were given into what they build, and training
    then changes it. Ours builds from a copy, so that several methods can share one.

    Raises:
        InvalidTypeError: If it is neither a name nor callable.
        InvalidInputError: If sbi knows no estimator of that name.
    """
    if isinstance(density_estimator, str):
        name, density_estimator = density_estimator, posterior_nn(density_estimator)
        try:
            with seeded(0):
                some = torch.randn(10, 2)
                density_estimator(some, some)
        except Exception as error:
            raise InvalidInputError(
                "Expected `density_estimator` to be the name of an estimator for "
                f"continuous parameters that sbi's `posterior_nn` knows; got {name!r}."
            ) from error
    if not callable(density_estimator):
        raise InvalidTypeError(
            "Expected `density_estimator` to be a name such as 'nsf', or what sbi's "
            f"`posterior_nn(...)` returns; got {type(density_estimator).__name__}."
        )

    def build(theta: Tensor, x: Tensor) -> Any:
        modes: dict[Any, bool] = {}

        def in_evaluation_mode(module: Any, inputs: Any) -> None:
            modes.setdefault(module, module.training)
            module.training = False

        # sbi tries the net on one observation, which moves batch statistics.
        hook = torch.nn.modules.module.register_module_forward_pre_hook(
            in_evaluation_mode
        )
        try:
            built = density_estimator(theta, x)
        finally:
            hook.remove()
            for module, training in modes.items():
                module.training = training
        return copy.deepcopy(built)

    return build


class SimulationTrainer(NPE):
    """sbi's NPE, which holds simulations of the same parameters out together.

    Where a few stored people are recorded many times, a network can learn them by
    heart; only people it has not met say when to stop. Recordings of a single person
    are split one by one.
    """

    def get_dataloaders(  # noqa: D102
        self,
        starting_round: int = 0,
        training_batch_size: int = 200,
        validation_fraction: float = 0.1,
        resume_training: bool = False,  # noqa: FBT001, FBT002
        dataloader_kwargs: dict[str, Any] | None = None,
    ) -> tuple[Any, Any]:
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


def train_with_sbi(
    make_trainer: Callable[..., SimulationTrainer],
    prior: Any,
    build: EstimatorBuilder,
    theta: Tensor,
    x: Tensor,
    *,
    training: Training,
    show_progress_bars: bool,
) -> tuple[ConditionalDensityEstimator, History]:
    """Train an estimator on simulations with one of sbi's trainers.

    Args:
        make_trainer: ``SimulationTrainer`` or a subclass of it, called with the words
            of its constructor.
        prior: The prior.
        build: Returns the untrained estimator.
        theta: Parameters, shape ``(n, k)``.
        x: Simulations, shape ``(n, *event)``, on the device to train on.
        training: Batch size, learning rate and so on.
        show_progress_bars: Whether sbi shows the number of epochs.

    Returns:
        The trained estimator, in evaluation mode, and its losses epoch by epoch.

    Raises:
        InvalidInputError: If there are too few simulations to hold some out.
    """
    if len(x) < MIN_SIMULATIONS:
        raise InvalidInputError(
            f"Expected at least {MIN_SIMULATIONS} simulations to train on; got "
            f"{len(x)}."
        )
    trainer = make_trainer(
        prior=prior,
        density_estimator=build,
        device=str(x.device),
        tracker=_NoTracker(),
        show_progress_bars=show_progress_bars,
    )
    # sbi prints that it has converged whether or not it was asked to be quiet.
    quiet = (
        contextlib.nullcontext()
        if show_progress_bars
        else contextlib.redirect_stdout(io.StringIO())
    )
    with quiet:
        trainer.append_simulations(theta, x)
        # sbi trains one epoch more than it is told, and at least two.
        options: dict[str, Any] = asdict(training)
        options["max_num_epochs"] = max(1, training.max_num_epochs - 1)
        estimator = trainer.train(**options)
    losses = trainer.summary["validation_loss"]
    best = min(range(len(losses)), key=losses.__getitem__)
    history = History(
        trainer.summary["training_loss"], losses, best, training.learning_rate
    )
    return estimator.eval(), history


def train_on_pairs(
    estimator: Any,
    theta: Tensor,
    x: Tensor,
    split: tuple[Tensor, Tensor],
    *,
    training: Training,
    in_training_mode: bool,
    label: str,
    show_progress_bars: bool,
) -> History:
    """Train an estimator on calibration pairs alone, in place.

    Args:
        estimator: A density estimator of sbi.
        theta: Parameters, shape ``(n, k)``.
        x: Real observations, shape ``(n, *event)``.
        split: The rows to train on and those held out; without the latter, training
            stops early.
        training: Batch size, learning rate and so on.
        in_training_mode: Whether dropout and batch statistics are active in training.
        label: What the progress bar and warnings call it.
        show_progress_bars: Whether to show the course of the loss.

    Returns:
        The losses and the epoch that was kept.
    """
    train, held_out = split
    max_num_epochs = training.max_num_epochs
    if not len(held_out):
        warn_without_holdout(theta)
        max_num_epochs = min(max_num_epochs, STEPS_WITHOUT_HOLDOUT)

    def batches(step: int) -> Iterator[tuple[Tensor, Tensor]]:
        order = train[torch.randperm(len(train))]
        for rows in order.split(training.training_batch_size):
            yield theta[rows], x[rows]

    def loss(theta: Tensor, x: Tensor) -> Tensor:
        return estimator.loss(theta, condition=x).mean()

    return fit(
        estimator,
        batches,
        loss,
        validation_loss=(
            (lambda: loss(theta[held_out], x[held_out])) if len(held_out) else None
        ),
        learning_rate=training.learning_rate,
        max_num_steps=max_num_epochs,
        patience=training.stop_after_epochs,
        clip_max_norm=training.clip_max_norm,
        in_training_mode=in_training_mode,
        label=label,
        show_progress_bars=show_progress_bars,
    )

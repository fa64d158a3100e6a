"""How networks are trained: on simulations by sbi, on calibration pairs by our loop."""

import copy
import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch
from sbi.neural_nets import posterior_nn
from torch import Tensor, nn

from sbi_rope._random import seeded
from sbi_rope._sbi import ConditionalDensityEstimator, train_npe
from sbi_rope._training import (
    History,
    epochs_on_pairs,
    fit,
    shuffled,
)
from sbi_rope.errors import InvalidInputError, warn_user
from sbi_rope.settings import Count, Level, Positive, Settings, check

__all__ = [
    "FINETUNING",
    "EstimatorBuilder",
    "Training",
    "estimator_builder",
    "rows_with_density",
    "train_network",
    "train_on_pairs",
    "train_on_simulations",
]

# Returns an untrained estimator for pairs (theta, x) like those it is shown.
EstimatorBuilder = Callable[[Tensor, Tensor], Any]
MIN_SIMULATIONS = 20


@dataclass(frozen=True, kw_only=True)
class Training(Settings):
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

    training_batch_size: Count = 200
    learning_rate: Positive = 5e-4
    validation_fraction: Level = 0.1
    stop_after_epochs: Count = 20
    max_num_epochs: Count = 2**31 - 1
    clip_max_norm: Positive | None = 5.0


# How NPE is fine-tuned on pairs, chosen on calibration data: see benchmarks/choices.md.
FINETUNING = Training(
    training_batch_size=100,
    validation_fraction=0.2,
    stop_after_epochs=50,
    max_num_epochs=500,
)


def estimator_builder(density_estimator: Any) -> EstimatorBuilder:
    """Return a builder of untrained estimators, from a name or from a builder.

    sbi's builders put the network they were given into what they build, and training
    then changes it. Ours builds from a copy, so that several methods can share one.

    Raises:
        InvalidInputError: If sbi knows no estimator of that name.
    """
    check("density_estimator", density_estimator, str | Callable)
    if isinstance(density_estimator, str):
        _builder_of_name(density_estimator)
    return _CopyingBuilder(density_estimator)


@dataclass(frozen=True)
class _CopyingBuilder:
    """Builds estimators from copies of the networks that sbi's builder was given.

    It holds the name, because sbi's builders cannot be pickled.
    """

    density_estimator: str | EstimatorBuilder

    def __call__(self, theta: Tensor, x: Tensor) -> Any:
        builder = self.density_estimator
        if isinstance(builder, str):
            builder = _builder_of_name(builder)
        modes: dict[Any, bool] = {}

        def in_evaluation_mode(module: Any, inputs: Any) -> None:
            modes.setdefault(module, module.training)
            module.training = False

        # sbi tries the net on one observation, which moves batch statistics.
        hook = torch.nn.modules.module.register_module_forward_pre_hook(
            in_evaluation_mode
        )
        try:
            built = builder(theta, x)
        finally:
            hook.remove()
            for module, training in modes.items():
                module.training = training
        return copy.deepcopy(built)


@functools.cache
def _builder_of_name(name: str) -> EstimatorBuilder:
    """Return sbi's builder of a name, after it has built something once."""
    builder = posterior_nn(name)
    try:
        with seeded(0):
            some = torch.randn(10, 2)
            builder(some, some)
    except Exception as error:
        raise InvalidInputError(
            "Expected `density_estimator` to be one for continuous parameters that "
            f"`posterior_nn` knows; got {name!r}."
        ) from error
    return builder


def train_on_simulations(
    prior: Any,
    build: EstimatorBuilder,
    theta: Tensor,
    x: Tensor,
    *,
    training: Training,
    show_progress_bars: bool,
    change_x: Callable[[Tensor], Tensor] | None = None,
    penalty: Callable[[Any], Tensor | None] | None = None,
) -> tuple[ConditionalDensityEstimator, History]:
    """Train an estimator on simulations with sbi's trainer of NPE.

    Args:
        prior: The prior.
        build: Returns the untrained estimator.
        theta: Parameters, shape ``(n, d)``.
        x: Simulations, shape ``(n, *event)``, on the device to train on.
        training: Batch size, learning rate and so on.
        show_progress_bars: Whether to show the number of epochs.
        change_x: Applied to the x of every batch before its loss is taken.
        penalty: Of the estimator, a term that is added to the loss of every training
            batch; None adds nothing.
    """
    if len(x) < MIN_SIMULATIONS:
        raise InvalidInputError(
            f"Expected at least {MIN_SIMULATIONS} simulations to train on; got "
            f"{len(x)}."
        )
    return train_npe(
        prior,
        build,
        theta,
        x,
        change_x=change_x,
        penalty=penalty,
        show_progress_bars=show_progress_bars,
        **asdict(training),
    )


def train_network(
    module: nn.Module,
    batches: Callable[[int], Iterable[tuple[Any, ...]]],
    loss: Callable[..., Tensor],
    training: Training,
    *,
    max_num_epochs: int | None = None,
    **options: Any,
) -> History:
    """Train a module by any loss, in place, with the settings of a training.

    Args:
        module: The module.
        batches: Given the number of the epoch, the batches to pass over.
        loss: Of a batch, its mean loss.
        training: Learning rate and so on; ``batches`` has the size of the batches.
        max_num_epochs: Instead of that of ``training``.
        **options: Other arguments of ``_training.fit``.

    Returns:
        The losses and the epoch that was kept.
    """
    return fit(
        module,
        batches,
        loss,
        learning_rate=training.learning_rate,
        max_num_epochs=max_num_epochs or training.max_num_epochs,
        stop_after_epochs=training.stop_after_epochs,
        clip_max_norm=training.clip_max_norm,
        **options,
    )


@torch.no_grad()
def rows_with_density(
    losses: Callable[[Tensor], Tensor], *splits: Tensor
) -> tuple[Tensor, ...]:
    """Return the rows of pairs whose loss is finite, after a warning of the others.

    A single infinite loss would end the training of all pairs. A label exactly on a
    bound of the prior has one if the estimator's density is zero there. A part of which
    all rows have one stays as it is, and its training says so.
    """
    finite = [
        torch.cat([torch.isfinite(losses(some)) for some in rows.split(100)])
        if len(rows)
        else rows.bool()
        for rows in splits
    ]
    missing = sum(int((~of_part).sum()) for of_part in finite)
    if missing:
        warn_user(
            f"{missing} calibration pair(s) have no density under NPE, and are left "
            "out of this training. Are they exactly on a bound of the prior?"
        )
    return tuple(
        rows[of_part] if of_part.any() else rows
        for rows, of_part in zip(splits, finite, strict=True)
    )


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

    The split has the rows to train on and those held out. Without the latter, training
    stops early. Returned are the losses and the epoch that was kept.
    """
    estimator.eval()
    train, held_out = rows_with_density(
        lambda rows: estimator.loss(theta[rows], condition=x[rows]), *split
    )

    def batches(epoch: int) -> Iterator[tuple[Tensor, Tensor]]:
        for rows in shuffled(train, training.training_batch_size):
            yield theta[rows], x[rows]

    def loss(theta: Tensor, x: Tensor) -> Tensor:
        return estimator.loss(theta, condition=x).mean()

    return train_network(
        estimator,
        batches,
        loss,
        training,
        validation_loss=(
            (lambda: loss(theta[held_out], x[held_out])) if len(held_out) else None
        ),
        max_num_epochs=epochs_on_pairs(theta, held_out, training.max_num_epochs),
        in_training_mode=in_training_mode,
        label=label,
        show_progress_bars=show_progress_bars,
    )

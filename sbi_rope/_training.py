"""One loop for all networks that sbi's trainers cannot train."""

import copy
import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from sbi_rope._groups import MIN_PAIRS_FOR_HOLDOUT, too_few_pairs
from sbi_rope._progress import progress_bar
from sbi_rope.errors import RoPEWarning, warn_user

__all__ = [
    "EPOCHS_WITHOUT_HOLDOUT",
    "History",
    "adam",
    "best_of_learning_rates",
    "epochs_on_pairs",
    "fit",
    "shuffled",
    "without_warning_of_few_pairs",
]

Trained = TypeVar("Trained")
# More epochs than this are no limit.
LARGEST_LIMIT = 10**6
# Without a hold-out nothing says when to stop, so little is risked.
EPOCHS_WITHOUT_HOLDOUT = 50


@dataclass(frozen=True)
class History:
    """The course of a training, for plotting.

    An epoch is a pass over the training data. For ``CalibrationFinetuner`` it is one
    gradient step over all pairs. What sbi's trainers report starts after the first
    epoch, which is number 0 then.

    Attributes:
        training_loss: Mean loss over the training data during each epoch, and after the
            last; of a fine-tuning, the distance in units of the embedding, with
            rehearsal the weighted sum of both distances.
        validation_loss: Loss over the held-out data before each epoch and after the
            last; empty without a hold-out.
        best_epoch: Number of epochs after which the kept net was reached; 0 is the
            starting point.
        learning_rate: The learning rate of this course, the best of those tried.
    """

    training_loss: list[float] = field(repr=False)
    validation_loss: list[float] = field(repr=False)
    best_epoch: int
    learning_rate: float

    @property
    def kept_validation_loss(self) -> float:
        """The validation loss of the kept net; 0 without a hold-out, inf for NaN."""
        loss = self.validation_loss[self.best_epoch] if self.validation_loss else 0.0
        return math.inf if math.isnan(loss) else loss

    def __repr__(self) -> str:
        loss, what = self.validation_loss, "validation_loss"
        if not loss:
            loss, what = self.training_loss, "training_loss"
        return (
            f"History({what} {loss[0]:.3g} -> {loss[self.best_epoch]:.3g}, "
            f"best_epoch={self.best_epoch}, learning_rate={self.learning_rate:g})"
        )


def epochs_on_pairs(
    theta_or_groups: Tensor, held_out: Tensor, max_num_epochs: int
) -> int:
    """Return how many epochs to train on pairs for; few if none are held out.

    Warns then, that nothing chooses the best net.
    """
    if len(held_out):
        return max_num_epochs
    warn_user(
        f"{too_few_pairs(theta_or_groups)}: none is held out, and tuning stops after "
        f"at most {EPOCHS_WITHOUT_HOLDOUT} epochs. Append at least "
        f"{MIN_PAIRS_FOR_HOLDOUT} pairs of different parameters to choose the best net "
        "on a hold-out."
    )
    return min(max_num_epochs, EPOCHS_WITHOUT_HOLDOUT)


@contextmanager
def without_warning_of_few_pairs() -> Iterator[None]:
    """Train on some of the user's pairs, whose number the user did not choose."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Only .* none is held out", RoPEWarning)
        yield


def shuffled(
    rows: Tensor, size: int, *, generator: torch.Generator | None = None
) -> Iterator[Tensor]:
    """Pass over rows in random order, in batches of a size."""
    order = torch.randperm(len(rows), generator=generator)
    yield from rows[order.to(rows.device)].split(size)


def adam(parameters: Sequence[Tensor], learning_rate: float) -> torch.optim.Adam:
    """Return the optimizer of our training loops.

    On a CPU, torch's own choice is a loop in Python over all parameters. With
    ``foreach`` it does the same arithmetic, bit for bit, in less time.
    """
    return torch.optim.Adam(parameters, lr=learning_rate, foreach=True)


def differentiable(module: nn.Module) -> AbstractContextManager[Any]:
    """Return a context in which the gradients of a module can be computed.

    cuDNN has no gradients of recurrent nets in evaluation mode, which the slower code
    of torch has.
    """
    is_recurrent = any(isinstance(part, nn.RNNBase) for part in module.modules())
    if is_recurrent and not module.training:
        return torch.backends.cudnn.flags(enabled=False)
    return nullcontext()


def fit(
    module: nn.Module,
    batches: Callable[[int], Iterable[tuple[Any, ...]]],
    loss: Callable[..., Tensor],
    *,
    validation_loss: Callable[[], Tensor] | None,
    learning_rate: float,
    max_num_epochs: int,
    stop_after_epochs: int,
    clip_max_norm: float | None = None,
    in_training_mode: bool = True,
    decay: bool = False,
    label: str,
    show_progress_bars: bool,
) -> History:
    """Train a module with Adam and leave it at its best on the held-out data.

    The starting point competes, so that training never returns something worse than it
    started from on the held-out data. Without a hold-out the last state is kept.

    Args:
        module: What to train, in place.
        batches: Given the number of the epoch, the batches to pass over.
        loss: Of a batch, its mean loss.
        validation_loss: The loss over the held-out data, if there are any.
        learning_rate: Step size of Adam.
        max_num_epochs: Most passes over the batches.
        stop_after_epochs: Epochs without a new best after which to stop.
        clip_max_norm: Largest norm of a gradient; None does not clip.
        in_training_mode: Whether dropout and batch statistics are active in training.
        decay: Whether the step size falls to zero, along a cosine over all epochs.
        label: What the progress bar and warnings call it.
        show_progress_bars: Whether to show the course of the loss.

    Returns:
        The losses and the epoch that was kept.
    """
    # To walk through the parts of a module takes nearly as long as a step of a small
    # network, so that it is done once where that is enough.
    parameters = list(module.parameters())
    optimizer = adam(parameters, learning_rate)
    scheduler = (
        torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max_num_epochs)
        if decay
        else None
    )
    training_loss: list[float] = []
    held_out_loss: list[float] = []
    best_state, best_epoch = _state_of(module), 0

    def one_pass(epoch: int, *, update: bool) -> float:
        in_training = in_training_mode and update
        if in_training:
            module.train()
        values = []
        with differentiable(module):
            for batch in batches(epoch):
                value = loss(*batch)
                if update:
                    optimizer.zero_grad()
                    value.backward()
                values.append(float(value.detach()))
                if not update:
                    continue
                if clip_max_norm is not None:
                    nn.utils.clip_grad_norm_(parameters, clip_max_norm)
                optimizer.step()
        if update and scheduler is not None:
            scheduler.step()
        if in_training:
            module.eval()
        return sum(values) / len(values)

    progress = progress_bar(
        range(max_num_epochs + 1),
        show=show_progress_bars,
        # Training without a limit ends where the loss does not fall any more.
        total=max_num_epochs + 1 if max_num_epochs < LARGEST_LIMIT else math.inf,
        desc=f"{label} (learning rate {learning_rate:g})",
    )
    module.eval()
    for epoch in progress:
        if validation_loss is not None:
            with torch.no_grad():
                held_out_loss.append(float(validation_loss()))
        improved = validation_loss is None or _is_below(
            held_out_loss[-1], held_out_loss[best_epoch]
        )
        state = _state_of(module) if improved else best_state
        newest = epoch if improved else best_epoch
        is_last = epoch == max_num_epochs or epoch - newest >= stop_after_epochs
        with torch.set_grad_enabled(not is_last):
            training_loss.append(one_pass(epoch, update=not is_last))
        if not math.isfinite(training_loss[-1]):
            warn_user(
                f"{label}: the loss is not finite after {epoch} epochs with learning "
                f"rate {learning_rate:g}; the best net before is kept. Use a smaller "
                "learning rate."
            )
            break
        best_state, best_epoch = state, newest
        # Without a refresh of its own: the bar moves at most ten times a second.
        progress.set_postfix(
            loss=(held_out_loss or training_loss)[-1],
            best_epoch=best_epoch,
            refresh=False,
        )
        if is_last:
            break
    progress.close()
    module.load_state_dict(best_state)
    return History(training_loss, held_out_loss, best_epoch, learning_rate)


def _state_of(module: nn.Module) -> dict[str, Any]:
    """Return a copy of the parameters and buffers of a module."""
    state = module.state_dict()
    for name, value in state.items():
        # Nearly all are tensors, which `copy.deepcopy` copies more slowly.
        is_tensor = isinstance(value, Tensor)
        state[name] = value.clone() if is_tensor else copy.deepcopy(value)
    return state


def best_of_learning_rates(
    train: Callable[[float], tuple[Trained, History]],
    learning_rates: Sequence[float],
    *,
    num_held_out: int,
    otherwise: float,
) -> tuple[Trained, History]:
    """Train from the start with each learning rate; keep the best on the hold-out.

    Args:
        train: Given a learning rate, returns what it has trained and the losses.
        learning_rates: What to try.
        num_held_out: Size of the hold-out; of none, nothing can choose.
        otherwise: The learning rate to train with then.
    """
    rates = learning_rates if num_held_out else (otherwise,)
    results = [train(rate) for rate in rates]
    return min(results, key=lambda result: result[1].kept_validation_loss)


def _is_below(loss: float, best: float) -> bool:
    """Whether a loss is an improvement; any number improves on NaN."""
    return not math.isnan(loss) and not best <= loss

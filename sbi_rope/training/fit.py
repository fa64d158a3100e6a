"""The one loop in which all networks of this package are trained."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope.utils.errors import warn_user
from sbi_rope.utils.progress import progress_bar
from sbi_rope.utils.settings import Count, Level, Positive, Settings

# Share of a course in which its step size rises.
WARM_UP = 0.1
# Of Adam, as in torch.
BETAS, EPSILON = (0.9, 0.999), 1e-8


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
    """

    training_batch_size: Count = 200
    learning_rate: Positive = 5e-4
    validation_fraction: Level = 0.1
    stop_after_epochs: Count = 20
    max_num_epochs: Count = 2**31 - 1
    clip_max_norm: Positive | None = 5.0


@dataclass(frozen=True)
class History:
    """The course of a training, for plotting.

    An epoch is a pass over the training data, of ``CalibrationFinetuner`` one step.

    Attributes:
        training_loss: Mean loss over the training data during each epoch; of a
            fine-tuning, the distance in units of the embedding, with rehearsal the
            weighted sum of both distances.
        validation_loss: Loss over the hold-out set before each epoch and after the last
            (of sbi's trainers, after each); empty without a hold-out set.
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


@dataclass(frozen=True)
class Courses:
    """Trainings that follow each other; in each the step size falls to zero.

    Attributes:
        min_gain: What a course has to gain for another to follow; not negative.
        min_fall: How far the training loss has to fall from the third to the last
            quarter of a course for another to follow.
        max_num: The largest number of courses.
        growth: How many times as long as the one before a course is.
    """

    min_gain: float
    min_fall: float = -math.inf
    max_num: int = 12
    growth: int = 1


def fit(
    network: nn.Module,
    batches: Callable[[int], Iterable[tuple[Any, ...]]],
    loss: Callable[..., Tensor],
    training: Training,
    *,
    validation_loss: Callable[..., Tensor] | None = None,
    held_out: Sequence[Any] = (),
    courses: Courses | None = None,
    learning_rates: Sequence[float] | None = None,
    max_num_epochs: int | None = None,
    in_training_mode: bool = True,
    decay: bool = False,
    label: str,
    show_progress_bars: bool,
) -> list[History]:
    """Train networks in place with Adam; leave each at its best on its hold-out set.

    The starting point competes. Without a hold-out set the last state is kept. A member
    of an ensemble stops by itself, also if its loss is not finite.

    The network is a module, or E members whose parameters are stacked. Parameters that
    require no gradient are left alone, unless none does. ``batches`` returns the
    batches of an epoch, given its number; each part of one has the rows of member e at
    ``part[e]``. Of a batch, ``loss`` returns the mean loss of each member, ``(E,)``, or
    of the module, and ``validation_loss`` that of ``held_out``. Members that have
    stopped are not in the batch and in the network any more.

    With ``courses``, ``max_num_epochs`` are a course that others may follow, after
    which the validation loss is computed. Dropout and batch statistics are active in
    training if ``in_training_mode``. With ``decay`` the step size falls along a cosine.
    """
    if not any(parameter.requires_grad for parameter in network.parameters()):
        network.requires_grad_()
    optimiser = _Adam(network, training.clip_max_norm)
    E = len(optimiser.values)
    # Members of ensembles share buffers, which stay as they are.
    own = [] if hasattr(network, "num_members") else network.buffers()
    buffers = [buffer.detach()[None] for buffer in own]
    given = learning_rates or [training.learning_rate] * E
    rates = torch.tensor(given, dtype=torch.double)
    length, start = max_num_epochs or training.max_num_epochs, 0
    growths = [courses.growth**k for k in range(courses.max_num)] if courses else [1]
    last = length * sum(growths)
    training_loss: list[list[float]] = [[] for _ in range(E)]
    scores: list[list[float]] = [[] for _ in range(E)]
    best = [value.clone() for value in (optimiser.values, *buffers)]
    best_loss = torch.full((E,), math.inf, dtype=torch.double)
    best_epoch = torch.zeros(E, dtype=torch.long)
    # Those that are still trained. The others leave the network, to save their time.
    members, going, num_lost = torch.arange(E), torch.ones(E, dtype=torch.bool), 0

    def of_members(batch: Sequence[Any]) -> Sequence[Any]:
        return batch if len(members) == E else [of_all[members] for of_all in batch]

    def append(losses: list[list[float]], new: Tensor) -> None:
        for e, value in zip(members.tolist(), new.tolist(), strict=True):
            losses[e].append(value)

    progress = progress_bar(range(last + 1), show=show_progress_bars, desc=label)
    network.eval()
    for epoch in progress:
        state = [optimiser.values, *buffers]
        is_over = courses is None or epoch in (0, start + length)
        better, gain = going & (validation_loss is None), best_loss[members]
        if validation_loss is not None and is_over:
            with torch.no_grad():
                score = validation_loss(*of_members(held_out)).detach()
            score = score.double().cpu().reshape(len(members))
            gain = best_loss[members] - score
            better = going & (gain > 0)  # never for NaN
            best_loss[members[better]] = score[better]
            append(scores, score)
        best_epoch[members[better]] = epoch
        for kept, value in zip(best, state, strict=True):
            kept[members[better]] = value[better]
        if epoch == last:
            break
        if validation_loss is not None and courses is None:
            going &= epoch - best_epoch[members] < training.stop_after_epochs
        elif courses and epoch and is_over:
            fall = torch.tensor([_fall(training_loss[e], length) for e in members])
            going &= (gain > courses.min_gain) & (fall > courses.min_fall)
            optimiser.restart()
            start, length = epoch, length * courses.growth
        if not going.any():
            break
        if not going.all():
            optimiser.keep_only(going)
            members, going = members[going], going[going]
        part = (epoch - start) / length if decay or courses else 0.0
        factor = 0.5 * (1 + math.cos(math.pi * part))
        if courses:
            factor *= min(1.0, (part + 1 / length) / WARM_UP)
        of_batches, finite = [], going.clone()
        if in_training_mode:  # walking through the modules takes as long as a step
            network.train()
        with differentiable(network):
            for batch in batches(epoch):
                value = loss(*of_members(batch)).reshape(len(members))
                finite &= torch.isfinite(value.detach()).cpu()
                optimiser.step(value, factor * rates[members] * finite)
                of_batches.append(value.detach())
        if in_training_mode:
            network.eval()
        append(training_loss, torch.stack(of_batches).double().mean(dim=0))
        num_lost += int((going & ~finite).sum())
        going &= finite
        losses = scores if validation_loss is not None else training_loss
        progress.set_postfix(
            loss=sum(losses[e][-1] for e in members) / len(members), refresh=False
        )
    progress.close()
    if num_lost:
        warn_user(
            f"{label}: the loss of {num_lost} of {E} networks is not finite; their "
            "best states before are kept. Use a smaller learning rate."
        )
    optimiser.show(best[0])
    for parameter in optimiser.parameters:  # give each memory of its own
        parameter.data = parameter.data.clone(memory_format=torch.contiguous_format)
    for buffer, kept in zip(buffers, best[1:], strict=True):
        buffer.copy_(kept)
    network.requires_grad_(requires_grad=False)
    return [
        History(
            training_loss[e], [] if courses else scores[e], int(best_epoch[e]), given[e]
        )
        for e in range(E)
    ]


def _fall(losses: Sequence[float], length: int) -> float:
    """Return how far the mean loss fell from the third to the last quarter."""
    quarter = max(1, length // 4)
    third, fourth = losses[-2 * quarter : -quarter], losses[-quarter:]
    return sum(third) / quarter - sum(fourth) / quarter


class _Adam:
    """Adam with a step size, and a limit on the gradient's norm, for each member.

    While it is in use, the parameters are views of ``values``, which has those of each
    member side by side, ``(E, P)``.
    """

    def __init__(self, network: nn.Module, clip_max_norm: float | None) -> None:
        self.parameters = [one for one in network.parameters() if one.requires_grad]
        self.clip_max_norm = clip_max_norm
        count = getattr(network, "num_members", 1)
        self.sizes = [one.numel() // count for one in self.parameters]
        self.show(_side_by_side(self.parameters, count).detach())
        self.restart()

    def restart(self) -> None:
        """Forget all gradients."""
        self.first = torch.zeros_like(self.values)
        self.second = torch.zeros_like(self.values)
        self.num_steps = 0

    def show(self, values: Tensor) -> None:
        """Make the parameters views of these values."""
        self.values = values
        parts = values.split(self.sizes, dim=1)
        for parameter, part in zip(self.parameters, parts, strict=True):
            shape = parameter.shape
            parameter.data = part.view((-1, *shape[1:]) if shape else ())

    def keep_only(self, going: Tensor) -> None:
        """Take the members out of the network that have stopped."""
        self.first, self.second = self.first[going], self.second[going]
        self.show(self.values[going])

    def step(self, losses: Tensor, rates: Tensor) -> None:
        """Lower the losses of all members, ``(E,)``, each with its step size."""
        total = losses[torch.isfinite(losses.detach())].sum()
        found = torch.autograd.grad(
            total, self.parameters, allow_unused=True, materialize_grads=True
        )
        with torch.no_grad():
            gradient = _side_by_side(found, len(self.values))
            norm = gradient.norm(dim=1, keepdim=True)
            if not torch.isfinite(norm).all():
                norm = gradient.nan_to_num_(0.0, 0.0, 0.0).norm(dim=1, keepdim=True)
            if self.clip_max_norm is not None:
                gradient *= (self.clip_max_norm / (norm + 1e-6)).clamp(max=1.0)
            self.num_steps += 1
            self.first.lerp_(gradient, 1 - BETAS[0])
            self.second.mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
            scale = self.second.sqrt().div_(math.sqrt(1 - BETAS[1] ** self.num_steps))
            size = rates.to(gradient) / (1 - BETAS[0] ** self.num_steps)
            self.values -= self.first / scale.add_(EPSILON) * size[:, None]


def _side_by_side(tensors: Sequence[Tensor], count: int) -> Tensor:
    return torch.cat([one.reshape(count, -1) for one in tensors], dim=1)


@contextmanager
def differentiable(module: nn.Module) -> Iterator[None]:
    """Compute the gradients of a module, also where the caller switched them off."""
    is_recurrent = any(isinstance(part, nn.RNNBase) for part in module.modules())
    is_slow = is_recurrent and not module.training
    context = torch.backends.cudnn.flags(enabled=False) if is_slow else nullcontext()
    with torch.enable_grad(), context:
        yield

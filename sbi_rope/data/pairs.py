"""Calibration pairs: what was measured, of whom, and how much each pair counts.

A group is held out as a whole, because a network can learn by heart whom it has met.
"""

import math
import warnings
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from sbi_rope.utils.errors import InvalidInputError, RoPEWarning, warn_user
from sbi_rope.utils.seeds import seeded

if TYPE_CHECKING:
    from typing_extensions import Self

# Fewer groups than this leave nothing to hold out.
MIN_PAIRS_FOR_HOLDOUT = 5
# Without a hold-out nothing says when to stop, so little is risked.
EPOCHS_WITHOUT_HOLDOUT = 50


class Rows:
    """A dataclass of tensors, each with one row for each pair."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def __getitem__(self, rows: Tensor) -> "Self":
        return type(self)(**{name: value[rows] for name, value in vars(self).items()})


@dataclass(frozen=True, eq=False, kw_only=True)
class Pairs(Rows):
    r"""Real observations with labels; all tensors are on the device of NPE.

    A label is a measurement of some or all parameters, exact or with normal noise,
    :math:`y_j \sim \mathcal N(\theta_j, \sigma_j^2)`, or draws of all parameters from
    :math:`p(\theta \mid \text{label})` under the prior of NPE.

    Attributes:
        theta: Draws from :math:`p(\theta \mid \text{label})` under the prior, shape
            ``(n, S, d)``. S is 1 if all labels are exact.
        x: Observations, shape ``(n, *event)``.
        group: The number of the person or specimen of each pair, shape ``(n,)``.
        weight: How many pairs each pair counts as, float64, shape ``(n,)``.
        y: The measurements, NaN where there are none, shape ``(n, d)``. Of a label
            given as draws, their mean.
        std: The noise, zero for exact and missing parameters, and NaN for labels given
            as draws, ``(n, d)``, float64.
    """

    theta: Tensor
    x: Tensor
    group: Tensor
    weight: Tensor
    y: Tensor
    std: Tensor

    @classmethod
    def exact(cls, theta: Tensor, x: Tensor) -> "Pairs":
        """Return pairs of parameters ``(n, d)`` and x; equal ones share a group."""
        return cls(
            theta=theta[:, None],
            x=x,
            group=groups_of(theta).to(theta.device),
            weight=theta.new_ones(len(theta), dtype=torch.double),
            y=theta,
            std=torch.zeros_like(theta, dtype=torch.double),
        )

    def __add__(self, others: "Pairs") -> "Pairs":
        """Return these pairs followed by others; draws of measurements are not kept."""
        if not len(self):
            return others
        counts = [one.theta.shape[1] * one.are_drawn for one in (self, others)]
        if counts[0] != counts[1]:
            raise InvalidInputError(
                "Expected labels with as many draws as those appended before, "
                f"{counts[0]}; got {counts[1]}."
            )
        first, second = (
            vars(one if one.are_drawn else replace(one, theta=one.y[:, None]))
            for one in (self, others)
        )
        return Pairs(**{k: torch.cat([value, second[k]]) for k, value in first.items()})

    @property
    def are_drawn(self) -> bool:
        """Whether labels are draws, and no measurements."""
        return bool(torch.isnan(self.std).any())

    @property
    def is_measured(self) -> Tensor:
        """Which parameters were measured, exactly or with noise, shape ``(n, d)``."""
        return ~torch.isnan(self.y + self.std)

    @property
    def is_exact(self) -> Tensor:
        """Of which pairs all parameters are known exactly, shape ``(n,)``."""
        return (self.is_measured & (self.std == 0)).all(dim=1)

    @property
    def are_exact(self) -> bool:
        """Whether all parameters of all pairs are known exactly."""
        return bool(self.is_exact.all())

    @property
    def label(self) -> Tensor:
        """A number for each label, the same for equal labels, shape ``(n,)``."""
        # NaN is not equal to itself.
        parts = [self.y.nan_to_num(), self.is_measured, self.std.nan_to_num()]
        if self.are_drawn:
            parts.append(self.theta.flatten(1))
        table = torch.cat([part.double() for part in parts], dim=1)
        return groups_of(table).to(self.y.device)

    @property
    def mean(self) -> Tensor:
        """The mean of the draws of each pair, shape ``(n, d)``."""
        return self.theta.double().mean(dim=1).to(self.theta)

    @property
    def num_groups(self) -> int:
        """The number of people or specimens."""
        return len(self.group.unique())

    @property
    def shared_weight(self) -> Tensor:
        """The weights of pairs whose group counts as one pair, shape ``(n,)``."""
        _, place, sizes = self.group.unique(return_inverse=True, return_counts=True)
        return self.weight / sizes[place]

    def folds(self, num_folds: int, *, seed: int | None = None) -> list[Tensor]:
        """Cut rows into folds of like size at random; a group is in one fold."""
        # scikit-learn's GroupKFold refuses fewer groups than folds, and its order of
        # groups of equal size depends on its version.
        groups = groups_of(self.group)
        sizes = torch.bincount(groups)
        with seeded(seed):
            order = torch.randperm(len(sizes))
        num_folds = min(num_folds, len(order))
        if len(order) == len(groups):
            folds = list(order.tensor_split(num_folds))
        else:
            fold_of, num_rows = torch.empty_like(order), [0] * num_folds
            # The largest first, each to the fold with the fewest rows so far.
            largest = sizes[order].argsort(descending=True, stable=True)
            for group in order[largest].tolist():
                fold = num_rows.index(min(num_rows))
                fold_of[group] = fold
                num_rows[fold] += int(sizes[group])
            rows = fold_of[groups]
            folds = [(rows == fold).nonzero()[:, 0] for fold in range(num_folds)]
        return [fold.to(self.group.device) for fold in folds]

    def __str__(self) -> str:
        """Say in one sentence what is known about the parameters."""
        text = f"{len(self)} {'exact ' if self.are_exact else ''}labels"
        if self.num_groups < len(self):
            text += f" in {self.num_groups} groups"
        if self.are_drawn:
            text += f", each given as {self.theta.shape[1]} draws"
        elif not self.are_exact:
            num_noisy = int((self.std > 0).any(dim=1).sum())
            num_partial = int((~self.is_measured).any(dim=1).sum())
            text += f", {num_noisy} with noise and {num_partial} partial"
        if (self.weight != 1).any():
            text += f", weighted like {effective_number(self.weight):.1f} of equal "
            text += f"weight, and counted as {float(self.weight.sum()):.3g}"
        return text


@dataclass(frozen=True, eq=False, kw_only=True)
class Nodes(Rows):
    r"""Parameters and weights that turn a density of theta into one of the label.

    .. math:: p(y_i \mid x_i) \approx \frac1S \sum_s u_{is}\, q(\theta_{is} \mid x_i)

    Attributes:
        theta: Shape ``(n, S, d)``, all inside the support of the prior.
        log_weights: :math:`\log u`, shape ``(n, S)``, float64. Minus infinity where
            theta was outside the support, and was replaced.
    """

    theta: Tensor
    log_weights: Tensor

    @classmethod
    def exact(cls, theta: Tensor) -> "Nodes":
        """Return the nodes of exact labels ``(n, d)``: the labels themselves."""
        log_weights = theta.new_zeros(len(theta), 1, dtype=torch.double)
        return cls(theta=theta[:, None], log_weights=log_weights)

    def log_mean(self, log_q: Tensor) -> Tensor:
        r"""Return the log density of each label, ``(n,)`` or ``(n, K)``.

        ``log_q`` is :math:`\log q(\theta_{is} \mid x_i)`, of K posteriors ``(n, S, K)``
        or of one ``(n, S)``.
        """
        weights = self.log_weights if log_q.ndim == 2 else self.log_weights[..., None]
        # Where the weight is zero, the density may be anything.
        terms = weights.where(torch.isneginf(weights), log_q.to(weights) + weights)
        return terms.logsumexp(dim=1) - math.log(terms.shape[1])


def groups_of(values: Tensor | Sequence[Hashable]) -> Tensor:
    """Number rows or names by first appearance, from 0; equal ones share a number.

    Shape ``(n,)``, on the CPU.
    """
    rows = values.tolist() if isinstance(values, Tensor) else values
    keys = [tuple(row) if isinstance(row, list) else row for row in rows]
    numbers = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return torch.tensor([numbers[key] for key in keys], dtype=torch.long)


def group_means(values: Tensor, weight: Tensor, group: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted means of the values of each group, and the weights of groups.

    Shapes ``(n, ...)``, ``(n,)`` and ``(n,)`` to ``(G, ...)`` and ``(G,)``.
    """
    numbers, place = group.to(values.device).unique(return_inverse=True)
    weight = weight.to(values)
    if len(numbers) == len(values):
        return values, weight
    total = weight.new_zeros(len(numbers)).index_add(0, place, weight)
    shares = (weight / total[place]).reshape(-1, *[1] * (values.ndim - 1))
    sums = values.new_zeros(len(numbers), *values.shape[1:])
    return sums.index_add(0, place, shares * values), total


def effective_number(weight: Tensor) -> float:
    r"""Return :math:`(\sum w)^2 / \sum w^2`, as many equal weights are as precise."""
    weight = weight.double()
    return float(weight.sum().square() / weight.square().sum())


def one_of_each_group(groups: Tensor, *, seed: int) -> Tensor:
    """Choose a row of each group at random, and tell whether each row was, ``(n,)``."""
    with seeded(seed):
        order = torch.randperm(len(groups)).flip(0).to(groups.device)
    # Of each group the last row in this order.
    first = dict(zip(groups[order].tolist(), order.tolist(), strict=True))
    chosen = torch.zeros_like(groups, dtype=torch.bool)
    chosen[list(first.values())] = True
    return chosen


def split_pairs(
    theta_or_groups: Tensor, validation_fraction: float
) -> tuple[Tensor, Tensor]:
    """Return the rows to train on and those held out, at random.

    Groups are held out as a whole, in random order, as long as they bring the number of
    rows nearer to the fraction asked for, or else the smallest. Of fewer than five
    groups none is held out.
    """
    groups = groups_of(theta_or_groups)
    sizes = torch.bincount(groups)
    order = torch.randperm(len(sizes))
    # Without shared parameters this is `order` itself.
    rows = order.argsort()[groups].argsort(stable=True)
    is_held_out = torch.zeros(len(sizes), dtype=torch.bool)
    if len(sizes) >= MIN_PAIRS_FOR_HOLDOUT:
        left = max(1, round(validation_fraction * len(groups)))
        for group, size in zip(order.tolist(), sizes[order].tolist(), strict=True):
            if size <= 2 * left:
                is_held_out[group] = True
                left -= size
        if is_held_out.all():
            is_held_out[order[-1]] = False
        if not is_held_out.any():
            is_held_out[order[sizes[order].argmin()]] = True
    held_out = is_held_out[groups[rows]]
    return rows[~held_out], rows[held_out]


def epochs_on_pairs(
    theta_or_groups: Tensor, held_out: Tensor, max_num_epochs: int
) -> int:
    """Return how many epochs to train on pairs for; few, and warn, without hold-out."""
    if len(held_out):
        return max_num_epochs
    count = int(groups_of(theta_or_groups).max()) + 1
    warn_user(
        f"Only {count} different parameters (or groups) among {len(theta_or_groups)} "
        "calibration pairs: none is held out, and tuning stops after at most "
        f"{EPOCHS_WITHOUT_HOLDOUT} epochs. Append at least {MIN_PAIRS_FOR_HOLDOUT} "
        "pairs of different parameters to choose the best net on a hold-out."
    )
    return min(max_num_epochs, EPOCHS_WITHOUT_HOLDOUT)


@contextmanager
def without_warning_of_few_pairs() -> Iterator[None]:
    """Train on some of the user's pairs, whose number the user did not choose."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Only .* none is held out", RoPEWarning)
        yield

"""Labels: the measured parameters of calibration pairs, and how well they are known."""

from collections.abc import Hashable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sbi_rope._groups import groups_of
from sbi_rope.errors import InvalidInputError

__all__ = ["Labels"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Labels:
    r"""Measured parameters, each exact, noisy or missing, or draws of all parameters.

    A label :math:`y` of a pair is a measurement of its parameters,

    .. math:: y_m \sim \mathcal N(\theta_m, R),

    for the parameters m that were measured. An exact label has R = 0. A label may also
    be given as draws from :math:`p(\theta \mid y)`, under the prior of NPE.

    Attributes:
        theta: The measured parameters, NaN where they were not measured, shape
            ``(n, d)``. Of a label given as draws, their mean.
        covariance: R of each label, float64, shape ``(n, d, d)``. Rows and columns of
            exact and of missing parameters are zero.
        weights: How many pairs each label counts as, shape ``(n,)``.
        samples: The draws of labels that were given as draws, shape ``(n, S, d)``; None
            otherwise.
        names: The name of the person or specimen of each label, n of them; None if
            equal labels are those of the same one.
    """

    theta: Tensor
    covariance: Tensor
    weights: Tensor
    samples: Tensor | None = None
    names: tuple[Hashable, ...] | None = None

    @classmethod
    def exact(cls, theta: Tensor) -> "Labels":
        """Return labels that are the true parameters, shape ``(n, d)``."""
        n, d = theta.shape
        return cls(
            theta=theta,
            covariance=theta.new_zeros(n, d, d, dtype=torch.double),
            weights=theta.new_ones(n, dtype=torch.double),
        )

    def __len__(self) -> int:
        return len(self.theta)

    def __getitem__(self, rows: Tensor) -> "Labels":
        return Labels(
            theta=self.theta[rows],
            covariance=self.covariance[rows],
            weights=self.weights[rows],
            samples=None if self.samples is None else self.samples[rows],
            names=None if self.names is None else _of_rows(self.names, rows),
        )

    def appended(self, others: "Labels") -> "Labels":
        """Return these labels followed by others of the same kind.

        Raises:
            InvalidInputError: If some are given as draws and others are not, the
                numbers of draws differ, or some have names and others do not.
        """
        counts = [
            0 if labels.samples is None else labels.samples.shape[1]
            for labels in (self, others)
        ]
        if counts[0] != counts[1]:
            raise InvalidInputError(
                "Expected labels with as many draws as those appended before, "
                f"{counts[0]}; got {counts[1]}."
            )
        if (self.names is None) != (others.names is None):
            raise InvalidInputError(
                "Expected `groups` of all calibration pairs, or of none; got some."
            )
        samples, names = self.samples, self.names
        if samples is not None and others.samples is not None:
            samples = torch.cat([samples, others.samples])
        if names is not None and others.names is not None:
            names = names + others.names
        return Labels(
            theta=torch.cat([self.theta, others.theta]),
            covariance=torch.cat([self.covariance, others.covariance]),
            weights=torch.cat([self.weights, others.weights]),
            samples=samples,
            names=names,
        )

    def weighted(self, weights: Tensor) -> "Labels":
        """Return the same labels with other weights, shape ``(n,)``."""
        return replace(self, weights=weights)

    def named(self, names: tuple[Hashable, ...]) -> "Labels":
        """Return the same labels with the names of n people or specimens."""
        return replace(self, names=names)

    @property
    def is_measured(self) -> Tensor:
        """Which parameters were measured, exactly or with noise, shape ``(n, d)``."""
        return ~torch.isnan(self.theta)

    @property
    def is_noisy(self) -> Tensor:
        """Which parameters were measured with noise, shape ``(n, d)``."""
        return self.covariance.diagonal(dim1=1, dim2=2) > 0

    @property
    def says_something(self) -> Tensor:
        """Which labels measure at least one parameter, shape ``(n,)``."""
        return self.is_measured.any(dim=1)

    @property
    def is_exact(self) -> Tensor:
        """Which labels know all parameters exactly, shape ``(n,)``."""
        if self.samples is not None:
            return torch.zeros_like(self.says_something)
        return (self.is_measured & ~self.is_noisy).all(dim=1)

    @property
    def are_exact(self) -> bool:
        """Whether all parameters of all labels are known exactly."""
        return bool(self.is_exact.all()) and self.samples is None

    @property
    def are_weighted(self) -> bool:
        """Whether some labels count as another number of pairs than one."""
        return bool((self.weights != 1).any())

    @property
    def pair_weights(self) -> Tensor | None:
        """The weights, shape ``(n,)``; None if all labels count as one pair."""
        return self.weights if self.are_weighted else None

    @property
    def are_simple(self) -> bool:
        """Whether all labels are exact and count as one pair."""
        return self.are_exact and not self.are_weighted

    @property
    def effective_number(self) -> float:
        r"""The number of labels of equal weight with the same precision.

        .. math:: \Bigl(\sum_i w_i\Bigr)^2 \Big/ \sum_i w_i^2
        """
        if not len(self):
            return 0.0
        return float(self.weights.sum().square() / self.weights.square().sum())

    @property
    def groups(self) -> Tensor:
        """A number for each label, shape ``(n,)``, the same for the same specimen.

        Where there are no names, these are equal labels.
        """
        if self.names is not None:
            numbers = {name: k for k, name in enumerate(dict.fromkeys(self.names))}
            of_rows = [numbers[name] for name in self.names]
            return torch.tensor(of_rows, dtype=torch.long)
        if self.are_exact:
            return groups_of(self.theta)
        # NaN is not equal to itself, and the covariance tells labels apart, too.
        known = [self.theta.double().nan_to_num(), self.is_measured.double()]
        known.append(self.covariance.flatten(1))
        if self.samples is not None:
            known.append(self.samples.double().flatten(1))
        return groups_of(torch.cat(known, dim=1))

    @property
    def num_groups(self) -> int:
        """The number of people or specimens."""
        return len(self.groups.unique())

    @property
    def shared_groups(self) -> Tensor | None:
        """The groups, on the device of the labels; None if no two labels share one."""
        if self.num_groups == len(self):
            return None
        return self.groups.to(self.theta.device)

    @property
    def score_weights(self) -> Tensor | None:
        """How many pairs each counts as where it is scored; None if all are one.

        Labels of one person or specimen share the weight of one.
        """
        if (groups := self.shared_groups) is None:
            return self.pair_weights
        sizes = groups.bincount()[groups]
        return self.weights / sizes.to(self.weights)

    @property
    def parameter_weights(self) -> Tensor | None:
        """How many draws of parameters each counts as; None if all are one.

        Equal parameters are then one draw, unless people were named who have them.
        """
        weights = self.score_weights
        if weights is None and self.names is not None:
            return self.weights
        return weights

    @property
    def vary_within_groups(self) -> bool:
        """Whether some person or specimen has labels that differ."""
        if self.names is None:
            return False
        numbers = torch.stack([self.groups, replace(self, names=None).groups], dim=1)
        return bool(groups_of(numbers).max() > self.groups.max())

    def __str__(self) -> str:
        """Say in one sentence what is known about the parameters."""
        text = f"{len(self)} exact labels" if self.are_exact else f"{len(self)} labels"
        if (num_groups := self.num_groups) < len(self):
            text += f" in {num_groups} groups"
        if self.samples is not None:
            text += f", each given as {self.samples.shape[1]} draws"
        elif not self.are_exact:
            num_noisy = int(self.is_noisy.any(dim=1).sum())
            num_partial = int((~self.is_measured).any(dim=1).sum())
            text += f", {num_noisy} with noise and {num_partial} partial"
        if self.are_weighted:
            text += (
                f", weighted like {self.effective_number:.1f} of equal weight, and "
                f"counted as {float(self.weights.sum()):.3g}"
            )
        return text


def _of_rows(names: tuple[Hashable, ...], rows: Tensor) -> tuple[Hashable, ...]:
    numbers = torch.arange(len(names))[rows.cpu()]
    return tuple(names[number] for number in numbers.tolist())

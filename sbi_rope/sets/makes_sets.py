"""The part of a posterior that makes sets and intervals."""

import math
from abc import ABC, abstractmethod
from dataclasses import replace
from functools import partial
from typing import Annotated, Any

import torch
from torch import Tensor

from sbi_rope._prior import PriorDistribution
from sbi_rope._random import seeded
from sbi_rope.errors import InvalidInputError
from sbi_rope.sets.conformal import DIGITS
from sbi_rope.sets.credible import (
    CredibleIntervals,
    CredibleSet,
    central_intervals,
    highest_density_set,
)
from sbi_rope.settings import Level, Range, check

__all__ = ["MakesSets"]

# So many draws are held at a time.
MAX_DRAWS = 2**20


class MakesSets(ABC):
    """What a posterior inherits to make sets and intervals.

    Posteriors of stacks also make those with a guarantee. They override
    ``_held_out_sets`` for it.
    """

    prior: PriorDistribution
    # One name for each parameter, where they have names.
    parameter_names: tuple[str, ...] | None = None
    # The names of the columns of tables of x, which are put in this order.
    x_names: tuple[str, ...] | None = None

    def credible_set(
        self,
        level: float = 0.9,
        x: Tensor | None = None,
        *,
        guaranteed: bool = False,
        num_samples: int = 1000,
        seed: int | None = None,
    ) -> CredibleSet:
        r"""Return a set that is credible given one observation.

        It is the set of highest density,
        :math:`\{\theta: \log p(\theta \mid x) \ge t\}`, with t the (1 - level)
        quantile of the log density of draws. It holds the true parameters this often
        only if the posterior is calibrated. With ``guaranteed``, a stack corrects it by
        its held-out scores, and :class:`~sbi_rope.sets.Guarantee` says what is
        promised.

        Args:
            level: The probability of the set.
            x: An observation, from the batch if there is one; the default x if None.
            guaranteed: Whether the set shall hold the true parameters in about
                ``level`` of the cases, even if the posterior is not calibrated. This
                needs a stack, and observations drawn as its calibration pairs.
            num_samples: The number of draws that the set and its volume are estimated
                from, one of which has to be outside at least.
            seed: Seed of the draws; None uses the states of torch, NumPy and Python.

        Returns:
            The set, which tells its volume and which parameters it contains.

        Raises:
            InvalidInputError: If x is not in the batch and ``unseen="raise"``. With
                ``guaranteed``, also if this is no stack, or if it has too few pairs for
                the level.
        """
        _check(level, guaranteed=guaranteed, num_samples=num_samples, num_ends=1)
        with seeded(seed):
            x = self._one_x(x)
            if guaranteed:
                found = self._held_out_sets().credible_set(level, x, num_samples)
            else:
                found = highest_density_set(
                    self, x, level=level, num_samples=num_samples
                )
        return replace(found, parameter_names=self.parameter_names)

    def credible_intervals(
        self,
        level: float = 0.9,
        x: Tensor | None = None,
        *,
        guaranteed: bool = False,
        num_samples: int = 1000,
        seed: int | None = None,
    ) -> CredibleIntervals:
        """Return an interval for each parameter given one observation.

        It is the central interval of draws. With ``guaranteed``, a stack corrects it by
        its held-out scores. The level is that of each interval by itself.

        Args:
            level: The probability of each interval.
            x: As in :meth:`credible_set`.
            guaranteed: As in :meth:`credible_set`.
            num_samples: The number of draws, one of which has to be beyond each end at
                least. With ``guaranteed`` there are as many as the stack was scored
                with.
            seed: As in :meth:`credible_set`.

        Returns:
            The intervals, with ends of shape ``(d,)``.
        """
        intervals = self.credible_intervals_batched(
            level,
            self._one_x(x),
            guaranteed=guaranteed,
            num_samples=num_samples,
            seed=seed,
        )
        return intervals[0]

    def credible_intervals_batched(
        self,
        level: float,
        x: Tensor,
        *,
        guaranteed: bool = False,
        num_samples: int = 1000,
        seed: int | None = None,
    ) -> CredibleIntervals:
        """Return an interval for each parameter given each observation of a batch.

        Args:
            level: The probability of each interval.
            x: Observations, shape ``(B, *event)``.
            guaranteed: As in :meth:`credible_set`.
            num_samples: As in :meth:`credible_intervals`.
            seed: As in :meth:`credible_set`.

        Returns:
            The intervals, with ends of shape ``(B, d)``.
        """
        _check(level, guaranteed=guaranteed, num_samples=num_samples, num_ends=2)
        with seeded(seed):
            make = partial(central_intervals, self, num_samples=num_samples)
            if guaranteed:
                make = self._held_out_sets().credible_intervals
            blocks = self._batch_of_x(x).split(max(1, MAX_DRAWS // num_samples))
            parts = [make(level, block) for block in blocks]
        return replace(
            parts[0],
            low=torch.cat([part.low for part in parts]),
            high=torch.cat([part.high for part in parts]),
            parameter_names=self.parameter_names,
        )

    def _held_out_sets(self) -> Any:
        """Return what makes sets with a guarantee. Only a stack has it."""
        raise InvalidInputError(
            "Expected a stack for a set with a guarantee; got "
            f"{type(self).__name__}. Make one with `stack(rope)`."
        )

    @abstractmethod
    def _one_x(self, x: Tensor | None) -> Tensor:
        """Return an observation ``(1, *event)``, the default one if None."""

    @abstractmethod
    def _batch_of_x(self, x: Tensor) -> Tensor:
        """Return observations ``(B, *event)`` after a check."""


def _check(level: Any, *, guaranteed: Any, num_samples: Any, num_ends: int) -> None:
    """Check the arguments of a set, or of an interval, which has two ends."""
    check("level", level, Level)
    check("guaranteed", guaranteed, bool)
    check("num_samples", num_samples, Annotated[int, Range(2)])
    needed = math.ceil(round(num_ends / (1 - level), DIGITS))
    if num_samples < needed and not guaranteed:
        raise InvalidInputError(
            f"Expected `num_samples` of at least {needed} for a level of {level:g}, so "
            f"that a draw is beyond each end; got {num_samples}."
        )

"""A set of parameters that are credible given one observation."""

import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from sbi_rope.sets.conformal import DIGITS
from sbi_rope.sets.guarantee import Guarantee
from sbi_rope.tensors import as_batch, as_numbers

__all__ = ["CredibleSet", "HighestDensity", "Rule", "highest_density_set", "volume_of"]


class Rule(Protocol):
    """Tells which parameters are in a set."""

    def contains(self, theta: Tensor) -> Tensor:
        """Return whether parameters ``(n, d)`` are in the set, shape ``(n,)``."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class CredibleSet:
    r"""A set of parameters that are credible given one observation.

    ``posterior.credible_set`` makes it. Without a guarantee it is the set of highest
    density, :math:`\{\theta: \log p(\theta \mid x) \ge t\}`, with a probability of
    ``level`` under the posterior. It holds the true parameters this often only
    if the posterior is calibrated. A set with a guarantee is described in
    :class:`~sbi_rope.sets.Guarantee`.

    Attributes:
        level: The level that was asked for.
        volume: The volume, in the units of the parameters.
        volume_error: The Monte-Carlo standard error of ``volume``.
        volume_z: The volume in standard deviations of the prior,
            :math:`V / \prod_j s_j`. NaN if the prior has none.
        guarantee: The guarantee; None if there is none.
        draws: The parameters that the volume was estimated from, shape ``(m, d)``.
        inside: Which of the draws are in the set, shape ``(m,)``.
        rule: What tells which parameters are in the set.
        parameter_names: One name for each parameter; None if they have none.
    """

    level: float
    volume: float
    volume_error: float
    volume_z: float
    guarantee: Guarantee | None
    draws: Tensor = field(repr=False)
    inside: Tensor = field(repr=False)
    rule: Rule = field(repr=False)
    parameter_names: tuple[str, ...] | None = None

    @classmethod
    def of(
        cls,
        rule: Rule,
        draws: Tensor,
        log_density: Tensor,
        *,
        level: float,
        log_unit: float,
        guarantee: Guarantee | None = None,
    ) -> "CredibleSet":
        """Measure the set of a rule.

        Args:
            rule: What tells which parameters are in the set.
            draws: Draws that reach all of the set, shape ``(m, d)``.
            log_density: The log density that they were drawn from, shape ``(m,)``.
            level: The level that was asked for.
            log_unit: The sum of the logs of the prior's standard deviations.
            guarantee: The guarantee; None if there is none.
        """
        inside = rule.contains(draws)
        volume, error = volume_of(inside, log_density)
        return cls(
            level=level,
            volume=volume,
            volume_error=error,
            volume_z=volume * math.exp(-log_unit),
            guarantee=guarantee,
            draws=draws,
            inside=inside,
            rule=rule,
        )

    @property
    def is_guaranteed(self) -> bool:
        """Whether there is a guarantee."""
        return self.guarantee is not None

    @torch.no_grad()
    def contains(self, theta: Tensor) -> Tensor:
        """Tell which parameters are in the set.

        Args:
            theta: Parameters, shape ``(*batch, d)``.

        Returns:
            Shape ``(*batch)``, bool.

        Raises:
            InvalidInputError: If theta has another shape, or is not finite.
        """
        theta = as_numbers("theta", theta, names=self.parameter_names)
        shape = theta.shape[:-1]
        rows = theta[None] if theta.ndim < 2 else theta.flatten(0, -2)
        rows = as_batch("theta", rows, self.draws.shape[1:]).to(self.draws)
        return self.rule.contains(rows).reshape(shape)

    def __str__(self) -> str:
        count = self.draws.shape[1]
        unit = (
            ""
            if math.isnan(self.volume_z)
            else f", or {self.volume_z:.3g} with theta in standard deviations of the "
            "prior"
        )
        promise = self.guarantee or (
            "It has no guarantee: it holds the true parameters this often only if the "
            "posterior is calibrated."
        )
        return (
            f"The {100 * self.level:.4g} % set of {count} "
            f"parameter{'s' * (count > 1)} has a volume of {self.volume:.3g} +- "
            f"{self.volume_error:.1g}{unit}.\n{promise}"
        )

    __repr__ = __str__  # which notebooks show


@dataclass(frozen=True, eq=False, kw_only=True)
class HighestDensity:
    """The parameters whose density is at least a threshold.

    Attributes:
        posterior: The posterior.
        x: The observation.
        threshold: The smallest log density in the set.
    """

    posterior: Any
    x: Tensor
    threshold: float

    def contains(self, theta: Tensor) -> Tensor:
        """Return whether parameters ``(n, d)`` are in the set, shape ``(n,)``."""
        return self.posterior.log_prob(theta, x=self.x) >= self.threshold


@torch.no_grad()
def highest_density_set(
    posterior: Any, x: Tensor, *, level: float, num_samples: int, log_unit: float
) -> CredibleSet:
    r"""Return the set of highest density given one observation.

    Its threshold is the (1 - level) quantile of the log density of the draws. The
    volume is estimated from the same draws, each of which counts
    :math:`1 / p(\theta \mid x)` if it is in the set. This is at most
    :math:`e^{-t}`, so that the variance is finite.

    Args:
        posterior: A posterior with ``sample`` and ``log_prob``.
        x: The observation.
        level: The probability of the set under the posterior.
        num_samples: The number of draws.
        log_unit: The sum of the logs of the prior's standard deviations.
    """
    draws = posterior.sample((num_samples,), x=x, show_progress_bars=False)
    log_prob = posterior.log_prob(draws, x=x)
    left_out = math.floor(round((1 - level) * num_samples, DIGITS))
    threshold = log_prob.sort().values[left_out]
    return CredibleSet.of(
        HighestDensity(posterior=posterior, x=x, threshold=float(threshold)),
        draws,
        log_prob,
        level=level,
        log_unit=log_unit,
    )


def volume_of(inside: Tensor, log_density: Tensor) -> tuple[float, float]:
    r"""Return the volume of a set and its standard error.

    .. math:: V = \frac1M \sum_m \frac{\mathbf{1}[\theta_m \in A]}{q(\theta_m)}

    Args:
        inside: Which of M draws of q are in the set A, shape ``(M,)``.
        log_density: :math:`\log q` at the draws, shape ``(M,)``.

    Example:
        >>> volume_of(torch.tensor([True, True]), torch.tensor([0.0, 0.0]))
        (1.0, 0.0)
    """
    terms = torch.where(inside, torch.exp(-log_density.double()), 0.0)
    return float(terms.mean()), float(terms.std() / len(terms) ** 0.5)

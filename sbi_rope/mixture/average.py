"""The average of posteriors, such as those repaired from the members of an ensemble."""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from sbi.utils import within_support

from sbi_rope._random import seeded
from sbi_rope._sbi import estimator_of
from sbi_rope._validation import check_weights, columns_of, joined_columns
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture.estimator import MixtureEstimator
from sbi_rope.mixture.parts import part_of
from sbi_rope.mixture.posterior import MixturePosterior

__all__ = ["average"]

# Draws of the first prior, at which the others must have the same density.
NUM_FROM_PRIOR = 100


def average(
    posteriors: Sequence[Any], *, weights: Sequence[float] | None = None
) -> MixturePosterior:
    r"""Return the weighted average of posteriors that belong to the same prior.

    .. math::
        p(\theta \mid x) \propto \mathbf{1}[\theta \in \operatorname{supp} p]
        \sum_m w_m\, q_m(\theta \mid x)

    An ensemble of NPEs is repaired in this way: every member is repaired by itself,
    because each has an embedding net of its own. The average is normalised as a whole,
    so that a member with much of its mass outside the prior counts for less.

    Args:
        posteriors: What ``stack``, ``RoPE.build_posterior`` or a trainer returns, or
            posteriors of NPE. They are copied. Those that belong to a batch have to
            belong to the same batch.
        weights: One for each posterior, with a sum of one; equal if None.

    Returns:
        The average. It belongs to a batch if one of the posteriors does.

    Raises:
        InvalidInputError: If it is no list of posteriors.
        InvalidInputError: If there is no posterior, shapes, batches or priors differ,
            two know the columns of tables in different orders, or the weights do not
            fit.
        UnsupportedPosteriorError: If one of them has no density or no embedding of x,
            or is a recalibrated stack.

    Example:
        >>> import torch
        >>> from sbi.inference import NPE
        >>> from sbi.utils import BoxUniform
        >>> _ = torch.manual_seed(0)
        >>> prior = BoxUniform(torch.zeros(1), torch.ones(1))
        >>> members = []
        >>> for _ in range(2):
        ...     npe = NPE(prior, density_estimator="mdn", show_progress_bars=False)
        ...     theta = prior.sample((100,))
        ...     npe = npe.append_simulations(theta, theta + torch.randn(100, 1))
        ...     _ = npe.train(max_num_epochs=1)
        ...     members.append(npe.build_posterior())
        >>> posterior = average(members, weights=[0.3, 0.7])
        >>> posterior.sample((5,), x=torch.ones(1)).shape
        torch.Size([5, 1])
    """
    if not isinstance(posteriors, list | tuple):
        raise InvalidInputError(
            "Expected `posteriors` to be a list of posteriors; got "
            f"{type(posteriors).__name__}."
        )
    if not len(posteriors):
        raise InvalidInputError("Expected at least one of `posteriors`; got none.")
    if weights is None:
        weights = [1.0 / len(posteriors)] * len(posteriors)
    shares = check_weights("weights", weights, len(posteriors))
    estimators = [_mixture_of(posterior) for posterior in posteriors]
    parts, of_parts = [], []
    for share, estimator in zip(shares, estimators, strict=True):
        own, own_weights = estimator.taken_apart()
        parts += own
        of_parts += [share * weight for weight in own_weights]
    mixture = MixtureEstimator(
        parts,
        of_parts,
        tail_mass=min(estimator.tail_mass for estimator in estimators),
    )
    _check_same_prior([posterior.prior for posterior in posteriors])
    first = posteriors[0]
    averaged = MixturePosterior(
        mixture, copy.deepcopy(first.prior), enable_transform=first.enable_transform
    )
    averaged.parameter_names = _common_names(posteriors)
    known = [columns_of(posterior) for posterior in posteriors]
    averaged.columns = {
        name: joined_columns(name, [columns[name] for columns in known])
        for name in ("theta", "x")
    }
    return averaged


def _check_same_prior(priors: Sequence[Any]) -> None:
    """Raise if draws of the first prior have another density under another."""
    with seeded(0):
        theta = priors[0].sample(torch.Size((NUM_FROM_PRIOR,)))
    for number, prior in enumerate(priors[1:], start=1):
        # Outside its support a prior of torch has no density, but an error.
        if not bool(within_support(prior, theta).all()) or not torch.allclose(
            prior.log_prob(theta), priors[0].log_prob(theta), atol=1e-3
        ):
            raise InvalidInputError(
                "Expected `posteriors` with the same prior; got another prior in "
                f"posteriors[{number}] than in posteriors[0]. Train all of them with "
                "one prior."
            )


def _common_names(posteriors: Sequence[Any]) -> tuple[str, ...] | None:
    """Return the names of the parameters if all posteriors have the same."""
    first, *others = (getattr(one, "parameter_names", None) for one in posteriors)
    return first if all(names == first for names in others) else None


def _mixture_of(posterior: Any) -> MixtureEstimator:
    """Return the mixture of a posterior, which may have a single part."""
    if isinstance(posterior, MixturePosterior):
        return posterior.posterior_estimator
    return MixtureEstimator([part_of(estimator_of(posterior))], [1.0])

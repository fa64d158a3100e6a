"""Targets of the tuning where labels leave parameters open."""

from torch import Tensor

from sbi_rope._random import seeded
from sbi_rope._standardisation import Standardisation
from sbi_rope.discrepancy.correction import fit_discrepancy
from sbi_rope.discrepancy.imputation import expected_means
from sbi_rope.discrepancy.model import DiscrepancyModel
from sbi_rope.moments import Moments

__all__ = ["tuning_targets"]


def tuning_targets(
    z: Tensor,
    moments: Moments,
    standardisation: Standardisation,
    *,
    weights: Tensor | None = None,
    groups: Tensor | None = None,
    seed: int | None = None,
) -> Tensor:
    r"""Return the targets of the tuning, :math:`E[h(S(\theta_i)) \mid y_i, x_i]`.

    A label y that leaves parameters open leaves open the target, too. Its average under
    the prior would not do: a net that is tuned to it learns to forget what x says about
    these parameters. The average is therefore also given x, under the discrepancy model
    that is fitted to these pairs.

    Args:
        z: The embeddings of the real observations by h, shape ``(n, l)``.
        moments: The moments of simulations at the parameters of the pairs, with means
            that are possible.
        standardisation: The mean and standard deviation of embeddings over simulations
            from the prior.
        weights: How many pairs each pair counts as, shape ``(n,)``; one if None.
        groups: A number for each pair, the same for recordings of one person.
        seed: Seed of the averages over the discrepancy; None uses torch's state.

    Returns:
        Shape ``(n, l)``, in the dtype of z.
    """
    discrepancy = fit_discrepancy(
        z, moments, standardisation, DiscrepancyModel(), weights=weights, groups=groups
    )
    with seeded(seed):
        means = expected_means(
            discrepancy, standardisation(z.double()), standardisation(moments.means)
        )
    return standardisation.undo(means).to(z)

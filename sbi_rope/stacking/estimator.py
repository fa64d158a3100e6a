"""The density of a stack: the merged couplings, and densities of x itself."""

from collections.abc import Sequence

import torch
from torch import Tensor
from tqdm.auto import tqdm

from sbi_rope.mixture import CoupledContexts, MixtureEstimator, Part
from sbi_rope.mixture.chunks import flow_slices
from sbi_rope.mixture.density import without_nan

__all__ = ["StackedEstimator"]


class StackedEstimator(MixtureEstimator):
    r"""The density :math:`\sum_k w_k\, q_k(\theta \mid x_o)` given x_o.

    Args:
        coupled: A part mixed over the couplings, which are candidates each.
        others: Densities of x itself, such as the prior and NPE.
        candidate_weights: Of each coupling, then of each other; they sum to one.
        tail_mass: As in :class:`~sbi_rope.mixture.MixtureEstimator`.
    """

    candidate_weights: Tensor

    def __init__(
        self,
        coupled: Part,
        others: Sequence[Part],
        candidate_weights: Tensor,
        *,
        tail_mass: float = 1e-3,
    ) -> None:
        mixing = coupled.mixing
        assert isinstance(mixing, CoupledContexts)
        count = len(mixing.couplings)
        total = candidate_weights[:count].sum()
        # Without any weight their shares do not matter.
        shares = torch.full_like(candidate_weights[:count], 1 / count)
        if total:
            shares = candidate_weights[:count] / total
        super().__init__(
            [Part(coupled.density, mixing.with_shares(shares.tolist())), *others],
            torch.cat([total[None], candidate_weights[count:]]),
            tail_mass=tail_mass,
        )
        self.register_buffer("candidate_weights", candidate_weights)

    def with_weights(self, weights: Tensor) -> "StackedEstimator":
        """Return a stack of the same candidates with other weights."""
        coupled, *others = self.parts
        return StackedEstimator(coupled, others, weights, tail_mass=self.tail_mass)

    def restricted_to(self, index: int) -> "StackedEstimator":
        """Return the same stack for one observation of the batch."""
        coupled, *others = super().restricted_to(index).parts
        return StackedEstimator(
            coupled, others, self.candidate_weights, tail_mass=self.tail_mass
        )

    @torch.no_grad()
    def candidate_log_probs(
        self,
        theta: Tensor,
        x: Tensor,
        *,
        log_q: Tensor | None = None,
        component_mass: Tensor | None = None,
    ) -> Tensor:
        """Return the log density of each candidate by itself at pairs.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations, shape ``(n, *event)``.
            log_q: What :meth:`component_log_probs` returns for theta, if it is known.
            component_mass: The mass of each component inside the support of the prior,
                shape ``(n_s,)``; without it couplings are not normalised either.

        Returns:
            Shape ``(n, K)``, float64: couplings first, then the others, which are not
            corrected for leakage.
        """
        if log_q is None:
            log_q = self.component_log_probs(theta)
        coupled = self.coupled[0]
        scores = []
        for rows in coupled.rows_of_each(coupled.features(x)):
            score = torch.logsumexp(rows.log() + log_q, dim=1)
            if component_mass is not None:
                score = score - (rows.to(component_mass) @ component_mass).log()
            scores.append(score.double())
        others = self.part_log_probs(theta, x, numbers=range(1, len(self.parts)))
        return torch.cat([torch.stack(scores, dim=1), others], dim=1)

    @torch.no_grad()
    def component_log_probs(
        self, theta: Tensor, *, show_progress_bars: bool = False
    ) -> Tensor:
        r"""Return :math:`\log q(\theta_i \mid h(x_{s,j}))`.

        Args:
            theta: Parameters, shape ``(n, d)``.
            show_progress_bars: Whether to show progress.

        Returns:
            Shape ``(n, n_s)``.
        """
        part, contexts = self.parts[0], self.coupled[0].simulated
        n, n_s = len(theta), len(contexts)
        pairs = flow_slices(n * n_s, theta.device)
        index = torch.arange(n * n_s, device=theta.device)
        log_q = [
            part.log_prob(theta[index[block] // n_s], contexts[index[block] % n_s])
            for block in tqdm(pairs, desc="Scoring", disable=not show_progress_bars)
        ]
        return without_nan(torch.cat(log_q)).reshape(n, n_s)

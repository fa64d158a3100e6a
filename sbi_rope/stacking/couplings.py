"""RoPE at many settings and in all versions, as one part of a mixture."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, cast

import torch
from torch import Tensor, nn

from sbi_rope._random import seeded
from sbi_rope._sbi import embed, estimator_of, headless
from sbi_rope.coupling import Coupling
from sbi_rope.coupling.coupler import without_warning_of_small_batch
from sbi_rope.errors import CouplingError
from sbi_rope.mixture import CoupledEmbeddings, Part
from sbi_rope.mixture.chunks import flow_batch
from sbi_rope.mixture.density import without_nan
from sbi_rope.rope import MIN_SIMULATIONS, RoPE
from sbi_rope.stacking.candidates import CouplingCandidate
from sbi_rope.stacking.folds import Fold

__all__ = ["FittedCouplings", "fit_couplings"]

# Which net embeds real observations: whether it is tuned, with which rehearsal, and in
# which version. The version is None for h, which all versions share.
Net = tuple[bool, float | None, int | None]


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedCouplings:
    """Couplings of one batch at all settings and in all versions, as one part.

    Attributes:
        part: The part; the couplings have equal shares.
        settings: For each coupling, in the order of the part, the name of the candidate
            and the version it belongs to. The version is None if it belongs to all.
    """

    part: Part
    settings: tuple[tuple[str, int | None], ...]

    @property
    def embeddings(self) -> CoupledEmbeddings:
        """The embeddings that the part is a mixture over."""
        return cast("CoupledEmbeddings", self.part.mixing)

    def weighted(
        self, weights: Mapping[str, float], versions: Sequence[int]
    ) -> tuple[Part, float]:
        """Return the part of some versions, and its weight.

        Args:
            weights: The weight of each candidate, by name.
            versions: The numbers of the versions; they have equal weights.
        """
        shares = []
        for name, version in self.settings:
            if version is None:
                shares.append(weights[name])
            else:
                used = version in versions
                shares.append(weights[name] / len(versions) if used else 0.0)
        total = sum(shares)
        if not total:
            return self.part, 0.0
        embeddings = self.embeddings.with_shares([share / total for share in shares])
        return Part(self.part.density, embeddings), total

    @torch.no_grad()
    def log_probs(
        self, theta: Tensor, x: Tensor, *, log_q: Tensor | None = None
    ) -> Tensor:
        """Return the log density of each coupling by itself at pairs.

        Args:
            theta: Parameters, shape ``(n, d)``.
            x: Their observations in the batch, shape ``(n, *event)``.
            log_q: What :meth:`component_log_probs` returns for theta; it is computed
                if None.

        Returns:
            Shape ``(n, number of couplings)``, float64. It is not normalised inside
            the support of the prior.
        """
        log_q = self.component_log_probs(theta) if log_q is None else log_q
        rows_of_each = self.embeddings.rows_of_each(self.embeddings.embed(x))
        return torch.stack(
            [torch.logsumexp(rows.log() + log_q, dim=1) for rows in rows_of_each], dim=1
        ).double()

    @torch.no_grad()
    def node_log_probs(self, theta: Tensor, x: Tensor) -> Tensor:
        """Return the log density of each coupling at several parameters of each pair.

        Args:
            theta: S parameters of each pair, shape ``(n, S, d)``.
            x: Their observations in the batch, shape ``(n, *event)``.

        Returns:
            Shape ``(n, S, number of couplings)``, float64.
        """
        of_each = []
        for of_one, one in zip(theta, x, strict=True):
            log_q = self.component_log_probs(of_one)
            rows_of_each = self.embeddings.rows_of_each(
                self.embeddings.embed(one[None])
            )
            of_each.append(
                torch.stack(
                    [
                        torch.logsumexp(rows.log() + log_q, dim=1)
                        for rows in rows_of_each
                    ],
                    dim=1,
                )
            )
        return torch.stack(of_each).double()

    @torch.no_grad()
    def component_log_probs(self, theta: Tensor) -> Tensor:
        r"""Return :math:`\log q(\theta_i \mid h(x_{s,j}))`, shape ``(n, n_s)``."""
        embeddings = self.embeddings.simulated
        n, n_s = len(theta), len(embeddings)
        pairs = torch.arange(n * n_s, device=theta.device)
        log_q = [
            self.part.log_prob(theta[batch // n_s], embeddings[batch % n_s])
            for batch in pairs.split(flow_batch(theta.device))
        ]
        return without_nan(torch.cat(log_q)).reshape(n, n_s)


def fit_couplings(
    candidates: Sequence[CouplingCandidate],
    versions: Sequence[Fold],
    x_o: Tensor,
    *,
    num_simulations: int | None,
    seed: int,
    unseen: Literal["raise", "extend"],
    require_convergence: bool,
    show_progress_bars: bool,
) -> FittedCouplings:
    """Couple a batch, together with the observations of the pairs, at all settings.

    The observations to be inferred and those of the pairs are coupled together, so that
    the scores of the pairs hold for the batch.

    Args:
        candidates: The settings.
        versions: The folds that each version may learn from.
        x_o: The batch, shape ``(n_o, *event)``.
        num_simulations: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        seed: Seed of the simulations.
        unseen: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        require_convergence: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        show_progress_bars: Whether to show the progress of slow simulations.

    Raises:
        CouplingError: If a coupling has not converged, and ``require_convergence``.
    """
    bench = versions[0].bench
    # The same number of simulations as RoPE would couple the batch with.
    with seeded(seed):
        _, simulated = bench.rope.source.from_prior(
            num_simulations,
            max(len(x_o), MIN_SIMULATIONS),
            lambda x: embed(bench.embedding_net, x),
            progress=show_progress_bars,
        )
    batch = torch.cat([x_o, bench.x])
    nets, settings = [], []
    for key, net in _nets(candidates, versions).items():
        of_net = [c for c in candidates if (c.tuned, c.rehearsal) == key[:2]]
        couplings = _couple(of_net, embed(net, batch), simulated, bench.rope)
        share = 1.0 / len(couplings)
        nets.append(CoupledNet(net, couplings, [share] * len(couplings)))
        settings += [(candidate.name, key[2]) for candidate in of_net]
    if require_convergence:
        _check_converged([c for net in nets for c in net.couplings], settings)
    # The coupler has converted the simulations for each net. All couplings get the same
    # tensor, so that memory and pickles hold it once.
    kept = nets[0].couplings[0].simulated
    nets = [
        CoupledNet(
            net.net,
            [replace(coupling, simulated=kept) for coupling in net.couplings],
            [share / len(nets) for share in net.shares],
        )
        for net in nets
    ]
    embeddings = CoupledEmbeddings(
        simulated, batch, nets, num_observed=len(x_o), unseen=unseen
    )
    return FittedCouplings(
        part=Part(headless(estimator_of(bench.npe)), embeddings),
        settings=tuple(settings),
    )


def _nets(
    candidates: Sequence[CouplingCandidate], versions: Sequence[Fold]
) -> dict[Net, nn.Module]:
    nets: dict[Net, nn.Module] = {}
    for tuned, rehearsal in dict.fromkeys((c.tuned, c.rehearsal) for c in candidates):
        if not tuned:
            nets[tuned, rehearsal, None] = versions[0].bench.embedding_net
            continue
        for number, fold in enumerate(versions):
            nets[tuned, rehearsal, number] = _tuned_net(fold, rehearsal)
    return nets


def _tuned_net(fold: Fold, rehearsal: float | None) -> nn.Module:
    finetuner = fold.rope.finetuner
    if rehearsal in (None, finetuner.rehearsal):
        return fold.rope.tuned_embedding_net
    other = fold.tuned(replace(finetuner, rehearsal=rehearsal))
    return other.tuned_embedding_net


def _couple(
    candidates: Sequence[CouplingCandidate],
    real: Tensor,
    simulated: Tensor,
    rope: RoPE,
) -> list[Coupling]:
    """Couple at every setting; each solution starts from that of its neighbour."""
    found: dict[CouplingCandidate, Coupling] = {}
    for cost_scale in dict.fromkeys(c.cost_scale for c in candidates):
        group = [c for c in candidates if c.cost_scale == cost_scale]
        gammas = sorted({c.gamma for c in group}, reverse=True)
        taus = sorted({c.tau for c in group}, reverse=True)
        with without_warning_of_small_batch():
            sweep = replace(rope.coupler, cost_scale=cost_scale).sweep(
                real, simulated, gammas=gammas, taus=taus, seed=0
            )
            couplings = list(sweep)
        grid = dict(zip(itertools.product(gammas, taus), couplings, strict=True))
        found |= {c: grid[c.gamma, c.tau] for c in group}
    return [found[c] for c in candidates]


def _check_converged(
    couplings: Sequence[Coupling],
    settings: Sequence[tuple[str, int | None]],
) -> None:
    open_ones = [
        (coupling, name)
        for coupling, (name, _) in zip(couplings, settings, strict=True)
        if not coupling.converged
    ]
    if open_ones:
        worst, name = max(open_ones, key=lambda one: one[0].marginal_error)
        raise CouplingError(
            f"{len(open_ones)} of {len(couplings)} couplings have not converged: "
            f"marginal error up to {worst.marginal_error:.1e}, of {name}. "
            "Give RoPE a coupler with more `max_iterations`, leave the smallest gammas "
            "out of `default_candidates`, or accept them with "
            "require_convergence=False."
        )

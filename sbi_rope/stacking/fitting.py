"""Fits all candidates of a stack to a batch."""

import copy
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from sbi_rope._random import seeded
from sbi_rope._sbi import embed
from sbi_rope.coupling import Coupling, SinkhornCoupler
from sbi_rope.mixture import CoupledContexts, CoupledNet, Part
from sbi_rope.rope import RoPE
from sbi_rope.stacking.candidates import (
    Candidate,
    CouplingCandidate,
    DensityCandidate,
    as_part,
)
from sbi_rope.stacking.estimator import StackedEstimator

__all__ = ["Components", "fit_candidates"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Components:
    """What all fits of a stack share.

    Attributes:
        x_o: The batch of real observations, shape ``(n_o, *event)``.
        prior: The prior NPE was trained with.
        enable_transform: As in sbi, of the posterior of NPE.
        density: The density of a component given its context.
        contexts: The embeddings of the simulations, shape ``(n_s, l)``.
        fixed: The candidates that are the same whatever the pairs are.
    """

    x_o: Tensor
    prior: Distribution
    enable_transform: bool
    density: Any
    contexts: Tensor
    fixed: dict[str, Part]

    @classmethod
    def of(
        cls,
        rope: RoPE,
        x_o: Tensor,
        candidates: Sequence[Candidate],
        *,
        num_simulations: int | None,
        seed: int,
        show_progress_bars: bool,
    ) -> "Components":
        """Simulate what the batch is coupled with, and build the fixed candidates."""
        # Without pairs, which nothing here may depend on: h embeds what is simulated,
        # and at tau = 0 there is nothing to solve.
        untuned = rope.with_pairs(torch.arange(0))
        posterior = untuned.build_posterior(
            x_o,
            coupler=replace(rope.coupler, tau=0.0),
            num_simulations=num_simulations,
            seed=seed,
            show_progress_bars=show_progress_bars,
        )
        estimator = posterior.posterior_estimator
        return cls(
            x_o=posterior.x_o,
            prior=posterior.prior,
            enable_transform=posterior.enable_transform,
            density=estimator.parts[0].density,
            contexts=estimator.coupled[0].simulated,
            fixed={
                c.name: _built(c, untuned, seed)
                for c in candidates
                if isinstance(c, DensityCandidate) and c.fixed
            },
        )


def fit_candidates(
    candidates: Sequence[Candidate],
    rope: RoPE,
    x: Tensor,
    components: Components,
    *,
    seed: int,
    unseen: Literal["raise", "extend"] = "raise",
    tail_mass: float = 1e-3,
) -> StackedEstimator:
    """Couple a batch at all settings, and build the other candidates.

    Args:
        candidates: Couplings first, net by net.
        rope: RoPE, tuned on the pairs that may be used.
        x: The batch, shape ``(n, *event)``.
        components: What all fits share.
        seed: Seed of what is trained.
        unseen: As in :meth:`~sbi_rope.RoPE.build_posterior`.
        tail_mass: As in :meth:`~sbi_rope.RoPE.build_posterior`.

    Returns:
        The stack, with equal weights.
    """
    # Copies: a stack can be moved to a device without the others.
    components = copy.deepcopy(components)
    settings = [c for c in candidates if isinstance(c, CouplingCandidate)]
    nets = _nets(settings, rope, seed)
    real = {key: embed(net, x) for key, net in nets.items()}
    couplings = _couple(settings, real, rope, components)
    share = 1 / len(settings)
    coupled_nets = []
    for key, net in nets.items():
        of_net = [couplings[c] for c in settings if c.net == key]
        coupled_nets.append(CoupledNet(net, of_net, [share] * len(of_net)))
    coupled = CoupledContexts(components.contexts, x, coupled_nets, unseen=unseen)
    others = [
        components.fixed.get(c.name) or _built(c, rope, seed)
        for c in candidates
        if isinstance(c, DensityCandidate)
    ]
    return StackedEstimator(
        Part(components.density, coupled),
        others,
        torch.full((len(candidates),), 1 / len(candidates), dtype=torch.double),
        tail_mass=tail_mass,
    )


def _built(candidate: DensityCandidate, rope: RoPE, seed: int) -> Part:
    # Whoever forgets the seed, or looks at a prior by drawing from it, leaves no trace.
    with seeded(seed):
        return as_part(candidate.name, candidate.build(rope, seed), rope)


Net = tuple[bool, float | None]


def _nets(
    settings: Sequence[CouplingCandidate], rope: RoPE, seed: int
) -> dict[Net, nn.Module]:
    nets: dict[Net, nn.Module] = {}
    for tuned, rehearsal in dict.fromkeys(c.net for c in settings):
        if not tuned:
            net = rope.embedding_net
        elif rehearsal in (None, rope.finetuner.rehearsal):
            net = rope.tuned_embedding_net
        else:
            other = replace(rope.finetuner, rehearsal=rehearsal)
            trained = rope.with_finetuner(other).train(
                seed=seed, show_progress_bars=False
            )
            net = trained.tuned_embedding_net
        nets[tuned, rehearsal] = net
    return nets


def _couple(
    settings: Sequence[CouplingCandidate],
    real: dict[Net, Tensor],
    rope: RoPE,
    components: Components,
) -> dict[CouplingCandidate, Coupling]:
    """Couple at every setting; along gamma and tau each starts from its neighbour."""
    couplings: dict[CouplingCandidate, Coupling] = {}
    groups = dict.fromkeys((c.net, c.cost_scale) for c in settings)
    for net, cost_scale in groups:
        group = [c for c in settings if (c.net, c.cost_scale) == (net, cost_scale)]
        gammas = sorted({c.gamma for c in group}, reverse=True)
        taus = sorted({c.tau for c in group}, reverse=True)
        coupler: SinkhornCoupler = replace(rope.coupler, cost_scale=cost_scale)
        found = coupler.sweep(
            real[net], components.contexts, gammas=gammas, taus=taus, seed=0
        )
        by_setting = dict(zip(itertools.product(gammas, taus), found, strict=True))
        couplings.update({c: by_setting[c.gamma, c.tau] for c in group})
    return couplings

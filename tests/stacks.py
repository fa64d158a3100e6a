"""Small stacks that tests share, and what they are made of."""

import functools
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, MixturePosterior, RoPE, SinkhornCoupler
from sbi_rope._sbi import headless
from sbi_rope.baselines import FinetunedNPE, PriorPosterior
from sbi_rope.baselines.training import Training
from sbi_rope.stacking import (
    CouplingCandidate,
    CrossValidation,
    DensityCandidate,
    StackedPosterior,
    cross_validate,
    stack,
)
from sbi_rope.stacking.cross_validation import draw_seeds
from tests import problems

QUIET: dict[str, Any] = {"show_progress_bars": False}
NUM_PAIRS, NUM_OBSERVED, NUM_SIMULATED = 20, 25, 60


def uneven(theta: Tensor) -> Tensor:
    """Noisy readings that take more random numbers at some theta than at others.

    So the simulations of all that come later depend on every theta before.
    """
    rate = 10 * (1.5 + theta.sum(dim=1, keepdim=True)).clamp_min(0.1)
    return problems.simulate(theta) + 0.02 * (torch.poisson(rate) - rate)


def quick_finetuned(rope: RoPE, seed: int) -> Any:
    method = FinetunedNPE.from_posterior(
        rope.npe, training=Training(max_num_epochs=3), learning_rates=(1e-2,)
    )
    method.append_calibration(*rope.calibration)
    return method.train(seed=seed, **QUIET).build_posterior()


# Moves the net far enough to tell g from h.
QUICK = CalibrationFinetuner(num_steps=15, simulations_per_target=3, learning_rate=0.03)
PRIOR = DensityCandidate(
    name="prior", build=lambda rope, seed: PriorPosterior(rope.npe.prior), fixed=True
)
NPE = DensityCandidate(name="NPE", build=lambda rope, seed: rope.npe, fixed=True)
TUNED = DensityCandidate(name="tuned", build=lambda rope, seed: rope.tuned_posterior())
FINETUNED = DensityCandidate(name="fine-tuned", build=quick_finetuned)
OT_ONLY = CouplingCandidate(gamma=0.2, tau=0.5, tuned=False)
COUPLINGS = (
    CouplingCandidate(gamma=0.2, tau=1.0),
    CouplingCandidate(gamma=0.4, tau=0.5),
    OT_ONLY,
    CouplingCandidate(gamma=0.3, tau=0.9, tuned=False, cost_scale="none"),
    CouplingCandidate(gamma=0.2, tau=0.5, rehearsal=20.0),
)
CANDIDATES = (*COUPLINGS, PRIOR, NPE, TUNED, FINETUNED)


def problem(dim: int, n: int, *, seed: int) -> tuple[Tensor, Tensor]:
    """Real observations, shifted against the simulations, with their parameters."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        theta = problems.box(dim).sample((n,))
        return theta, problems.simulate(theta) + 0.4


def untrained(
    family: str = "mdn",
    embedding: str = "linear",
    *,
    dim: int = 2,
    num_pairs: int = NUM_PAIRS,
    pairs: tuple[Tensor, Tensor] | None = None,
    **options: Any,
) -> RoPE:
    if "simulations" not in options:
        options["simulator"] = uneven
    options.setdefault("finetuner", QUICK)
    rope = RoPE(problems.npe_posterior(family, embedding, dim=dim), **options)
    if pairs is None:
        pairs = problem(dim, num_pairs, seed=1)
    return rope.append_calibration(*pairs) if len(pairs[0]) else rope


def trained(family: str = "mdn", embedding: str = "linear", **options: Any) -> RoPE:
    return untrained(family, embedding, **options).train(seed=0, **QUIET)


def observed(dim: int = 2, n: int = NUM_OBSERVED) -> Tensor:
    return problem(dim, n, seed=2)[1]


def validate(rope: RoPE, **options: Any) -> CrossValidation:
    options = {
        "candidates": CANDIDATES,
        "num_simulations": NUM_SIMULATED,
        "seed": 0,
        **QUIET,
        **options,
    }
    return cross_validate(rope, options.pop("x_o", observed()), **options)


def stacked(rope: RoPE, **options: Any) -> StackedPosterior:
    options = {
        "candidates": CANDIDATES,
        "num_simulations": NUM_SIMULATED,
        "tail_mass": 0.0,
        "seed": 0,
        **QUIET,
        **options,
    }
    return stack(rope, options.pop("x_o", observed()), **options)


@functools.cache
def the_rope() -> RoPE:
    """For reading only, as all of these."""
    with torch.random.fork_rng():
        return trained()


@functools.cache
def the_scores() -> CrossValidation:
    with torch.random.fork_rng():
        return validate(the_rope())


@functools.cache
def the_stack() -> StackedPosterior:
    with torch.random.fork_rng():
        return stacked(the_rope(), unseen="extend")


def midpoints(count: int) -> Tensor:
    """The middles of equal cells of [-1, 1]."""
    return (torch.arange(count) + 0.5) * 2 / count - 1


def rope_of(candidate: CouplingCandidate, rope: RoPE) -> RoPE:
    """The RoPE that a candidate is a setting of, in a stack made with seed 0."""
    if not candidate.tuned:
        return rope.with_pairs(torch.arange(0))
    if candidate.rehearsal is None:
        return rope
    other = replace(rope.finetuner, rehearsal=candidate.rehearsal)
    # `stack` draws three seeds; what is trained on all pairs has the last.
    return rope.with_finetuner(other).train(seed=draw_seeds(0, 3)[2], **QUIET)


def net_of(candidate: CouplingCandidate, rope: RoPE) -> nn.Module:
    """What a candidate embeds observations by."""
    if not candidate.tuned:
        return rope.embedding_net
    return rope_of(candidate, rope).tuned_embedding_net


def coupled_by_hand(
    candidate: CouplingCandidate, rope: RoPE, x: Tensor, contexts: Tensor
) -> MixturePosterior:
    """The posterior of one setting of RoPE, without any part of the stack."""
    net = net_of(candidate, rope)
    coupler = SinkhornCoupler(
        gamma=candidate.gamma,
        tau=candidate.tau,
        cost_scale=candidate.cost_scale,
        tolerance=1e-9,
    )
    with torch.no_grad():
        coupling = coupler.couple(net(x), contexts)
    estimator = problems.coupled_mixture(
        headless(rope.npe.posterior_estimator),
        contexts,
        coupling,
        x,
        embedding_net=net,
        tail_mass=0.0,
    )
    return MixturePosterior(estimator, rope.npe.prior)


def unnormalised(posterior: Any, theta: Tensor, x: Tensor) -> Tensor:
    return posterior.log_prob_batched(theta, x, norm_posterior=False).detach()


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    return len(a) == len(b) and all(map(torch.equal, a, b))


def parameters(net: nn.Module) -> list[Tensor]:
    return [value.detach() for value in net.state_dict().values()]

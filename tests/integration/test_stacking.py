"""Stacks of trained candidates, and scores that no held-out label has touched."""

import copy
import functools
import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, MixturePosterior, RoPE, SinkhornCoupler
from sbi_rope._sbi import headless
from sbi_rope.baselines import FinetunedNPE, PriorPosterior
from sbi_rope.baselines.training import Training
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    LogProbUnavailableError,
    NotReadyError,
    RoPEWarning,
    UnseenObservationError,
    UnsupportedPosteriorError,
)
from sbi_rope.mixture import MixtureEstimator
from sbi_rope.stacking import (
    CouplingCandidate,
    CrossValidation,
    DensityCandidate,
    StackedPosterior,
    cross_validate,
    default_candidates,
    stack,
    stacking_weights,
)
from tests import gaussian, problems

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")

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


def coupled_by_hand(
    candidate: CouplingCandidate, rope: RoPE, x: Tensor, contexts: Tensor
) -> MixturePosterior:
    """The posterior of one setting of RoPE, without any part of the stack."""
    net = rope.tuned_embedding_net if candidate.tuned else rope.embedding_net
    coupler = SinkhornCoupler(
        gamma=candidate.gamma,
        tau=candidate.tau,
        cost_scale=candidate.cost_scale,
        tolerance=1e-9,
    )
    with torch.no_grad():
        coupling = coupler.couple(net(x), contexts)
    estimator = MixtureEstimator(
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


def test_couplings_of_a_stack_are_the_couplings_of_rope_at_their_settings() -> None:
    rope, posterior = the_rope(), the_stack()
    g, h = rope.tuned_embedding_net, rope.embedding_net
    assert (g(posterior.x_o) - h(posterior.x_o)).abs().max() > 0.1
    theta = problems.box(2).sample((NUM_OBSERVED,))
    estimator: Any = posterior.posterior_estimator
    found = estimator.candidate_log_probs(theta, posterior.x_o)
    assert found.shape == (NUM_OBSERVED, len(CANDIDATES))
    for k, candidate in enumerate(COUPLINGS):
        alone = coupled_by_hand(candidate, rope, posterior.x_o, estimator.contexts)
        used = estimator.coupling.couplings[k]
        assert (used.tau, used.gamma) == (candidate.tau, alone.coupling.gamma)
        expected = unnormalised(alone, theta, posterior.x_o)[0]
        assert torch.allclose(found[:, k].float(), expected, atol=1e-3)


@pytest.mark.parametrize("candidate", COUPLINGS)
def test_with_the_same_simulations_build_posterior_gives_the_same_density(
    candidate: CouplingCandidate,
) -> None:
    theta = problems.box(2).sample((NUM_SIMULATED,))
    simulations = (theta, problems.simulate(theta))
    rope = untrained(simulations=simulations)
    if candidate.tuned:
        rope.train(seed=0, **QUIET)
    else:
        rope = rope.with_pairs(torch.arange(0))
    coupler = SinkhornCoupler(
        gamma=candidate.gamma, tau=candidate.tau, cost_scale=candidate.cost_scale
    )
    x_o = observed()
    # All stored simulations are used, in whatever order.
    alone = rope.build_posterior(x_o, coupler=coupler, seed=5, tail_mass=0.0)
    posterior = stacked(
        trained(simulations=simulations),
        candidates=[candidate],
        num_simulations=None,
        num_folds=2,
    )
    theta = problems.box(2).sample((4, NUM_OBSERVED))
    assert torch.allclose(
        unnormalised(posterior, theta, x_o), unnormalised(alone, theta, x_o), atol=1e-3
    )
    assert torch.allclose(
        posterior.leakage(x_o).mass, alone.leakage(x_o).mass, atol=0.02
    )


def test_direct_candidates_are_scored_as_their_posteriors_without_renormalisation() -> (
    None
):
    rope, posterior = the_rope(), the_stack()
    x_o = posterior.x_o
    theta = problems.box(2).sample((NUM_OBSERVED,))
    estimator: Any = posterior.posterior_estimator
    names = list(posterior.candidate_weights)
    found = dict(zip(names, estimator.candidate_log_probs(theta, x_o).T, strict=True))
    tuned = rope.tuned_posterior()
    for name, alone in (("NPE", rope.npe), ("tuned", tuned)):
        expected = unnormalised(alone, theta, x_o)[0]
        assert torch.allclose(found[name].float(), expected, atol=1e-4)
    assert torch.allclose(found["prior"], torch.tensor(0.25).log().double())
    # A density without the bound of the prior: that is what leaks.
    npe: Any = rope.npe.posterior_estimator
    outside = estimator.candidate_log_probs(theta + 3, x_o)[:, names.index("NPE")]
    with torch.no_grad():
        expected = npe.log_prob((theta + 3)[None], x_o)[0]
    assert torch.allclose(outside.float(), expected, atol=1e-3)


def test_a_stack_is_the_weighted_sum_of_its_candidates() -> None:
    posterior = the_stack()
    theta = problems.box(2).sample((NUM_OBSERVED,))
    estimator: Any = posterior.posterior_estimator
    scores = estimator.candidate_log_probs(theta, posterior.x_o)
    weights = torch.tensor(list(posterior.candidate_weights.values())).double()
    assert float(weights.sum()) == pytest.approx(1.0)
    assert torch.allclose(weights, estimator.weights)
    expected = torch.logsumexp(scores + weights.log(), dim=1).float()
    found = unnormalised(posterior, theta, posterior.x_o)[0]
    assert torch.allclose(found, expected, atol=1e-4)


def test_the_tail_that_is_left_out_weighs_no_more_than_stated() -> None:
    whole = the_stack()
    cut = stacked(the_rope(), tail_mass=0.05)
    theta = problems.box(2).sample((NUM_OBSERVED,))
    exact, less = (unnormalised(p, theta, whole.x_o).exp() for p in (whole, cut))
    largest = whole.posterior_estimator.component_log_probs(theta).exp()  # type: ignore[operator]
    missing = (exact - less)[0]
    assert (missing >= -1e-5).all()
    assert (missing <= 0.05 * largest.max(dim=1).values + 1e-5).all()
    assert (missing > 1e-4).any()


def test_weights_are_those_of_the_cross_validation_with_the_same_seed() -> None:
    posterior, scores = the_stack(), the_scores()
    assert posterior.report.cross_validation.log_scores.equal(scores.log_scores)
    assert list(posterior.candidate_weights) == list(scores.names)
    expected = stacking_weights(scores.log_scores, pseudo_count=1.0).weights
    assert list(posterior.candidate_weights.values()) == expected.tolist()


def test_samples_of_a_trained_stack_follow_its_density() -> None:
    posterior, draws = the_stack(), 1000
    samples = posterior.sample_batched((draws,), posterior.x_o[:3], **QUIET)
    assert samples.shape == (draws, 3, 2)
    assert (samples.abs() <= 1).all()
    line = midpoints(20)
    cells = torch.cartesian_prod(line, line)
    theta = cells[:, None].expand(-1, 3, -1)
    density = posterior.log_prob_batched(theta, posterior.x_o[:3]).exp()
    assert torch.allclose(density.mean(dim=0) * 4, torch.ones(3), atol=0.05)
    for i in range(3):
        # Both parameters in quarters.
        share = density[:, i].reshape(4, 5, 4, 5).sum(dim=(1, 3)) / density[:, i].sum()
        edges = [torch.linspace(-1, 1, 5)] * 2
        counts = torch.histogramdd(samples[:, i], edges).hist / draws
        error = (share * (1 - share) / draws).sqrt()
        assert ((counts - share).abs() < 4.5 * error + 0.01).all()


def test_a_pickled_stack_answers_the_same_and_keeps_its_scores() -> None:
    posterior = the_stack()
    other = pickle.loads(pickle.dumps(posterior))
    theta = problems.box(2).sample((3, NUM_OBSERVED))
    expected = posterior.log_prob_batched(theta, posterior.x_o)
    assert torch.equal(other.log_prob_batched(theta, posterior.x_o), expected)
    scores = other.report.cross_validation
    assert torch.equal(scores.log_scores, the_scores().log_scores)
    assert torch.allclose(scores.stack_scores, the_scores().stack_scores)


def test_a_trained_stack_extends_to_new_observations() -> None:
    posterior, x = the_stack(), observed(n=30)[NUM_OBSERVED:]
    theta = problems.box(2).sample((len(x),))
    with pytest.warns(RoPEWarning, match="Extended the coupling to 5"):
        found = unnormalised(posterior, theta, x)
    assert torch.isfinite(found).all()
    rope = the_rope()
    estimator: Any = posterior.posterior_estimator
    couplings = estimator.coupling.couplings
    for k, candidate in enumerate(COUPLINGS):
        net = rope.tuned_embedding_net if candidate.tuned else rope.embedding_net
        with torch.no_grad():
            rows = couplings[k].rows(net(x))
        log_q = estimator.component_log_probs(theta)
        expected = torch.logsumexp(rows.log() + log_q, dim=1)
        scores = estimator.candidate_log_probs(theta, x)[:, k]
        assert torch.allclose(scores, expected, atol=1e-4)
    with pytest.raises(UnseenObservationError):
        stacked(rope, candidates=[OT_ONLY], num_folds=2).sample((1,), x=x[0], **QUIET)


@pytest.mark.parametrize(
    ("family", "embedding"),
    [
        ("mdn", "linear"),
        ("mdn", "none"),
        ("maf", "linear"),
        ("maf", "none"),
        ("nsf", "linear"),
        ("zuko_maf", "linear"),
    ],
)
def test_every_family_can_be_stacked(family: str, embedding: str) -> None:
    rope = trained(family, embedding)
    candidates = (COUPLINGS[0], OT_ONLY, PRIOR, NPE, FINETUNED)
    posterior = stacked(rope, candidates=candidates, num_folds=2)
    theta = problems.box(2).sample((NUM_OBSERVED,))
    found = unnormalised(posterior, theta, posterior.x_o)[0].double()
    estimator: Any = posterior.posterior_estimator
    alone = [
        unnormalised(
            coupled_by_hand(c, rope, posterior.x_o, estimator.contexts),
            theta,
            posterior.x_o,
        )[0]
        for c in candidates[:2]
    ]
    alone += [torch.full((NUM_OBSERVED,), math.log(0.25))]
    alone += [unnormalised(rope.npe, theta, posterior.x_o)[0]]
    alone += [estimator.candidate_log_probs(theta, posterior.x_o)[:, 4]]
    weights = torch.tensor(list(posterior.candidate_weights.values())).double()
    expected = torch.stack([a.double() for a in alone], dim=1)
    expected = torch.logsumexp(expected + weights.log(), dim=1)
    assert torch.allclose(found, expected, atol=2e-3)
    samples = posterior.sample_batched((10,), posterior.x_o, **QUIET)
    assert (samples.abs() <= 1).all()


def test_images_can_be_stacked() -> None:
    theta = problems.box(2).sample((30,))
    x = problems.simulate_image(theta) + 0.3
    rope = RoPE(
        problems.npe_posterior("mdn", "cnn"),
        simulator=problems.simulate_image,
        finetuner=CalibrationFinetuner(num_steps=3, simulations_per_target=2),
    )
    rope.append_calibration(theta[:8], x[:8]).train(**QUIET)
    posterior = stacked(rope, x_o=x[8:], num_folds=2)
    assert posterior.log_prob_batched(theta[8:], x[8:]).isfinite().all()
    assert posterior.sample_batched((3,), x[8:], **QUIET).shape == (3, 22, 2)


# --- cross-validation ---


def trained_state(estimator: Any) -> list[Tensor]:
    """All that scores a held-out pair: nets, components, batch and couplings."""
    couplings = estimator.coupling.couplings
    return [
        *estimator.state_dict().values(),
        *(coupling.potential for coupling in couplings),
        *(coupling.real for coupling in couplings),
    ]


def same(a: list[Tensor], b: list[Tensor]) -> bool:
    return len(a) == len(b) and all(map(torch.equal, a, b))


def parameters(net: nn.Module) -> list[Tensor]:
    return [value.detach() for value in net.state_dict().values()]


def tuned_net(estimator: Any) -> nn.Module:
    return estimator.mixture._g.nets[-1]


@pytest.mark.parametrize(
    ("num_pairs", "num_folds", "sizes"),
    [
        (20, 5, [4] * 5),
        (13, 5, [2, 2, 3, 3, 3]),
        (5, 5, [1] * 5),
        (4, 5, [1] * 4),
        (2, 5, [1, 1]),
        (9, 2, [4, 5]),
    ],
)
def test_every_pair_is_held_out_once(
    num_pairs: int, num_folds: int, sizes: list[int]
) -> None:
    rope = untrained(num_pairs=num_pairs)
    seen: list[Tensor] = []

    def build(part: RoPE, seed: int) -> Any:
        seen.append(part.calibration[0])
        return part.npe

    spy = DensityCandidate(name="spy", build=build)
    scores = validate(rope, candidates=[OT_ONLY, spy], num_folds=num_folds)
    theta, x = rope.calibration
    assert torch.equal(scores.theta, theta)
    assert torch.equal(scores.x, x)
    assert sorted(scores.fold.bincount().tolist()) == sizes
    assert len(seen) == scores.num_folds == len(scores.estimators) == len(sizes)
    assert len(scores) == num_pairs
    # What is trained for a fold gets all pairs but those of the fold.
    for number, part in enumerate(seen):
        known = {tuple(row) for row in part.tolist()}
        others = {tuple(row) for row in theta[scores.fold != number].tolist()}
        assert known == others
        assert len(part) == len(known)


def test_folds_are_drawn_at_random() -> None:
    fold = the_scores().fold
    assert fold.tolist() != sorted(fold.tolist())
    other = validate(the_rope(), candidates=[OT_ONLY], seed=1).fold
    assert not torch.equal(other, fold)


def test_held_out_observations_are_coupled_together_with_the_batch() -> None:
    rope, scores, x_o = the_rope(), the_scores(), observed()
    for number, estimator in enumerate(scores.estimators):
        rows = scores.fold == number
        x = torch.cat([scores.x[rows], x_o])
        contexts = estimator.contexts
        alone = coupled_by_hand(OT_ONLY, rope, x, contexts)
        expected = unnormalised(alone, scores.theta[rows], scores.x[rows])[0]
        found = scores.scores_of(OT_ONLY.name)[rows]
        assert torch.allclose(found.float(), expected, atol=1e-3)
        assert len(estimator.x_o) == int(rows.sum()) + NUM_OBSERVED


def test_scores_are_those_of_the_candidates_trained_without_the_fold() -> None:
    scores = the_scores()
    for number, estimator in enumerate(scores.estimators):
        rows = scores.fold == number
        theta, x = scores.theta[rows], scores.x[rows]
        expected = estimator.candidate_log_probs(theta, x)
        assert torch.allclose(scores.log_scores[rows], expected, atol=1e-5)
        # The tuned net of the fold stands behind the tuned candidates.
        alone = copy.deepcopy(the_rope())
        alone._g = tuned_net(estimator)
        for candidate in COUPLINGS[:2]:
            by_hand = coupled_by_hand(
                candidate, alone, estimator.x_o, estimator.contexts
            )
            expected = unnormalised(by_hand, theta, x)[0].double()
            found = scores.scores_of(candidate.name)[rows]
            assert torch.allclose(found, expected, atol=1e-3)
        expected = unnormalised(alone.tuned_posterior(), theta, x)[0].double()
        assert torch.allclose(scores.scores_of("tuned")[rows], expected, atol=1e-4)


@pytest.mark.parametrize("number", range(5))
def test_shuffled_labels_of_a_fold_change_its_scores_and_nothing_behind_them(
    number: int,
) -> None:
    before = the_scores()
    rows = before.fold == number
    theta = before.theta.clone()
    theta[rows] = theta[rows].roll(1, dims=0)
    after = validate(untrained(pairs=(theta, before.x)))
    assert torch.equal(after.fold, before.fold)
    states = [
        (trained_state(a), trained_state(b))
        for a, b in zip(before.estimators, after.estimators, strict=True)
    ]
    assert same(*states[number])
    # Of the other folds the pairs do train the nets.
    assert not any(same(*state) for k, state in enumerate(states) if k != number)

    changed = before.log_scores != after.log_scores
    names = before.names
    assert changed[rows][:, [names.index("NPE"), names.index(OT_ONLY.name)]].all()
    assert changed[rows].any(dim=0).sum() == len(names) - 1  # all but the prior
    untouched = [k for k, name in enumerate(names) if name in ("NPE", OT_ONLY.name)]
    assert not changed[~rows][:, untouched].any()


def test_held_out_observations_train_nothing() -> None:
    before = the_scores()
    rows = before.fold == 1
    x = before.x.clone()
    x[rows] += 1.0
    after = validate(untrained(pairs=(before.theta, x)))
    nets = [
        (tuned_net(s.estimators[1]), s.estimators[1].parts) for s in (before, after)
    ]
    assert same(parameters(nets[0][0]), parameters(nets[1][0]))
    for part, other in zip(nets[0][1], nets[1][1], strict=True):
        assert same(parameters(part), parameters(other))
    # Unlabelled, they are coupled all the same.
    assert not same(
        trained_state(before.estimators[1]), trained_state(after.estimators[1])
    )


@pytest.mark.parametrize("resample", [False, True])
def test_labels_of_a_fold_reach_the_folds_that_train_on_it_only(
    resample: bool,
) -> None:
    finetuner = CalibrationFinetuner(
        num_steps=3, simulations_per_target=2, resample_targets=resample
    )
    options: dict[str, Any] = {"candidates": COUPLINGS[:1], "num_training_folds": 2}
    theta, x = problem(2, 10, seed=1)
    before = validate(untrained(pairs=(theta, x), finetuner=finetuner), **options)
    reached = []
    for number in range(5):
        other = theta.clone()
        other[before.fold == number] *= -1
        after = validate(untrained(pairs=(other, x), finetuner=finetuner), **options)
        changed = [
            not same(trained_state(a), trained_state(b))
            for a, b in zip(before.estimators, after.estimators, strict=True)
        ]
        assert not changed[number]
        assert sum(changed) == 2
        reached.append(changed)
    # Every fold is scored by what two others have trained.
    assert [sum(column) for column in zip(*reached, strict=True)] == [2] * 5
    assert before.num_trained_on == 4


def test_a_seed_reproduces_scores_and_leaves_no_trace() -> None:
    rope = the_rope()
    state = torch.random.get_rng_state()
    again = validate(rope)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert torch.equal(again.log_scores, the_scores().log_scores)
    other = validate(rope, seed=1)
    assert not torch.equal(other.log_scores, again.log_scores)


def test_without_a_seed_the_states_of_torch_decide() -> None:
    draws = []
    for seed in (5, 5, 6):
        torch.manual_seed(seed)
        scores = validate(the_rope(), candidates=[OT_ONLY], seed=None)
        draws.append(scores.log_scores)
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


def test_a_seed_reproduces_a_stack() -> None:
    candidates = (COUPLINGS[0], NPE, FINETUNED)
    theta, draws = problems.box(2).sample((NUM_OBSERVED,)), []
    for seed in (3, 3, 4):
        posterior = stacked(the_rope(), candidates=candidates, num_folds=2, seed=seed)
        draws.append(unnormalised(posterior, theta, posterior.x_o))
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])


@pytest.mark.parametrize("num_pairs", [5, 2])
def test_few_pairs_are_left_out_one_by_one(num_pairs: int) -> None:
    rope = trained(num_pairs=num_pairs)
    posterior = stacked(rope)
    scores = posterior.report.cross_validation
    assert scores.num_folds == num_pairs
    assert scores.log_scores.isfinite().all()
    assert scores.stack_scores.isfinite().all()
    assert sum(posterior.candidate_weights.values()) == pytest.approx(1.0)
    assert posterior.sample_batched((2,), posterior.x_o, **QUIET).shape == (2, 25, 2)


@pytest.mark.parametrize("num_pairs", [1, 0])
def test_too_few_pairs_are_refused(num_pairs: int) -> None:
    for call in (cross_validate, stack):
        with pytest.raises(NotReadyError, match="at least 2 calibration pairs"):
            call(untrained(num_pairs=num_pairs), observed(), **QUIET)


def test_a_stack_needs_a_trained_rope() -> None:
    with pytest.raises(NotReadyError, match=r"`train\(\)` first"):
        stacked(untrained())


def test_a_trainer_that_ignores_its_seed_is_reproduced_all_the_same() -> None:
    def build(rope: RoPE, seed: int) -> Any:
        return quick_finetuned(rope, int(torch.randint(1000, ())))

    candidate = DensityCandidate(name="careless", build=build)
    options: dict[str, Any] = {"candidates": [OT_ONLY, candidate], "num_folds": 2}
    first, second = (validate(the_rope(), **options).log_scores for _ in range(2))
    assert torch.equal(first, second)


def test_stored_simulations_serve_as_well() -> None:
    theta = problems.box(2).sample((300,))
    rope = trained(simulations=(theta, problems.simulate(theta)))
    posterior = stacked(rope, num_simulations=None)
    assert posterior.posterior_estimator.contexts.shape == (300, 4)
    assert posterior.report.cross_validation.log_scores.isfinite().all()


def test_a_stack_that_has_not_seen_the_fold_scores_its_pairs() -> None:
    scores = the_scores()
    for rows, posterior in scores.posteriors():
        others = torch.ones(len(scores), dtype=torch.bool)
        others[rows] = False
        assert (scores.fold[rows] == scores.fold[rows[0]]).all()
        weights = stacking_weights(scores.log_scores[others]).weights
        assert list(posterior.candidate_weights.values()) == weights.tolist()
        x = scores.x[rows]
        expected = torch.logsumexp(scores.log_scores[rows] + weights.log(), dim=1)
        expected = expected - posterior.leakage(x).mass.log()
        # Without the tail of weight 0.001 that the density leaves out.
        assert torch.allclose(scores.stack_scores[rows], expected, atol=0.01)


def test_levels_are_those_of_the_stacks_that_have_not_seen_the_pair() -> None:
    scores = the_scores()
    levels = scores.levels(num_samples=400)
    assert levels.shape == (NUM_PAIRS, 2)
    assert torch.equal(levels, scores.levels(num_samples=400))
    assert ((levels >= 0) & (levels <= 1)).all()
    for rows, posterior in scores.posteriors():
        samples = posterior.sample_batched((400,), scores.x[rows], **QUIET)
        below = (samples < scores.theta[rows]).double().mean(dim=0)
        expected = (2 * below - 1).abs()
        # Four standard errors of two independent sets of samples.
        assert torch.allclose(levels[rows].double(), expected, atol=0.3)


def test_differences_are_paired_and_their_interval_is_that_of_the_mean() -> None:
    scores = the_scores()
    names = scores.names
    for name, other in ((names[0], "NPE"), ("stack", "prior"), ("NPE", "NPE")):
        pairs = scores.scores_of(name) - scores.scores_of(other)
        found = scores.difference(name, other)
        assert found.mean == pytest.approx(float(pairs.mean()))
        error = float(pairs.std(correction=0)) / len(pairs) ** 0.5
        assert found.low == pytest.approx(found.mean - 1.96 * error, abs=0.5 * error)
        assert found.high == pytest.approx(found.mean + 1.96 * error, abs=0.5 * error)
        assert found == scores.difference(name, other)
        back = scores.difference(other, name)
        assert back.mean == pytest.approx(-found.mean)
    with pytest.raises(InvalidInputError, match="name"):
        scores.scores_of("nobody")


def test_rows_of_the_table_are_mean_error_and_weight_of_each_candidate() -> None:
    scores = the_scores()
    rows = scores.as_rows()
    assert [row["candidate"] for row in rows] == list(scores.names)
    assert [row["family"] for row in rows] == list(scores.families)
    for k, row in enumerate(rows):
        column = scores.log_scores[:, k]
        assert row["weight"] == float(scores.weights.weights[k])
        assert row["score"] == pytest.approx(float(column.mean()))
        error = float((column - column.mean()).square().sum() / (19 * 20)) ** 0.5
        assert row["standard_error"] == pytest.approx(error, abs=1e-12)


# --- candidates ---


def test_candidates_come_in_any_order_and_are_named() -> None:
    scores = validate(the_rope(), candidates=(NPE, COUPLINGS[0], PRIOR, OT_ONLY))
    assert scores.names == (
        "RoPE (gamma 0.2, tau 1)",
        "OT-only (gamma 0.2, tau 0.5)",
        "NPE",
        "prior",
    )
    assert scores.families == ("RoPE", "OT-only", "NPE", "prior")
    for k, name in enumerate(scores.names):
        expected = the_scores().scores_of(name)
        assert torch.allclose(scores.log_scores[:, k], expected, atol=1e-3)


def test_the_default_candidates_can_be_stacked() -> None:
    rope = trained(num_pairs=6)
    candidates = default_candidates(gammas=(0.3,), taus=(0.5,))
    posterior = stacked(rope, candidates=candidates, num_folds=2)
    assert list(posterior.candidate_weights)[2:] == [
        "prior",
        "NPE",
        "tuning-only",
        "fine-tuned NPE",
    ]
    assert posterior.report.cross_validation.log_scores.isfinite().all()


def test_a_user_may_add_a_trained_posterior_of_another_family() -> None:
    another = problems.npe_posterior("maf", "none")
    before = copy.deepcopy(another.posterior_estimator.state_dict())
    built = []

    def build(rope: RoPE, seed: int) -> Any:
        built.append(rope)
        return another

    candidate = DensityCandidate(name="older", build=build, fixed=True)
    posterior = stacked(the_rope(), candidates=(OT_ONLY, candidate))
    assert len(built) == 1
    scores = posterior.report.cross_validation
    expected = unnormalised(another, scores.theta, scores.x)[0]
    assert torch.allclose(scores.scores_of("older").float(), expected, atol=1e-4)
    after = another.posterior_estimator.state_dict()
    assert all(torch.equal(before[key], after[key]) for key in before)


def test_a_stack_does_not_change_with_the_posteriors_it_was_made_of() -> None:
    another = copy.deepcopy(problems.npe_posterior("maf", "none"))
    candidate = DensityCandidate(
        name="older", build=lambda rope, seed: another, fixed=True
    )
    posterior = stacked(the_rope(), candidates=(OT_ONLY, candidate), num_folds=2)
    theta = problems.box(2).sample((NUM_OBSERVED,))
    expected = unnormalised(posterior, theta, posterior.x_o)
    with torch.no_grad():
        for parameter in another.posterior_estimator.parameters():
            parameter += 0.1
    assert torch.equal(unnormalised(posterior, theta, posterior.x_o), expected)


def test_a_posterior_in_training_mode_is_scored_in_evaluation_mode() -> None:
    another = copy.deepcopy(problems.npe_posterior("maf", "linear"))
    another.posterior_estimator.train()
    candidate = DensityCandidate(
        name="older", build=lambda rope, seed: another, fixed=True
    )
    scores = validate(the_rope(), candidates=(OT_ONLY, candidate), num_folds=2)
    another.posterior_estimator.eval()
    expected = unnormalised(another, scores.theta, scores.x)[0]
    assert torch.allclose(scores.scores_of("older").float(), expected, atol=1e-4)


def test_a_trainer_sees_the_pairs_of_the_other_folds_and_at_last_all() -> None:
    seen = []

    def build(rope: RoPE, seed: int) -> Any:
        theta, x = rope.calibration
        seen.append((len(theta), len(x), seed))
        # Its RoPE is tuned on the same pairs.
        assert rope.tuned_embedding_net is not None
        return quick_finetuned(rope, seed)

    candidate = DensityCandidate(name="mine", build=build)
    posterior = stacked(the_rope(), candidates=(OT_ONLY, candidate))
    assert [n for n, _, _ in seen] == [n for _, n, _ in seen] == [16] * 5 + [20]
    assert len({seed for _, _, seed in seen}) == 6
    # Its posterior in the end is the one trained on all pairs.
    alone = quick_finetuned(the_rope(), seen[-1][2])
    theta = problems.box(2).sample((NUM_OBSERVED,))
    estimator: Any = posterior.posterior_estimator
    found = estimator.candidate_log_probs(theta, posterior.x_o)[:, 1].float()
    assert torch.allclose(
        found, unnormalised(alone, theta, posterior.x_o)[0], atol=1e-4
    )


def test_what_the_user_hands_over_is_left_as_it_was() -> None:
    rope = trained()
    x_o = observed()
    theta, x = rope.calibration
    held = [x_o, theta, x]
    net, coupler, finetuner = rope.tuned_embedding_net, rope.coupler, rope.finetuner
    npe = problems.npe_posterior("mdn")
    state = copy.deepcopy(npe.posterior_estimator.state_dict())
    before = [value.clone() for value in held]
    untouched = rope.build_posterior(x_o, num_simulations=50, seed=3).weights.clone()
    stacked(rope, x_o=x_o)
    assert all(map(torch.equal, held, before))
    assert all(map(torch.equal, rope.calibration, before[1:]))
    assert same(parameters(rope.tuned_embedding_net), parameters(net))
    assert (rope.coupler, rope.finetuner) == (coupler, finetuner)
    after = npe.posterior_estimator.state_dict()
    assert all(torch.equal(state[key], after[key]) for key in state)
    again = rope.build_posterior(x_o, num_simulations=50, seed=3).weights
    assert torch.equal(again, untouched)


@pytest.mark.parametrize(
    ("candidates", "error", "match"),
    [
        ([NPE, PRIOR], InvalidInputError, "at least one CouplingCandidate"),
        ([], InvalidInputError, "at least one CouplingCandidate"),
        ([OT_ONLY, OT_ONLY], InvalidInputError, "names that differ"),
        (
            [OT_ONLY, NPE, DensityCandidate(name="NPE", build=quick_finetuned)],
            InvalidInputError,
            "names that differ",
        ),
        ([OT_ONLY, "NPE"], InvalidTypeError, "got str"),
        ([OT_ONLY, PriorPosterior(problems.box(2))], InvalidTypeError, "Wrap"),
        (OT_ONLY, InvalidTypeError, "candidates"),
    ],
)
def test_bad_lists_of_candidates_are_refused(
    candidates: Any, error: type[Exception], match: str
) -> None:
    for call in (validate, stacked):
        with pytest.raises(error, match=match):
            call(the_rope(), candidates=candidates)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: problems.vector_field_posterior("fmpe"), "density to score"),
        (lambda: problems.vector_field_posterior("npse"), "density to score"),
        (
            lambda: problems.npe_posterior("mdn", dim=1),
            r"got x \(3,\) and theta \(1,\)",
        ),
        (lambda: problems.npe_posterior("mdn", "cnn"), r"got x \(1, 8, 8\)"),
        (lambda: problems.gaussian_posterior(), "MixturePosterior"),
        (lambda: the_stack(), "StackedPosterior"),
        (lambda: None, "NoneType"),
    ],
)
@pytest.mark.parametrize("fixed", [True, False])
def test_posteriors_without_a_density_to_score_are_refused(
    make: Callable[[], Any],
    match: str,
    fixed: bool,
) -> None:
    candidate = DensityCandidate(
        name="bad", build=lambda rope, seed: make(), fixed=fixed
    )
    with pytest.raises(UnsupportedPosteriorError, match=match):
        validate(the_rope(), candidates=(OT_ONLY, candidate), num_folds=2)


def test_a_stack_cannot_be_repaired_again() -> None:
    with pytest.raises(UnsupportedPosteriorError, match="StackedPosterior"):
        RoPE(the_stack(), simulator=uneven)


@pytest.mark.parametrize("method", ["fmpe", "npse"])
def test_rope_of_a_vector_field_has_no_density_to_score(method: str) -> None:
    rope = RoPE(
        problems.vector_field_posterior(method),
        simulator=problems.simulate,
        finetuner=CalibrationFinetuner(num_steps=2, simulations_per_target=2),
    )
    rope.append_calibration(*problem(2, 6, seed=1)).train(**QUIET)
    errors = (LogProbUnavailableError, UnsupportedPosteriorError)
    for call in (validate, stacked):
        with pytest.raises(errors):
            call(rope, candidates=[OT_ONLY])


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"num_folds": 1}, "num_folds"),
        ({"num_folds": 2.5}, "num_folds"),
        ({"num_folds": True}, "num_folds"),
        ({"num_simulations": 0}, "num_simulations"),
        ({"pseudo_count": -1.0}, "pseudo_count"),
        ({"pseudo_count": math.nan}, "pseudo_count"),
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"x_o": torch.zeros(5, 4)}, "x_o"),
        ({"x_o": torch.zeros(0, 3)}, "x_o"),
        ({"x_o": torch.full((5, 3), math.nan)}, "x_o"),
    ],
)
def test_bad_arguments_are_refused(options: dict[str, Any], match: str) -> None:
    for call in (validate, stacked):
        with pytest.raises(InvalidInputError, match=match):
            call(the_rope(), **{"candidates": [OT_ONLY], "num_folds": 2, **options})


@pytest.mark.parametrize("bad", [5, 0, -1, 1.5, True])
def test_folds_to_train_on_are_fewer_than_all(bad: Any) -> None:
    with pytest.raises(InvalidInputError, match="num_training_folds"):
        validate(the_rope(), candidates=[OT_ONLY], num_training_folds=bad)


@pytest.mark.parametrize(
    "options", [{"unseen": "maybe"}, {"tail_mass": 2.0}, {"tail_mass": -0.1}]
)
def test_bad_arguments_of_the_posterior_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(options))):
        stacked(the_rope(), candidates=[OT_ONLY], num_folds=2, **options)


@pytest.mark.parametrize("call", [cross_validate, stack])
def test_something_else_than_rope_is_refused(call: Callable[..., Any]) -> None:
    for bad in (problems.npe_posterior("mdn"), None):
        with pytest.raises(InvalidTypeError, match="`rope` to be a RoPE"):
            call(bad, observed())


# --- the parts of RoPE that folds are made of ---


def test_targets_are_mean_embeddings_at_the_parameters_of_their_rows() -> None:
    rope = RoPE(
        gaussian.posterior(),
        simulator=gaussian.simulator,
        finetuner=CalibrationFinetuner(simulations_per_target=4000),
    )
    theta, x = gaussian.labelled(6)
    rope.append_calibration(theta, x)
    rows = torch.tensor([4, 0, 2])
    targets = rope.draw_targets(rows, seed=0, **QUIET)
    # h(S(theta)) = 0.8 (theta + 0.5 eps).
    error = gaussian.GAIN * gaussian.NOISE_STD / 4000**0.5
    assert torch.allclose(targets, gaussian.GAIN * theta[rows], atol=5 * error)


def test_targets_depend_on_their_own_rows_and_the_seed_only() -> None:
    theta, x = problem(2, 8, seed=1)
    rows = torch.tensor([5, 1])
    state = torch.random.get_rng_state()
    targets = untrained(pairs=(theta, x)).draw_targets(rows, seed=0, **QUIET)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert targets.shape == (2, 4)
    other = theta.clone()
    other[[0, 2, 3, 4, 6, 7]] *= -0.5
    rope = untrained(pairs=(other, x + 1))
    assert torch.equal(rope.draw_targets(rows, seed=0, **QUIET), targets)
    assert not torch.equal(rope.draw_targets(rows, seed=1, **QUIET), targets)


def test_targets_of_stored_simulations_are_the_embeddings_of_the_nearest() -> None:
    theta = problems.box(2).sample((100,))
    x = problems.simulate(theta)
    rope = untrained(simulations=(theta, x), pairs=(theta[:5] + 1e-4, x[:5] + 0.4))
    rows = torch.tensor([3, 0])
    with torch.no_grad():
        expected = rope.embedding_net(x[rows])
    assert torch.allclose(rope.draw_targets(rows, **QUIET), expected, atol=1e-6)


def test_a_rope_with_some_pairs_tunes_on_these_towards_the_targets_given() -> None:
    rope = the_rope()
    theta, x = rope.calibration
    rows = torch.tensor([7, 2, 11, 5, 3, 1])
    targets = torch.randn(6, 4)
    part = rope.with_pairs(rows, targets=targets)
    assert all(map(torch.equal, part.calibration, (theta[rows], x[rows])))
    with pytest.raises(NotReadyError):
        _ = part.tuned_embedding_net
    part.train(seed=4, **QUIET)
    expected = rope.finetuner.finetune(
        rope.embedding_net, x[rows], lambda count: targets, seed=4, **QUIET
    )
    found = part.tuned_embedding_net
    assert same(parameters(found), parameters(expected.embedding_net))


def test_targets_are_forgotten_when_pairs_are_added_or_drawn_anew_in_every_step() -> (
    None
):
    rope = the_rope()
    theta, x = rope.calibration
    rows = torch.arange(6)
    far = torch.full((6, 4), 100.0)
    grown = rope.with_pairs(rows, targets=far).append_calibration(theta[6:9], x[6:9])
    expected = rope.with_pairs(torch.arange(9)).train(seed=0, **QUIET)
    found = grown.train(seed=0, **QUIET)
    nets = (found.tuned_embedding_net, expected.tuned_embedding_net)
    assert same(parameters(nets[0]), parameters(nets[1]))

    finetuner = CalibrationFinetuner(
        num_steps=3, simulations_per_target=2, resample_targets=True
    )
    rope = untrained(finetuner=finetuner)
    nets = [
        rope.with_pairs(rows, targets=targets)
        .train(seed=0, **QUIET)
        .tuned_embedding_net
        for targets in (far, None)
    ]
    assert same(parameters(nets[0]), parameters(nets[1]))


def test_a_rope_with_some_pairs_leaves_the_other_as_it_was() -> None:
    rope = trained()
    net, (theta, x) = rope.tuned_embedding_net, rope.calibration
    part = rope.with_pairs(torch.arange(4)).train(seed=9, **QUIET)
    part.append_calibration(theta[:3], x[:3])
    assert all(map(torch.equal, rope.calibration, (theta, x)))
    assert same(parameters(rope.tuned_embedding_net), parameters(net))
    assert len(part.calibration[0]) == 7


def test_npe_and_calibration_are_copies() -> None:
    rope = the_rope()
    original = problems.npe_posterior("mdn")
    theta, x_o = problems.box(2).sample((NUM_OBSERVED,)), observed()
    expected = unnormalised(original, theta, x_o)
    assert torch.allclose(unnormalised(rope.npe, theta, x_o), expected)
    npe: Any = rope.npe
    with torch.no_grad():
        for parameter in npe.posterior_estimator.parameters():
            parameter.zero_()
    assert torch.allclose(unnormalised(rope.npe, theta, x_o), expected)
    assert torch.allclose(unnormalised(original, theta, x_o), expected)
    pairs = rope.calibration
    for value in pairs:
        value.zero_()
    assert not any(map(torch.equal, pairs, rope.calibration))


# --- what a stack is worth, where the exact posterior is known ---


def gaussian_finetuned(rope: RoPE, seed: int) -> Any:
    method = FinetunedNPE.from_posterior(
        rope.npe,
        training=Training(
            training_batch_size=50, max_num_epochs=200, stop_after_epochs=50
        ),
        learning_rates=(5e-3,),
    )
    method.append_calibration(*rope.calibration)
    return method.train(seed=seed, **QUIET).build_posterior()


SETTINGS = (
    *default_candidates(gammas=(0.05, 0.2), taus=(1.0, 0.5))[:-1],
    DensityCandidate(name="fine-tuned NPE", build=gaussian_finetuned),
)


def gaussian_rope(theta: Tensor, x: Tensor) -> RoPE:
    finetuner = CalibrationFinetuner(learning_rate=1e-2, num_steps=200, patience=50)
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator, finetuner=finetuner)
    return rope.append_calibration(theta, x).train(seed=0, **QUIET)


def gaussian_stack(
    theta: Tensor, x: Tensor, x_o: Tensor, *, seed: int = 0
) -> StackedPosterior:
    return stack(
        gaussian_rope(theta, x),
        x_o,
        candidates=SETTINGS,
        num_simulations=300,
        seed=seed,
        **QUIET,
    )


def mean_score(posterior: Any, theta: Tensor, x: Tensor) -> float:
    with torch.no_grad():
        return float(posterior.log_prob_batched(theta, x).double().mean())


def exact_score(theta: Tensor, x_s: Tensor) -> float:
    """Of the exact posterior given the simulations behind the observations."""
    return float(gaussian.exact_posterior(x_s).log_prob(theta).double().mean())


@pytest.mark.slow
def test_with_more_pairs_a_stack_approaches_the_exact_posterior() -> None:
    theta_o, x_o = gaussian.labelled(300)
    exact = exact_score(theta_o, gaussian.undo(x_o))
    missing = torch.zeros(2, 3)
    for row in missing:
        theta, x = gaussian.labelled(400)
        for k, n in enumerate((10, 50, 400)):
            posterior = gaussian_stack(theta[:n], x[:n], x_o)
            row[k] = exact - mean_score(posterior, theta_o, x_o)
    few, some, many = missing.mean(dim=0)
    assert few > some > many
    assert many < 0.1


@pytest.mark.slow
def test_held_out_scores_agree_with_scores_on_test_observations() -> None:
    theta_o, x_o = gaussian.labelled(300)
    away = []
    for repetition in range(8):
        posterior = gaussian_stack(*gaussian.labelled(40), x_o, seed=repetition)
        scores = posterior.report.cross_validation.stack_scores
        error = float(scores.std()) / len(scores) ** 0.5
        difference = float(scores.mean()) - mean_score(posterior, theta_o, x_o)
        away.append(difference / error)
    # In standard errors; the folds train on fewer pairs, which costs a little.
    assert sum(abs(z) < 2 for z in away) >= 6
    assert abs(sum(away) / 8) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("n", [10, 50])
def test_where_the_simulator_is_right_a_stack_loses_a_tenth_of_a_nat_at_most(
    n: int,
) -> None:
    """Against NPE, which is exact here; on average over observations."""
    theta_o = gaussian.prior().sample((300,))
    x_o = gaussian.simulator(theta_o)
    theta = gaussian.prior().sample((n,))
    posterior = gaussian_stack(theta, gaussian.simulator(theta), x_o)
    loss = exact_score(theta_o, x_o) - mean_score(posterior, theta_o, x_o)
    assert loss < 0.1


@pytest.mark.slow
def test_labels_that_say_nothing_make_a_stack_the_prior() -> None:
    theta_o, x_o = gaussian.labelled(300)
    theta, x = gaussian.labelled(50)
    posterior = gaussian_stack(theta.roll(1, dims=0), x, x_o)
    at_prior = float(gaussian.prior().log_prob(theta_o).mean())
    lost = at_prior - mean_score(posterior, theta_o, x_o)
    assert lost < 0.1


@pytest.mark.slow
def test_a_stack_is_calibrated_on_pairs_that_it_has_not_seen() -> None:
    _, x_o = gaussian.labelled(300)
    posterior = gaussian_stack(*gaussian.labelled(150), x_o)
    levels = posterior.report.cross_validation.levels().double()
    # Uniform, with four standard errors on the mean.
    assert ((levels.mean(dim=0) - 0.5).abs() < 4 / (12 * 150) ** 0.5).all()
    coverage = (levels < 0.9).double().mean(dim=0)
    assert ((coverage - 0.9).abs() < 0.1).all()

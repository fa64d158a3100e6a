"""Stacks of trained candidates: density, samples, and what they are made of."""

import itertools
import math
import pickle
from typing import Any

import pytest
import torch

from sbi_rope import CalibrationFinetuner, RoPE, SinkhornCoupler
from sbi_rope.errors import (
    RoPEWarning,
    UnseenObservationError,
)
from sbi_rope.stacking import (
    CouplingCandidate,
    stacking_weights,
)
from tests import problems
from tests.stacks import (
    CANDIDATES,
    COUPLINGS,
    FINETUNED,
    NPE,
    NUM_OBSERVED,
    NUM_SIMULATED,
    OT_ONLY,
    PRIOR,
    QUIET,
    coupled_by_hand,
    midpoints,
    net_of,
    observed,
    rope_of,
    stacked,
    the_rope,
    the_scores,
    the_stack,
    trained,
    unnormalised,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


def test_couplings_of_a_stack_are_the_couplings_of_rope_at_their_settings() -> None:
    rope, posterior = the_rope(), the_stack()
    nets = [net_of(COUPLINGS[k], rope) for k in (0, 2, 4)]
    for net, other in itertools.combinations(nets, 2):
        assert (net(posterior.x_o) - other(posterior.x_o)).abs().max() > 0.1
    theta = problems.box(2).sample((NUM_OBSERVED,))
    estimator: Any = posterior.posterior_estimator
    found = estimator.candidate_log_probs(theta, posterior.x_o)
    assert found.shape == (NUM_OBSERVED, len(CANDIDATES))
    contexts = problems.simulated_of(posterior)
    for k, candidate in enumerate(COUPLINGS):
        alone = coupled_by_hand(candidate, rope, posterior.x_o, contexts)
        used = estimator.coupled[0].couplings[k]
        assert (used.tau, used.gamma) == (candidate.tau, alone.coupling.gamma)
        expected = unnormalised(alone, theta, posterior.x_o)[0]
        assert torch.allclose(found[:, k].float(), expected, atol=1e-3)


@pytest.mark.parametrize("candidate", COUPLINGS)
def test_with_the_same_simulations_build_posterior_gives_the_same_density(
    candidate: CouplingCandidate,
) -> None:
    theta = problems.box(2).sample((NUM_SIMULATED,))
    simulations = (theta, problems.simulate(theta))
    rope = rope_of(candidate, trained(simulations=simulations))
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
    assert torch.allclose(weights, estimator.candidate_weights)
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
    couplings = estimator.coupled[0].couplings
    for k, candidate in enumerate(COUPLINGS):
        net = net_of(candidate, rope)
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
            coupled_by_hand(c, rope, posterior.x_o, estimator.coupled[0].simulated),
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

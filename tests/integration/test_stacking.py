"""Stacks of trained candidates: density, samples, copies and kinds of data."""

import copy
import math
import pickle
import warnings
from typing import Any

import pytest
import torch
from sbi.utils import BoxUniform
from torch import Tensor, nn

from sbi_rope import RoPE
from sbi_rope._sbi import DirectPosterior, estimator_of
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture import MixturePosterior
from sbi_rope.stacking import (
    DensityCandidate,
    DiscrepancyCandidate,
    RehearsedCandidate,
    default_candidates,
    stacking_weights,
)
from sbi_rope.stacking.workbench import Workbench
from tests import gaussian, problems
from tests.stacks import (
    FINETUNED,
    FITTED,
    NPE,
    NUM_FOLDS,
    NUM_OBSERVED,
    NUM_PAIRS,
    PRIOR,
    QUIET,
    observed,
    problem,
    rope_of,
    stacked,
    the_stack,
    uneven,
    unnormalised,
    validated,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


# --- density ---


def test_a_stack_of_one_candidate_is_the_average_of_its_versions() -> None:
    built: list[Any] = []

    def build(rope: RoPE, seed: int) -> Any:
        built.append(FINETUNED.build(rope, seed))
        return built[-1]

    candidate = DensityCandidate(name="one", build=build)
    posterior = stacked(rope_of(), candidates=[candidate])
    assert len(built) == 4  # without each of three folds, and on all
    x = observed()
    theta = 3 * torch.rand(4, NUM_OBSERVED, 2) - 1.5
    found = posterior.posterior_estimator.log_prob(theta, x)
    with torch.no_grad():
        versions = [p.posterior_estimator.log_prob(theta, x).exp() for p in built]
    assert torch.allclose(found.exp(), sum(versions) / 4, atol=1e-5)
    single = posterior.candidate_log_probs(theta[0], x)
    assert torch.allclose(single[:, 0].float(), found[0], atol=1e-4)


@pytest.mark.medium
def test_the_density_is_the_weighted_sum_of_the_candidates() -> None:
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    posterior = the_stack()
    scores = posterior.report.cross_validation
    expected = stacking_weights(scores.log_scores).weights
    assert list(posterior.candidate_weights.values()) == expected.tolist()
    assert list(posterior.candidate_weights) == list(scores.names)
    versions = posterior.versions
    each = torch.stack(
        [versions.log_probs(theta, x, [v]) for v in range(len(versions.trained))]
    )
    averaged = each.exp().mean(dim=0)
    by_candidate = posterior.candidate_log_probs(theta, x)
    assert torch.allclose(by_candidate.exp(), averaged, atol=1e-4)
    found = unnormalised(posterior, theta, x)[0].exp()
    mixed = (averaged @ expected).float()
    # It may leave out the smallest weights, up to a thousandth.
    assert torch.allclose(found, mixed, rtol=1e-3, atol=2e-3)


@pytest.mark.medium
def test_the_normalised_density_has_mass_one_and_samples_follow_it() -> None:
    x, draws = observed()[:3], 1000
    line = (torch.arange(40) + 0.5) / 20 - 1
    theta = torch.cartesian_prod(line, line)[:, None].expand(-1, 3, -1)
    posterior = the_stack()
    density = posterior.log_prob_batched(theta, x).exp().double()
    mass = 4 * density.mean(dim=0)
    assert torch.allclose(mass, torch.ones(3).double(), atol=0.05)
    # They leak, or there would be nothing to normalise.
    assert (posterior.leakage(x).mass < 0.999).any()
    samples = posterior.sample_batched((draws,), x, **QUIET)
    assert (samples.abs() <= 1).all()
    for i in range(3):
        share = density[:, i].reshape(4, 10, 4, 10).sum(dim=(1, 3))
        share = share / share.sum()
        edges = [torch.linspace(-1, 1, 5)] * 2
        counts = torch.histogramdd(samples[:, i], edges).hist / draws
        error = (share * (1 - share) / draws).sqrt()
        assert ((counts - share).abs() < 4.5 * error + 0.01).all()


@pytest.mark.medium
def test_an_observation_alone_has_the_density_that_it_has_among_others() -> None:
    posterior = the_stack()
    x = torch.cat([observed(), 3 * torch.randn(5, 3)])
    theta = problems.box(2).sample((len(x),))
    together = unnormalised(posterior, theta, x)[0]
    normalised = posterior.log_prob_batched(theta, x)[0]
    error = posterior.leakage(x)
    for i in (0, 7, 27):
        alone = posterior.log_prob(theta[i], x=x[i], norm_posterior=False)
        assert torch.allclose(alone, together[i], atol=1e-5)
        difference = posterior.log_prob(theta[i], x=x[i]) - normalised[i]
        margin = 6 * float(error.standard_error[i] / error.mass[i])
        assert abs(float(difference)) < margin
    assert posterior.is_amortised
    with pytest.raises(InvalidInputError, match="amortised"):
        _ = posterior.x_o


# --- copies ---


@pytest.mark.medium
def test_copies_and_small_pickles_have_the_same_densities() -> None:
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    posterior = the_stack()
    expected = posterior.log_prob_batched(theta, x)
    candidates = posterior.candidate_log_probs(theta, x)
    file = pickle.dumps(posterior)
    assert len(file) < 3e6
    assert len(pickle.dumps(posterior.report)) < 2e4
    for other in (pickle.loads(file), copy.deepcopy(posterior)):
        assert torch.equal(other.log_prob_batched(theta, x), expected)
        assert torch.equal(other.candidate_log_probs(theta, x), candidates)
        assert str(other.report) == str(posterior.report)
        other.to("cpu")
        assert torch.equal(other.candidate_log_probs(theta, x), candidates)
        # The density and the candidates share their parts, and so move together.
        estimator = other.posterior_estimator
        shown = {id(part) for part in estimator.parts}
        for version in other.versions.trained:
            parts = [part for of_one in version.values() for part in of_one]
            assert {*map(id, parts)} <= shown


def test_a_stack_of_candidates_that_lambdas_built_can_be_pickled() -> None:
    candidates = [
        DensityCandidate(name="mine", build=lambda rope, seed: rope.npe),
        DensityCandidate(name="older", build=lambda rope, seed: rope.npe, fixed=True),
    ]
    posterior = stacked(rope_of(), candidates=candidates)
    assert pickle.loads(pickle.dumps(posterior)).candidate_weights == (
        posterior.candidate_weights
    )


@pytest.mark.gpu
def test_a_stack_and_its_candidates_move_to_a_gpu() -> None:
    posterior = copy.deepcopy(the_stack())
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    expected = posterior.candidate_log_probs(theta, x)
    density = unnormalised(posterior, theta, x)
    posterior.to("cuda")
    found = posterior.candidate_log_probs(theta.cuda(), x.cuda()).cpu()
    assert torch.allclose(found, expected, atol=1e-3)
    moved = unnormalised(posterior, theta.cuda(), x.cuda()).cpu()
    assert torch.allclose(moved, density, atol=1e-3)


# --- data of all kinds ---


@pytest.mark.medium
@pytest.mark.parametrize(
    ("family", "embedding"),
    [
        ("maf", "none"),
        pytest.param("zuko_maf", "linear", marks=pytest.mark.slow),
        pytest.param("mnpe", "linear", marks=pytest.mark.slow),
    ],
)
def test_every_family_can_be_stacked(family: str, embedding: str) -> None:
    prior = problems.npe_posterior(family, embedding).prior
    theta = prior.sample((30,))
    x = problems.simulate(theta) + 0.4
    rope = rope_of((theta[:8], x[:8]), family=family, embedding=embedding)
    # Without an embedding net there is nothing to tune.
    candidates = default_candidates()[: 4 if embedding == "none" else 6]
    posterior = stacked(rope, candidates=candidates)
    assert posterior.report.cross_validation.log_scores.isfinite().all()
    assert posterior.log_prob_batched(theta[8:], x[8:]).isfinite().all()
    samples = posterior.sample_batched((3,), x[8:], **QUIET)
    assert samples.shape == (3, 22, theta.shape[1])


@pytest.mark.slow
def test_images_are_stacked_without_candidates_that_need_summaries() -> None:
    theta = problems.box(2).sample((20,))
    x = problems.simulate_image(theta) + 0.3
    rope = rope_of(
        (theta[:10], x[:10]), embedding="cnn", simulator=problems.simulate_image
    )
    posterior = stacked(rope)
    assert set(posterior.candidate_weights) == {
        *("prior", "NPE", "fine-tuned NPE", "discrepancy", "discrepancy (tuned)"),
        *("discrepancy, fine-tuned", "discrepancy (tuned), fine-tuned"),
    }
    assert posterior.log_prob_batched(theta, x).isfinite().all()
    names = [candidate.name for candidate in default_candidates(rope)]
    assert names == list(posterior.candidate_weights)
    # With a hundred pairs of images NPE is trained on pairs and simulations alike.
    theta = problems.box(2).sample((100,))
    rope.append_calibration(theta[:89], problems.simulate_image(theta[:89]))
    assert [c.name for c in default_candidates(rope)] == names
    rope.append_calibration(theta[89:90], problems.simulate_image(theta[89:90]))
    assert [c.name for c in default_candidates(rope)] == [
        *names,
        "fine-tuned NPE, rehearsed",
    ]
    scores = validated(rope, candidates=[RehearsedCandidate()])
    assert scores.log_scores.isfinite().all()
    assert not RehearsedCandidate().applies_to(workbench(rope, num_folds=2))
    # A short vector is no series, also if one of its entries is missing.
    bench = workbench(rope_of(problem(100, seed=1)), num_folds=5)
    assert not RehearsedCandidate().applies_to(bench)
    bench.x = bench.x.clone().index_fill(0, torch.tensor([3]), torch.nan)
    assert not RehearsedCandidate().applies_to(bench)
    candidates = [PRIOR, DensityCandidate(name="never", build=never)]
    candidates += [DiscrepancyCandidate(space="input")]
    with pytest.raises(InvalidInputError, match="space='embedding'"):
        stacked(rope, candidates=candidates)


def workbench(rope: RoPE, *, num_folds: int) -> Workbench:
    return Workbench(rope, num_folds=num_folds, seed=0, show_progress_bars=False)


def never(rope: RoPE, seed: int) -> Any:
    raise AssertionError("The candidate that cannot be trained was not found first.")


def long_series(theta: Tensor) -> Tensor:
    return theta @ torch.ones(2, 24) + 0.1 * torch.randn(len(theta), 24)


@pytest.mark.medium
def test_moments_of_a_long_series_are_those_of_its_embedding_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    estimator = gaussian.GaussianEstimator(2)
    estimator.net = nn.Sequential(nn.Linear(24, 2), estimator.net)
    estimator._condition_shape = torch.Size((24,))
    npe = DirectPosterior(estimator, problems.box(2))
    theta = problems.box(2).sample((8,))
    rope = RoPE(npe, simulator=long_series)
    rope.append_calibration(theta, long_series(theta))
    seen: list[int] = []
    moments = type(rope.source).moments

    def spied(*args: Any, **options: Any) -> Any:
        found = moments(*args, **options)
        seen.append(found.covariance.shape[-1])
        return found

    monkeypatch.setattr(type(rope.source), "moments", spied)
    names = stacked(rope).candidate_weights
    assert set(seen) == {2}
    assert "discrepancy (input)" not in names
    # It is trained if the user asks for it.
    stacked(rope, candidates=[DiscrepancyCandidate(space="input")])
    assert 24 in seen


@pytest.mark.slow
def test_a_stack_can_use_stored_simulations() -> None:
    theta = problems.box(2).sample((200,))
    x = problems.simulate(theta)
    cases: list[tuple[int, dict[str, Any]]] = [
        (15, {}),
        (200, {"candidates": [NPE, FINETUNED, DiscrepancyCandidate()]}),
    ]
    for count, options in cases:
        rope = rope_of(simulations=(theta[:count], x[:count]))
        posterior = stacked(rope, **options)
        scores = posterior.report.cross_validation.log_scores
        assert scores.isfinite().all(), count
        samples = posterior.sample_batched((2,), observed(10), **QUIET)
        assert samples.isfinite().all(), count


class Untransformed(BoxUniform):
    """A prior that sbi cannot map to an unbounded space."""

    @property
    def support(self) -> Any:
        raise NotImplementedError


@pytest.mark.slow
def test_a_prior_that_sbi_cannot_transform_can_be_used() -> None:
    prior = Untransformed(-torch.ones(2), torch.ones(2))
    npe = DirectPosterior(
        estimator_of(problems.npe_posterior("mdn", "linear")),
        prior,
        enable_transform=False,
    )
    rope = RoPE(npe, simulator=uneven).append_calibration(*problem(8, seed=1))
    posterior = stacked(rope, candidates=[PRIOR, FINETUNED], num_folds=3)
    assert not posterior.enable_transform
    samples = posterior.sample_batched((5,), observed(4), **QUIET)
    assert (samples.abs() <= 1).all()


@pytest.mark.medium
def test_few_pairs_are_held_out_one_by_one() -> None:
    for num_pairs in (2, 3):
        with warnings.catch_warnings():
            # How many pairs a version is trained on is no choice of the user.
            warnings.filterwarnings("error", message="Only .* none is held out")
            posterior = stacked(rope_of(problem(num_pairs, seed=1)))
        scores = posterior.report.cross_validation
        assert scores.num_folds == num_pairs
        assert scores.log_scores.isfinite().all()
        assert scores.stack_scores.isfinite().all()
        assert math.isclose(sum(posterior.candidate_weights.values()), 1.0)
        assert posterior.sample((2,), x=observed(1), **QUIET).shape == (2, 2)
        assert str(posterior.report)


# --- what the user passes ---


@pytest.mark.medium
def test_a_stack_changes_nothing_that_it_is_given_and_follows_from_its_seed() -> None:
    rope, x_o = rope_of(), observed()
    rope.train(seed=0, **QUIET)
    npe = problems.npe_posterior("mdn")
    nets = [npe.posterior_estimator, rope.tuned_embedding_net]
    before = [copy.deepcopy(net.state_dict()) for net in nets]
    held = [value.clone() for value in (x_o, *rope.calibration)]
    coupler, finetuner = rope.coupler, rope.finetuner
    torch.manual_seed(5)
    state = torch.get_rng_state()
    posterior = stacked(rope)
    assert torch.equal(torch.get_rng_state(), state)
    assert all(map(torch.equal, (x_o, *rope.calibration), held))
    assert (rope.coupler, rope.finetuner) == (coupler, finetuner)
    nets = [npe.posterior_estimator, rope.tuned_embedding_net]
    for net, old in zip(nets, before, strict=True):
        assert all(map(torch.equal, net.state_dict().values(), old.values()))
    # The seed decides, and not whether the RoPE was trained.
    theta = problems.box(2).sample((NUM_OBSERVED,))
    found, expected = (p.log_prob_batched(theta, x_o) for p in (posterior, the_stack()))
    assert torch.equal(found, expected)


def test_a_stack_does_not_change_with_the_posteriors_it_was_made_of() -> None:
    another = copy.deepcopy(problems.npe_posterior("maf", "linear"))
    another.posterior_estimator.train()  # scored in evaluation mode all the same
    candidate = DensityCandidate(
        name="older", build=lambda rope, seed: another, fixed=True
    )
    posterior = stacked(rope_of(), candidates=[candidate, PRIOR])
    theta, x = problem(NUM_PAIRS, seed=1)
    scores = posterior.report.cross_validation.scores_of("older")
    another.posterior_estimator.eval()
    expected = unnormalised(another, theta, x)[0]
    assert torch.allclose(scores.float(), expected, atol=1e-4)
    before = unnormalised(posterior, theta, x)
    with torch.no_grad():
        for parameter in another.posterior_estimator.parameters():
            parameter += 0.1
    assert torch.equal(unnormalised(posterior, theta, x), before)


@pytest.mark.medium
def test_a_mixture_counts_as_one_version_regardless_of_its_number_of_parts() -> None:
    sizes: list[int] = []
    theirs: list[Any] = []

    def build(rope: RoPE, seed: int) -> Any:
        # One density in the first versions, three in the last, of the prior in part.
        sizes.append(1 if len(sizes) < NUM_FOLDS else 3)
        own = stacked(rope_of(), candidates=[NPE]).posterior_estimator.parts
        prior = stacked(rope_of(), candidates=[PRIOR]).posterior_estimator.parts
        parts = own if sizes[-1] == 1 else [*prior, *prior, *own]
        mixture = type(the_stack().posterior_estimator)(
            parts, [1 / sizes[-1]] * sizes[-1]
        )
        theirs.extend(mixture.parts)
        return MixturePosterior(mixture, rope.npe.prior)

    posterior = stacked(
        rope_of(), candidates=[DensityCandidate(name="mixed", build=build)]
    )
    assert sizes == [1] * NUM_FOLDS + [3]
    assert not {*map(id, posterior.posterior_estimator.parts)} & {*map(id, theirs)}
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    npe = the_stack().candidate_log_probs(theta, x)[:, 1].exp()
    expected = (NUM_FOLDS * npe + (2 * 0.25 + npe) / 3) / (NUM_FOLDS + 1)
    found = posterior.candidate_log_probs(theta, x)[:, 0].exp()
    assert torch.allclose(found, expected, atol=1e-5)
    density = unnormalised(posterior, theta, x)[0].exp()
    assert torch.allclose(density.double(), expected, atol=1e-4)


def test_default_candidates_have_different_names() -> None:
    assert [candidate.name for candidate in default_candidates()] == [
        *("prior", "NPE", "fine-tuned NPE", "discrepancy", "discrepancy (input)"),
        *("discrepancy (tuned)", "discrepancy, fine-tuned"),
        *("discrepancy (input), fine-tuned", "discrepancy (tuned), fine-tuned"),
        "fine-tuned NPE, rehearsed",
    ]


def test_default_candidates_can_keep_the_prior_of_npe() -> None:
    kept = default_candidates(learn_prior=False)
    assert [candidate.name for candidate in kept] == [
        *("prior", "NPE", "discrepancy, given prior"),
        *("discrepancy (input), given prior", "discrepancy (tuned), given prior"),
    ]
    assert all(candidate.fixed or not candidate.learns_prior for candidate in kept)


@pytest.mark.medium
def test_without_a_seed_the_state_of_torch_decides() -> None:
    found = []
    for state in (5, 5, 6):
        torch.manual_seed(state)
        scores = validated(rope_of(), candidates=[FITTED], seed=None)
        found.append((scores.fold, scores.log_scores))
    assert torch.equal(found[0][1], found[1][1])
    assert not torch.equal(found[0][0], found[2][0])
    seeded = [validated(rope_of(), candidates=[FITTED], seed=s).fold for s in (0, 1)]
    assert not torch.equal(*seeded)

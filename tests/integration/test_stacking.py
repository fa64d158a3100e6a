"""Stacks of trained candidates: scores, density, samples, copies and kinds of data."""

import copy
import math
import pickle
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_rope import load
from sbi_rope.density import Mixture, MixturePosterior, Prior
from sbi_rope.saving import save
from sbi_rope.stacking import (
    DiscrepancyCandidate,
    FinetunedCandidate,
    GivenCandidate,
    default_candidates,
    stacking_weights,
)
from sbi_rope.utils.errors import (
    InvalidInputError,
    NotReadyError,
    SamplingError,
    UnsupportedPosteriorError,
)
from tests import problems
from tests.stacks import (
    BOX,
    NPE,
    NUM_FOLDS,
    NUM_OBSERVED,
    NUM_PAIRS,
    PRIOR,
    QUIET,
    Box,
    data_of,
    observed,
    problem,
    rope_of,
    scores_of,
    small_stack,
    stacked,
    the_stack,
    trained,
    unnormalised,
    validated,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning")


# --- scores ---


def test_every_pair_is_held_out_once_and_trains_all_other_folds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[list[Tensor]] = []

    def spied(self: Box, data: Any, versions: Any) -> Any:
        seen.append(versions)
        return PRIOR.fit(data, versions)

    monkeypatch.setattr(Box, "fit", spied)
    # By default there are five folds, and never more folds than pairs.
    for num_pairs, num_folds, sizes in (
        (13, 5, [2, 2, 3, 3, 3]),
        (4, 5, [1] * 4),
        (9, 2, [4, 5]),
    ):
        pairs = problem(num_pairs, seed=1)
        scores = validated(rope_of(pairs), candidates=[BOX], num_folds=num_folds)
        assert sorted(scores.fold.bincount().tolist()) == sizes
        assert scores.fold.tolist() != sorted(scores.fold.tolist())
        *versions, last = seen.pop()
        assert sorted(last.tolist()) == list(range(num_pairs))
        for number, rows in enumerate(versions):
            expected = (scores.fold != number).nonzero().flatten()
            assert sorted(rows.tolist()) == expected.tolist()


@pytest.mark.medium
def test_a_fold_is_scored_by_versions_without_it_and_weighted_by_the_others() -> None:
    posterior = the_stack()
    scores, (theta, x) = posterior.report, problem(NUM_PAIRS, seed=1)
    for number in range(NUM_FOLDS):
        rows = scores.fold == number
        parts = [one[number] for one in posterior.versions]
        of_parts = [part.log_prob(theta[rows][None], x[rows])[0] for part in parts]
        expected = torch.stack(of_parts, dim=1).double()
        assert torch.allclose(scores.log_scores[rows], expected, atol=1e-4)
        weights = stacking_weights(scores.log_scores[~rows])
        mixed = torch.logsumexp(scores.log_scores[rows] + weights.log(), dim=1)
        assert torch.allclose(scores.comparable_scores[rows], mixed)
        without = MixturePosterior(Mixture(parts, weights), posterior.prior)
        mass = without.leakage_correction(x[rows])
        expected = mixed - mass.log()
        error = 6 * problems.error_of_mass(mass)
        assert ((scores.held_out.log_prob[rows] - expected).abs() < error + 1e-5).all()
        samples = without.sample_batched((400,), x[rows], **QUIET)
        below = (samples < theta[rows]).double().mean(dim=0)
        # Four standard errors of 40 samples, two-sided.
        found = scores.held_out.levels[rows].double()
        assert torch.allclose(found, (2 * below - 1).abs(), atol=0.65)


def test_the_stack_of_each_fold_is_normalised_by_its_own_mass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its mass inside the prior differs from fold to fold."""

    widths = 1.5 + torch.arange(4)

    def fit(self: Box, data: Any, versions: Any) -> Any:
        return [Prior(problems.box(2, -w, w), (3,)) for w in widths.tolist()]

    monkeypatch.setattr(Box, "fit", fit)
    scores = validated(rope_of(), candidates=[BOX])
    # After normalisation all versions are uniform on the box of the prior.
    raw = -2 * (2 * widths).log().double()[scores.fold]
    assert torch.allclose(scores.log_scores[:, 0], raw, atol=1e-5)
    off = scores.held_out.log_prob - math.log(0.25)
    assert float(off.abs().max()) < 0.7
    assert float(off.mean()) == pytest.approx(0.0, abs=0.15)


def test_the_density_is_the_weighted_sum_of_averages_of_versions() -> None:
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    posterior = the_stack()
    scores = posterior.report
    expected = stacking_weights(scores.log_scores)
    assert list(posterior.candidate_weights.values()) == expected.tolist()
    assert list(posterior.candidate_weights) == list(scores.names)
    of_versions = torch.stack(
        [
            torch.stack([of_one[v].log_prob(theta[None], x)[0] for v in range(4)])
            for of_one in posterior.versions
        ],
        dim=2,
    )
    averaged = of_versions.double().logsumexp(dim=0) - math.log(4)
    by_candidate = posterior.candidate_log_probs(theta, x)
    assert torch.allclose(by_candidate, averaged, atol=1e-4)
    found = unnormalised(posterior, theta, x)[0].double()
    mixed = (averaged + expected.log()).logsumexp(dim=1)
    assert torch.allclose(found, mixed, atol=1e-4)


@pytest.mark.medium
def test_the_normalised_density_has_mass_one_and_samples_follow_it() -> None:
    x, draws = observed()[:3], 1000
    line = (torch.arange(40) + 0.5) / 20 - 1
    theta = torch.cartesian_prod(line, line)[:, None].expand(-1, 3, -1)
    posterior = the_stack()
    density = posterior.log_prob_batched(theta, x).exp().double()
    assert torch.allclose(4 * density.mean(dim=0), torch.ones(3).double(), atol=0.05)
    # They leak, or there would be nothing to normalise.
    assert (posterior.leakage_correction(x) < 0.999).any()
    samples = posterior.sample_batched((draws,), x, **QUIET)
    assert (samples.abs() <= 1).all()
    for i in range(3):
        share = density[:, i].reshape(4, 10, 4, 10).sum(dim=(1, 3))
        share = share / share.sum()
        edges = [torch.linspace(-1, 1, 5)] * 2
        counts = torch.histogramdd(samples[:, i], edges).hist / draws
        error = (share * (1 - share) / draws).sqrt()
        assert ((counts - share).abs() < 4.5 * error + 0.01).all()


# --- copies ---


@pytest.mark.medium
def test_copies_pickles_and_files_have_the_same_densities(tmp_path: Path) -> None:
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    posterior = the_stack()
    expected = posterior.log_prob_batched(theta, x)
    candidates = posterior.candidate_log_probs(theta, x)
    save(posterior, tmp_path / "stack.pt")
    pickled = pickle.loads(pickle.dumps(posterior))
    for other in (pickled, copy.deepcopy(posterior), load(tmp_path / "stack.pt")):
        assert torch.equal(other.log_prob_batched(theta, x), expected)
        assert str(other.report) == str(posterior.report)
        other.to("cpu")
        assert torch.equal(other.candidate_log_probs(theta, x), candidates)


@pytest.mark.gpu
def test_a_stack_and_its_candidates_move_to_a_gpu() -> None:
    posterior = copy.deepcopy(the_stack())
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    expected = posterior.candidate_log_probs(theta, x)
    posterior.to("cuda")
    found = posterior.candidate_log_probs(theta.cuda(), x.cuda()).cpu()
    assert torch.allclose(found, expected, atol=1e-3)


# --- data of all kinds ---


@pytest.mark.medium
@pytest.mark.parametrize(
    "family",
    [
        "maf",
        *(pytest.param(f, marks=pytest.mark.slow) for f in ("nsf", "zuko_maf", "mnpe")),
    ],
)
def test_every_family_can_be_stacked(family: str) -> None:
    embedding = "none" if family == "maf" else "linear"
    prior = problems.npe_posterior(family, embedding).prior
    theta = prior.sample((30,))
    x = problems.simulate(theta) + 0.4
    rope = rope_of((theta[:8], x[:8]), family=family, embedding=embedding)
    posterior = stacked(rope)
    assert posterior.report.log_scores.isfinite().all()
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
    names = {candidate.name for candidate in default_candidates(rope)}
    assert names == {*posterior.candidate_weights}
    assert names == {
        *("prior", "NPE", "fine-tuned NPE", "discrepancy", "discrepancy (tuned)"),
        *("discrepancy, fine-tuned", "discrepancy (tuned), fine-tuned"),
        *("regression", "regression (embedding)"),
    }
    assert posterior.log_prob_batched(theta, x).isfinite().all()
    # With a hundred pairs of images NPE is trained on pairs and simulations alike.
    theta = problems.box(2).sample((90,))
    rehearsed = FinetunedCandidate(rehearse=True)
    rope.append_calibration(theta[1:], problems.simulate_image(theta[1:]))
    assert not rehearsed.suits(data_of(rope))
    rope.append_calibration(theta[:1], problems.simulate_image(theta[:1]))
    assert {c.name for c in default_candidates(rope)} == {*names, rehearsed.name}
    assert validated(rope, candidates=[rehearsed]).log_scores.isfinite().all()
    # A short vector is no series.
    assert not rehearsed.suits(data_of(rope_of(problem(100, seed=1))))
    with pytest.raises(InvalidInputError, match="space='embedding'"):
        stacked(rope, candidates=[PRIOR, DiscrepancyCandidate(space="input")])


@pytest.mark.medium
def test_few_pairs_are_held_out_one_by_one() -> None:
    for num_pairs in (2, 3):
        with warnings.catch_warnings():
            # How many pairs a version is trained on is no choice of the user.
            warnings.filterwarnings("error", message="Only .* none is held out")
            posterior = stacked(rope_of(problem(num_pairs, seed=1)))
        scores = posterior.report
        assert len(scores.fold.unique()) == num_pairs
        assert scores.held_out.log_prob.isfinite().all()
        assert posterior.sample((2,), x=observed(1), **QUIET).shape == (2, 2)
        assert str(posterior.report)


# --- what the user passes ---


@pytest.mark.medium
def test_a_stack_changes_nothing_that_it_is_given_and_follows_from_its_seed() -> None:
    rope, x_o = rope_of(), observed()
    rope.train(seed=0, **QUIET)
    estimator = problems.npe_posterior("mdn").posterior_estimator

    def given() -> list[Tensor]:
        nets = estimator, rope.tuned_embedding_net
        weights = [value for net in nets for value in net.state_dict().values()]
        return [*weights, rope.pairs.mean, rope.pairs.x]

    before = copy.deepcopy(given())
    torch.manual_seed(5)
    state = torch.get_rng_state()
    posterior = stacked(rope)
    assert torch.equal(torch.get_rng_state(), state)
    assert all(map(torch.equal, given(), before))
    # The seed decides, and not whether the RoPE was trained.
    theta = problems.box(2).sample((NUM_OBSERVED,))
    found, expected = (p.log_prob_batched(theta, x_o) for p in (posterior, the_stack()))
    assert torch.equal(found, expected)


def test_a_seed_gives_the_scores_and_weights_that_it_gave_before() -> None:
    report = the_stack().report
    recorded = {
        "prior": (-1.386, 0.026),
        "NPE": (-1.554, 0.009),
        "fine-tuned NPE": (-1.554, 0.009),
        "discrepancy": (-1.538, 0.009),
        "discrepancy (input)": (-1.549, 0.009),
        "discrepancy (input), fine-tuned": (-1.549, 0.009),
        "regression": (0.713, 0.359),
        "regression (embedding)": (0.943, 0.569),
    }
    columns = torch.stack([report.log_scores.mean(dim=0), report.weights], dim=1)
    found = dict(zip(report.names, columns.tolist(), strict=True))
    for name, numbers in recorded.items():
        assert found.pop(name) == pytest.approx(numbers, abs=0.02), name
    assert not found
    assert report.held_out.lpp.mean == pytest.approx(0.898, abs=0.02)


def test_without_a_seed_the_state_of_torch_decides() -> None:
    found = []
    for state in (5, 5, 6):
        torch.manual_seed(state)
        scores = validated(rope_of(), candidates=[BOX], seed=None)
        found.append((scores.fold, scores.log_scores))
    assert torch.equal(found[0][1], found[1][1])
    assert not torch.equal(found[0][0], found[2][0])


class Wide(Prior):
    """A density of a user: normal around zero, whatever x is."""

    def __init__(self) -> None:
        super().__init__(MultivariateNormal(torch.zeros(2), 4 * torch.eye(2)), (3,))


def test_densities_that_are_given_are_stacked_as_they_are() -> None:
    another = copy.deepcopy(problems.npe_posterior("maf", "linear"))
    another.posterior_estimator.train()  # scored in evaluation mode all the same
    posterior = stacked(
        rope_of(),
        candidates=[GivenCandidate(another, "older"), Wide(), small_stack(), PRIOR],
    )
    assert list(posterior.candidate_weights) == [
        *("older", "Wide", "StackedPosterior", "prior")
    ]
    theta, x = problem(NUM_PAIRS, seed=1)
    scores = posterior.report
    another.posterior_estimator.eval()
    for name, expected in (
        ("older", unnormalised(another, theta, x)[0]),
        ("Wide", Wide().log_prob(theta, x)[0]),
        ("StackedPosterior", unnormalised(small_stack(), theta, x)[0]),
    ):
        assert torch.allclose(scores_of(scores, name).float(), expected, atol=1e-4)
    before = unnormalised(posterior, theta, x)
    with torch.no_grad():
        for parameter in another.posterior_estimator.parameters():
            parameter += 0.1
    assert torch.equal(unnormalised(posterior, theta, x), before)
    wide = stacked(rope_of(), candidates=[Wide()])
    drawn = wide.sample((2000,), x=x[0], reject_outside_prior=False, **QUIET)
    assert float(drawn.std()) == pytest.approx(2.0, rel=0.1)


def test_default_candidates_can_keep_the_prior() -> None:
    kept = default_candidates(learn_prior=False)
    assert [candidate.name for candidate in kept] == [
        *("prior", "NPE", "discrepancy, given prior"),
        *("discrepancy (input), given prior", "discrepancy (tuned), given prior"),
    ]
    assert not any(candidate.learns_prior for candidate in kept)


# --- what cannot be stacked is refused before anything is trained ---


def test_too_few_pairs_are_refused() -> None:
    theta, x = problem(6, seed=1)
    with pytest.raises(
        NotReadyError,
        match=r"different parameters and groups, from `append_calibration`; got 1",
    ):
        stacked(rope_of((theta[:1].expand(6, -1), x)))


def test_what_cannot_be_stacked_is_refused_before_anything_is_trained(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Box, "fit", None)
    without_density = GivenCandidate(problems.vector_field_posterior("fmpe"), "bad")
    for_a_batch = trained().build_posterior(observed(), seed=0)
    other_theta = problems.npe_posterior("mdn", dim=1)
    bad: list[tuple[list[Any], type[Exception], str]] = [
        ([NPE, GivenCandidate(Wide(), "NPE")], InvalidInputError, "different names"),
        ([problems.box(2)], UnsupportedPosteriorError, "got BoxUniform"),
        ([without_density], UnsupportedPosteriorError, "'bad' with a density"),
        ([other_theta], UnsupportedPosteriorError, r"and theta \(1,\)"),
        ([for_a_batch], UnsupportedPosteriorError, "to answer any x"),
    ]
    for candidates, kind, match in bad:
        with pytest.raises(kind, match=match):
            stacked(rope_of(), candidates=[BOX, *candidates])


def test_candidates_without_mass_in_the_prior_raise_advice_to_add_the_prior() -> None:
    far = problems.BoxUniform(torch.ones(2) * 5, torch.ones(2) * 6)
    candidate = GivenCandidate(Prior(far, (3,)), "far")
    with pytest.raises(SamplingError, match="add the prior to the candidates"):
        stacked(rope_of(), candidates=[candidate])
    assert stacked(rope_of(), candidates=[candidate, PRIOR]).candidate_weights

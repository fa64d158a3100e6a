"""Stacks of trained candidates: scores, density, samples, copies and kinds of data."""

import copy
import math
import pickle
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from sbi.inference import DirectPosterior
from sbi.utils import BoxUniform
from scipy.stats import sem, t
from torch import Tensor, nn

from sbi_rope import RoPE, load
from sbi_rope.baselines import PriorPosterior
from sbi_rope.density import Flow, MixturePosterior
from sbi_rope.errors import (
    InvalidInputError,
    NotReadyError,
    SamplingError,
    SimulationError,
    UnsupportedPosteriorError,
)
from sbi_rope.stacking import (
    Difference,
    DiscrepancyCandidate,
    FinetunedCandidate,
    GivenCandidate,
    default_candidates,
    stacking_weights,
)
from sbi_rope.stacking.posterior import mixture_of
from tests import gaussian, problems
from tests.stacks import (
    BOX,
    NPE,
    NUM_OBSERVED,
    NUM_PAIRS,
    PRIOR,
    QUIET,
    Box,
    data_of,
    observed,
    problem,
    rope_of,
    small_stack,
    stacked,
    the_stack,
    trained,
    unnormalised,
    validated,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")


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
def test_scores_are_the_densities_of_the_versions_without_the_fold() -> None:
    posterior = the_stack()
    scores, (theta, x) = posterior.report, problem(NUM_PAIRS, seed=1)
    for name, versions in zip(scores.names, posterior.versions, strict=True):
        for number in range(scores.num_folds):
            rows = scores.fold == number
            expected = versions[number].log_prob(theta[rows][None], x[rows])[0].double()
            found = scores.scores_of(name)[rows]
            assert torch.allclose(found, expected, atol=1e-4), name


@pytest.mark.medium
def test_the_stack_that_scores_a_fold_is_weighted_by_the_others() -> None:
    posterior = the_stack()
    scores, (theta, x) = posterior.report, problem(NUM_PAIRS, seed=1)
    for number in range(scores.num_folds):
        rows = scores.fold == number
        weights = stacking_weights(scores.log_scores[~rows]).weights
        mixed = torch.logsumexp(scores.log_scores[rows] + weights.log(), dim=1)
        assert torch.allclose(scores.scores_of("stack")[rows], mixed)
        mixture = mixture_of(posterior.versions, weights, number)
        without = MixturePosterior(mixture, posterior.prior)
        mass = without.leakage_correction(x[rows])
        expected = mixed - mass.log()
        error = 6 * problems.error_of_mass(mass)
        assert ((scores.held_out.log_prob[rows] - expected).abs() < error + 1e-5).all()
        samples = without.sample_batched((400,), x[rows], **QUIET)
        below = (samples < theta[rows]).double().mean(dim=0)
        found = scores.held_out.levels[rows].double()
        # Four standard errors of 40 samples, two-sided.
        assert torch.allclose(found, (2 * below - 1).abs(), atol=0.65)
        assert ((found >= 0) & (found <= 1)).all()


def test_the_stack_of_each_fold_is_normalised_by_its_own_mass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its mass inside the prior differs from fold to fold."""

    def fit(self: Box, data: Any, versions: Any) -> Any:
        return [
            type(PRIOR.fit(data, versions)[0])(problems.BoxUniform(-w, w), (3,))
            for w in widths
        ]

    widths = [torch.full((2,), 1.5 + number) for number in range(4)]
    monkeypatch.setattr(Box, "fit", fit)
    scores = validated(rope_of(), candidates=[BOX])
    # After normalisation all versions are uniform on the box of the prior.
    box = torch.full((NUM_PAIRS,), math.log(0.25), dtype=torch.double)
    raw = -2 * (2 * torch.stack(widths)[:, 0]).log().double()[scores.fold]
    assert torch.allclose(scores.log_scores[:, 0], raw, atol=1e-5)
    assert torch.allclose(scores.held_out.log_prob, box, atol=0.7)
    assert float((scores.held_out.log_prob - box).mean()) == pytest.approx(
        0.0, abs=0.15
    )


def test_rows_of_the_table_are_mean_error_and_weight_of_each_candidate() -> None:
    scores = small_stack().report
    rows = scores.as_rows()
    assert [row["candidate"] for row in rows] == list(scores.names)
    assert [row["family"] for row in rows] == list(scores.families)
    for k, row in enumerate(rows):
        column = scores.log_scores[:, k]
        assert row["weight"] == float(scores.weights.weights[k])
        assert row["score"] == pytest.approx(float(column.mean()))
        error = float((column - column.mean()).square().sum() / (19 * 20)) ** 0.5
        half = (row["score_high"] - row["score_low"]) / 2
        assert half == pytest.approx(2.093 * error, rel=1e-3, abs=1e-12)
    assert math.isfinite(scores.held_out.acauc.mean)


def test_differences_are_means_over_pairs_with_the_interval_of_students_t() -> None:
    scores = small_stack().report
    for name, other in (("NPE", "prior"), ("stack", "prior"), ("NPE", "NPE")):
        pairs = scores.scores_of(name) - scores.scores_of(other)
        found, error = scores.difference(name, other), sem(pairs)
        half = t.ppf(0.975, len(pairs) - 1) * error
        assert found.mean == pytest.approx(float(pairs.mean()))
        assert found.high - found.mean == pytest.approx(half)
        assert found.mean - found.low == pytest.approx(half)
    # A density of zero at one pair: nobody knows how much worse on average.
    infinite = Difference.of(torch.tensor([torch.inf, 0.0, 0.1]), None)
    assert (infinite.low, infinite.high) == (-math.inf, math.inf)


def test_the_density_is_the_weighted_sum_of_averages_of_versions() -> None:
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    posterior = the_stack()
    scores = posterior.report
    expected = stacking_weights(scores.log_scores).weights
    assert list(posterior.candidate_weights.values()) == expected.tolist()
    assert list(posterior.candidate_weights) == list(scores.names)
    averaged = torch.stack(
        [
            torch.stack(
                [of_one[v].log_prob(theta[None], x)[0].double() for v in range(4)]
            ).logsumexp(dim=0)
            - math.log(4)
            for of_one in posterior.versions
        ],
        dim=1,
    )
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


@pytest.mark.medium
def test_many_theta_at_one_x_run_each_network_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    posterior, x, sizes = the_stack(), observed()[:1], []
    flows = {id(one.average) for one in posterior.versions}
    embed = Flow.embed

    def counted(self: Flow, x: Tensor) -> Tensor:
        assert id(self) in flows
        sizes.append(len(x))
        return embed(self, x)

    monkeypatch.setattr(Flow, "embed", counted)
    theta = problems.box(2).sample((3000,))
    found = posterior.log_prob(theta, x=x)
    # The prior and the regressions are no flows.
    assert sizes == [1] * sum(isinstance(p.average, Flow) for p in posterior.versions)
    assert torch.allclose(
        found[:50], posterior.log_prob_batched(theta[:50, None], x)[:, 0], atol=1e-4
    )


# --- copies ---


@pytest.mark.medium
def test_copies_pickles_and_files_have_the_same_densities(tmp_path: Path) -> None:
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    posterior = the_stack()
    expected = posterior.log_prob_batched(theta, x)
    candidates = posterior.candidate_log_probs(theta, x)
    file = pickle.dumps(posterior)
    assert len(file) < 3e6
    assert len(pickle.dumps(posterior.report)) < 2e4
    posterior.save(tmp_path / "stack.pt")
    loaded = load(tmp_path / "stack.pt")
    for other in (pickle.loads(file), copy.deepcopy(posterior), loaded):
        assert torch.equal(other.log_prob_batched(theta, x), expected)
        assert str(other.report) == str(posterior.report)
        other.to("cpu")
        assert torch.equal(other.candidate_log_probs(theta, x), candidates)
        # The density and the candidates share their parts, and so move together.
        shown = {id(part) for part in other.posterior_estimator.parts}
        averages = [one.average for one in other.versions]
        of_versions = [
            part for one in averages for part in getattr(one, "parts", [one])
        ]
        assert {id(part) for part in of_versions} == shown


def test_a_candidate_of_ten_lines_can_be_stacked_reported_and_kept(
    tmp_path: Path,
) -> None:
    posterior = small_stack()
    assert list(posterior.candidate_weights) == ["prior", "NPE", "box"]
    assert "box" in str(posterior.report)
    posterior.report.to_html(tmp_path / "report.html")
    assert "box" in (tmp_path / "report.html").read_text()
    theta, x = problem(9, seed=3)
    expected = posterior.log_prob_batched(theta, x)
    assert expected.isfinite().all()
    posterior.save(tmp_path / "stack.pt")
    for other in (
        load(tmp_path / "stack.pt"),
        pickle.loads(pickle.dumps(posterior)),
    ):
        assert torch.equal(other.log_prob_batched(theta, x), expected)
    curve = stacked(rope_of(), candidates=[BOX], learning_curve=True, num_folds=5)
    assert curve.report.learning_curve is not None


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
    ("family", "embedding"),
    [
        ("maf", "none"),
        pytest.param("nsf", "linear", marks=pytest.mark.slow),
        pytest.param("zuko_maf", "linear", marks=pytest.mark.slow),
        pytest.param("mnpe", "linear", marks=pytest.mark.slow),
    ],
)
def test_every_family_can_be_stacked(family: str, embedding: str) -> None:
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
    rehearsed = FinetunedCandidate(rehearse=True)
    assert validated(rope, candidates=[rehearsed]).log_scores.isfinite().all()
    assert not rehearsed.suits(data_of(rope, num_folds=2))
    # A short vector is no series.
    assert not rehearsed.suits(data_of(rope_of(problem(100, seed=1)), num_folds=5))
    with pytest.raises(InvalidInputError, match="space='embedding'"):
        stacked(rope, candidates=[PRIOR, DiscrepancyCandidate(space="input")])


def long_series(theta: Tensor) -> Tensor:
    return theta @ torch.ones(2, 24) + 0.1 * torch.randn(len(theta), 24)


@pytest.mark.medium
def test_moments_of_a_long_series_are_those_of_its_embedding_alone() -> None:
    estimator = gaussian.GaussianEstimator(2)
    estimator.net = nn.Sequential(nn.Linear(24, 2), estimator.net)
    estimator._condition_shape = torch.Size((24,))
    npe = DirectPosterior(estimator, problems.box(2))
    theta = problems.box(2).sample((8,))
    rope = RoPE(npe, simulator=long_series)
    rope.append_calibration(theta, long_series(theta))
    data = data_of(rope)
    assert data.moments(data.every, "embedding").covariance.shape == (8, 2, 2)
    assert [key for key in data.kept if "moments" in key] == [
        ("moments", k, False) for k in range(4)
    ]
    names = stacked(rope).candidate_weights
    assert "discrepancy (input)" not in names
    # It is trained if the user asks for it.
    assert stacked(rope, candidates=[DiscrepancyCandidate(space="input")])


@pytest.mark.slow
def test_a_stack_can_use_stored_simulations() -> None:
    theta = problems.box(2).sample((200,))
    x = problems.simulate(theta)
    for count in (10, 200):
        rope = rope_of(simulations=(theta[:count], x[:count]))
        posterior = stacked(rope)
        scores = posterior.report.log_scores
        assert scores.isfinite().all(), count
        samples = posterior.sample_batched((2,), observed(10), **QUIET)
        assert samples.isfinite().all(), count


class Untransformed(BoxUniform):
    """A prior that sbi cannot map to an unbounded space."""

    @property
    def support(self) -> Any:
        raise NotImplementedError


@pytest.mark.medium
def test_few_pairs_are_held_out_one_by_one() -> None:
    for num_pairs in (2, 3):
        with warnings.catch_warnings():
            # How many pairs a version is trained on is no choice of the user.
            warnings.filterwarnings("error", message="Only .* none is held out")
            posterior = stacked(rope_of(problem(num_pairs, seed=1)))
        scores = posterior.report
        assert scores.num_folds == num_pairs
        assert scores.log_scores.isfinite().all()
        assert scores.held_out.log_prob.isfinite().all()
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
    torch.manual_seed(5)
    state = torch.get_rng_state()
    posterior = stacked(rope)
    assert torch.equal(torch.get_rng_state(), state)
    assert all(map(torch.equal, (x_o, *rope.calibration), held))
    nets = [npe.posterior_estimator, rope.tuned_embedding_net]
    for net, old in zip(nets, before, strict=True):
        assert all(map(torch.equal, net.state_dict().values(), old.values()))
    # The seed decides, and not whether the RoPE was trained.
    theta = problems.box(2).sample((NUM_OBSERVED,))
    found, expected = (p.log_prob_batched(theta, x_o) for p in (posterior, the_stack()))
    assert torch.equal(found, expected)


def test_without_a_seed_the_state_of_torch_decides() -> None:
    found = []
    for state in (5, 5, 6):
        torch.manual_seed(state)
        scores = validated(rope_of(), candidates=[BOX], seed=None)
        found.append((scores.fold, scores.log_scores))
    assert torch.equal(found[0][1], found[1][1])
    assert not torch.equal(found[0][0], found[2][0])


class Wide:
    """A density of a user: normal around zero, whatever x is."""

    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        return torch.distributions.Normal(0.0, 2.0).log_prob(theta).sum(dim=-1)

    def sample(self, shape: torch.Size, x: Tensor) -> Tensor:
        return 2.0 * torch.randn(*shape, len(x), 2)


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
        ("Wide", Wide().log_prob(theta, x)),
        ("StackedPosterior", unnormalised(small_stack(), theta, x)[0]),
    ):
        assert torch.allclose(scores.scores_of(name).float(), expected, atol=1e-4)
    before = unnormalised(posterior, theta, x)
    with torch.no_grad():
        for parameter in another.posterior_estimator.parameters():
            parameter += 0.1
    assert torch.equal(unnormalised(posterior, theta, x), before)
    assert posterior.sample((40,), x=x[0], **QUIET).abs().max() <= 1
    wide = stacked(rope_of(), candidates=[Wide()])
    drawn = wide.sample((2000,), x=x[0], reject_outside_prior=False, **QUIET)
    assert float(drawn.std()) == pytest.approx(2.0, rel=0.1)
    assert torch.equal(
        *(s.log_prob(theta[:3], x=x[0]) for s in (wide, copy.copy(wide)))
    )


def test_default_candidates_have_different_names_and_can_keep_the_prior() -> None:
    assert [candidate.name for candidate in default_candidates()] == [
        *("prior", "NPE", "fine-tuned NPE", "discrepancy", "discrepancy (input)"),
        *("discrepancy (tuned)", "discrepancy, fine-tuned"),
        *("discrepancy (input), fine-tuned", "discrepancy (tuned), fine-tuned"),
        *("fine-tuned NPE, rehearsed", "regression", "regression (embedding)"),
    ]
    kept = default_candidates(learn_prior=False)
    assert [candidate.name for candidate in kept] == [
        *("prior", "NPE", "discrepancy, given prior"),
        *("discrepancy (input), given prior", "discrepancy (tuned), given prior"),
    ]
    assert not any(candidate.learns_prior for candidate in kept)


# --- what cannot be stacked is refused before anything is trained ---


def test_too_few_pairs_are_refused() -> None:
    theta, x = problem(6, seed=1)
    match = r"at least 2 calibration pairs with different parameters or groups; got {}"
    for rows, count in ((theta[:0], 0), (theta[:1], 1), (theta[:1].expand(6, -1), 1)):
        rope = rope_of((rows, x[: len(rows)]))
        with pytest.raises(NotReadyError, match=match.format(count)):
            stacked(rope)


@pytest.fixture
def nothing_is_trained(monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*args: Any) -> Any:
        raise AssertionError("What cannot be stacked was not found first.")

    monkeypatch.setattr(Box, "fit", never)


class Flat(Wide):
    def log_prob(self, theta: Tensor, x: Tensor) -> Tensor:
        return super().log_prob(theta, x).sum()


@pytest.mark.usefixtures("nothing_is_trained")
def test_bad_lists_of_candidates_are_refused() -> None:
    bad: list[tuple[Any, str]] = [
        ([], r"got \[\]"),
        ([BOX, NPE, GivenCandidate(Wide(), "NPE")], "different names"),
        ([BOX, GivenCandidate(Wide(), "stack")], "none of them 'stack'"),
        ([BOX, Flat()], r"log_prob\(theta, x\) of shape \(1, 2\)"),
        ([BOX, "NPE"], "log_prob"),
        (PRIOR, "candidates"),
    ]
    for candidates, match in bad:
        with pytest.raises(InvalidInputError, match=match):
            stacked(rope_of(), candidates=candidates)


@pytest.mark.usefixtures("nothing_is_trained")
def test_posteriors_without_a_density_to_score_are_refused() -> None:
    bad: list[tuple[Any, str]] = [
        (problems.vector_field_posterior("fmpe"), "candidate 'bad' with a density"),
        (problems.npe_posterior("mdn", dim=1), r"and theta \(1,\)"),
        (problems.npe_posterior("mdn", "cnn"), r"got x \(1, 8, 8\)"),
        (trained().build_posterior(observed(), seed=0), "to answer any x"),
    ]
    for posterior, match in bad:
        with pytest.raises(UnsupportedPosteriorError, match=match):
            stacked(rope_of(), candidates=[BOX, GivenCandidate(posterior, "bad")])


def test_candidates_without_mass_in_the_prior_raise_advice_to_add_the_prior() -> None:
    far = PriorPosterior(problems.BoxUniform(torch.ones(2) * 5, torch.ones(2) * 6))
    candidate = GivenCandidate(far, "far")
    with pytest.raises(SamplingError, match="add the prior to the candidates"):
        stacked(rope_of(), candidates=[candidate])
    assert stacked(rope_of(), candidates=[candidate, PRIOR]).candidate_weights


def test_pairs_that_cannot_be_simulated_are_named_by_their_parameters() -> None:
    theta, x = problem(6, seed=1)
    bad = theta[4]

    def fails(parameters: Tensor) -> Tensor:
        missing = (parameters == bad).all(dim=1, keepdim=True)
        return problems.simulate(parameters).where(~missing, torch.nan)

    with pytest.raises(SimulationError, match=rf"\[\[{bad[0]:.4g}, {bad[1]:.4g}\]\]"):
        stacked(rope_of((theta, x), simulator=fails))

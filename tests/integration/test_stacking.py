"""Stacks of trained candidates: scores, density, samples, copies and kinds of data."""

import copy
import warnings
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_rope.density import Mixture, MixturePosterior, Prior
from sbi_rope.stacking import (
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
    NUM_FOLDS,
    NUM_OBSERVED,
    NUM_PAIRS,
    PRIOR,
    QUIET,
    Box,
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
    # Never more folds than pairs.
    for num_pairs, num_folds, sizes in ((13, 5, [2, 2, 3, 3, 3]), (4, 5, [1] * 4)):
        rope = rope_of(problem(num_pairs, seed=1))
        fold = validated(rope, candidates=[BOX], num_folds=num_folds).fold
        assert sorted(fold.bincount().tolist()) == sizes
        *versions, last = seen.pop()
        assert sorted(last.tolist()) == list(range(num_pairs))
        for number, rows in enumerate(versions):
            expected = (fold != number).nonzero().flatten()
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
        # Of 40 samples 32 give the ranks, and 8 the means.
        held_out, std = scores.held_out, samples.std(dim=0)
        assert torch.allclose(held_out.ranks[rows].double(), below, atol=0.45)
        off = held_out.estimates[rows] - samples.mean(dim=0)
        assert (off.abs() < 5 * std / 8**0.5 + 0.02).all()


def test_the_density_is_the_weighted_sum_of_averages_of_versions() -> None:
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    posterior = the_stack()
    weights = stacking_weights(posterior.report.log_scores)
    names = posterior.report.names
    assert posterior.candidate_weights == dict(
        zip(names, weights.tolist(), strict=True)
    )
    averages = [
        torch.stack([of_one[v].log_prob(theta[None], x)[0] for v in range(4)]).exp()
        for of_one in posterior.versions
    ]
    expected = torch.stack(averages).double().mean(dim=1).T @ weights
    found = unnormalised(posterior, theta, x)[0].double()
    assert torch.allclose(found, expected.log(), atol=1e-4)


@pytest.mark.gpu
def test_a_stack_moves_to_a_gpu() -> None:
    posterior = copy.deepcopy(the_stack())
    x, theta = observed(), problems.box(2).sample((NUM_OBSERVED,))
    expected = unnormalised(posterior, theta, x)
    posterior.to("cuda")
    found = unnormalised(posterior, theta.cuda(), x.cuda()).cpu()
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
    theta = problems.box(2).sample((100,))
    x = problems.simulate_image(theta) + 0.3
    options: dict[str, Any] = {"simulator": problems.simulate_image}
    rope = rope_of((theta[:99], x[:99]), embedding="cnn", **options)
    names = {
        *("prior", "NPE", "fine-tuned NPE", "discrepancy", "discrepancy (tuned)"),
        *("discrepancy, fine-tuned", "discrepancy (tuned), fine-tuned"),
        *("regression", "regression (embedding)"),
    }
    assert {candidate.name for candidate in default_candidates(rope)} == names
    # With a hundred pairs of images NPE is trained on pairs and simulations alike.
    rope.append_calibration(theta[99:], x[99:])
    posterior = stacked(rope)
    assert {*posterior.candidate_weights} == {*names, "fine-tuned NPE, rehearsed"}
    assert posterior.report.log_scores.isfinite().all()
    assert posterior.log_prob_batched(theta, x).isfinite().all()


@pytest.mark.medium
def test_few_pairs_are_held_out_one_by_one() -> None:
    with warnings.catch_warnings():
        # How many pairs a version is trained on is no choice of the user.
        warnings.filterwarnings("error", message="Only .* none is held out")
        posterior = stacked(rope_of(problem(2, seed=1)))
    scores = posterior.report
    assert len(scores.fold.unique()) == 2
    assert scores.held_out.log_prob.isfinite().all()
    assert str(scores)
    theta, x = problem(6, seed=1)
    with pytest.raises(NotReadyError, match="at least 2 calibration pairs"):
        stacked(rope_of((theta[:1].expand(6, -1), x)))


# --- what the user passes ---


@pytest.mark.medium
def test_a_stack_changes_nothing_that_it_is_given_and_follows_from_its_seed() -> None:
    rope = trained()
    nets = rope.npe.estimator, rope.tuned_embedding_net
    before = copy.deepcopy([net.state_dict() for net in nets])
    torch.manual_seed(5)
    state = torch.get_rng_state()
    scores = validated(rope).log_scores
    assert torch.equal(torch.get_rng_state(), state)
    for net, values in zip(nets, before, strict=True):
        assert all(torch.equal(v, values[k]) for k, v in net.state_dict().items())
    # The seed decides, and not whether the RoPE was trained.
    assert torch.equal(scores, the_stack().report.log_scores)
    # Without a seed the state of torch does.
    folds = []
    for number in (5, 5, 6):
        torch.manual_seed(number)
        folds.append(validated(rope_of(), candidates=[BOX], seed=None).fold)
    assert torch.equal(folds[0], folds[1])
    assert not torch.equal(folds[0], folds[2])


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


class Wide(Prior):
    """A density of a user: normal around zero, whatever x is."""

    def __init__(self) -> None:
        super().__init__(MultivariateNormal(torch.zeros(2), 4 * torch.eye(2)), (3,))


def test_densities_that_are_given_are_stacked_as_they_are() -> None:
    another = copy.deepcopy(problems.npe_posterior("maf", "linear"))
    another.posterior_estimator.train()  # scored in evaluation mode all the same
    given = [GivenCandidate(another, "older"), Wide(), small_stack(), PRIOR]
    posterior = stacked(rope_of(), candidates=given)
    names = ("older", "Wide", "StackedPosterior", "prior")
    assert posterior.report.names == names
    theta, x = problem(NUM_PAIRS, seed=1)
    before = unnormalised(posterior, theta, x)
    another.posterior_estimator.eval()
    of_each = (
        unnormalised(another, theta, x)[0],
        Wide().log_prob(theta, x)[0],
        unnormalised(small_stack(), theta, x)[0],
    )
    for name, expected in zip(names, of_each, strict=False):
        found = scores_of(posterior.report, name).float()
        assert torch.allclose(found, expected, atol=1e-4)
    with torch.no_grad():
        for parameter in another.posterior_estimator.parameters():
            parameter += 0.1
    assert torch.equal(unnormalised(posterior, theta, x), before)
    wide = stacked(rope_of(), candidates=[Wide()])
    drawn = wide.sample((2000,), x=x[0], reject_outside_prior=False, **QUIET)
    assert float(drawn.std()) == pytest.approx(2.0, rel=0.1)


def test_default_candidates_can_keep_the_prior() -> None:
    kept = [one.name for one in default_candidates(learn_prior=False)]
    spaces = ("", " (input)", " (tuned)")
    assert kept == ["prior", "NPE", *(f"discrepancy{s}, given prior" for s in spaces)]


def test_what_cannot_be_stacked_is_refused_before_anything_is_trained(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(Box, "fit", None)
    unfit, invalid = UnsupportedPosteriorError, InvalidInputError
    for bad, kind, match in (
        (GivenCandidate(Wide(), "box"), invalid, "different names"),
        (problems.box(2), unfit, "got BoxUniform"),
        (problems.vector_field_posterior("fmpe"), unfit, "with a density"),
        (problems.npe_posterior("mdn", dim=1), unfit, r"\(\(3,\), \(2,\)\)"),
        (trained().build_posterior(observed(), seed=0), invalid, "of the batch"),
    ):
        with pytest.raises(kind, match=match):
            stacked(rope_of(), candidates=[BOX, bad])


def test_candidates_without_mass_in_the_prior_raise_advice_to_add_the_prior() -> None:
    far = problems.BoxUniform(torch.ones(2) * 5, torch.ones(2) * 6)
    candidate = GivenCandidate(Prior(far, (3,)), "far")
    with pytest.raises(SamplingError, match="add the prior to the candidates"):
        stacked(rope_of(), candidates=[candidate])
    assert stacked(rope_of(), candidates=[candidate, PRIOR]).candidate_weights

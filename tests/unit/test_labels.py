"""Labels that are noisy, partial, weighted, or given as draws."""

import math
from dataclasses import replace
from typing import Any

import pandas as pd
import pytest
import torch
from sbi.inference import DirectPosterior
from scipy.stats import kstest
from torch import Tensor
from torch.distributions import MultivariateNormal, Normal

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope.data.labels import draws_of, nodes_of
from sbi_rope.data.pairs import Pairs
from sbi_rope.data.simulate import moments
from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.stacking import stacking_weights
from sbi_rope.stacking.scoring import scores_of_draws
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning
from tests import gaussian, problems

NAN = math.nan
OF_PRIOR = torch.tensor([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 2.0]])
PRIOR = PriorDistribution(MultivariateNormal(torch.zeros(3), OF_PRIOR))
Y = torch.tensor([[0.5, -0.3, 1.0], [NAN, 0.4, -1.0], [0.2, NAN, NAN], [0.1, 0, 0]])
STD = torch.tensor([[0.5, 0.4, 0.7], [0.0, 0.4, 0], [0, 0, 0], [0, 0, 0]]).double()


def measured(y: Tensor, *std: float, prior: Any = None) -> Pairs:
    """Return pairs with the same independent noise, with draws given the prior."""
    noise = torch.tensor(std).double().expand(y.shape)
    pairs = replace(Pairs.exact(y, y), std=noise)
    return pairs if prior is None else replace(pairs, theta=draws_of(pairs, prior))


def given_as(draws: Tensor) -> Pairs:
    """Return pairs whose labels are draws."""
    pairs = Pairs.exact(draws.mean(dim=1), draws)
    return replace(pairs, theta=draws, std=torch.full_like(pairs.std, NAN))


# A noisy, a noisy partial, a partial and an exact label.
LABELS = replace(Pairs.exact(Y, Y), std=STD)


def box(dim: int, low: float = -1.0) -> PriorDistribution:
    return PriorDistribution(problems.box(dim, low))


def rope(dim: int = 2, **options: Any) -> RoPE:
    return RoPE(gaussian.posterior(dim), simulator=gaussian.simulator, **options)


def test_draws_of_parameters_follow_the_prior_given_the_label() -> None:
    found = draws_of(LABELS, PRIOR).double()
    assert found.shape == (4, 100, 3)
    prior = OF_PRIOR.double()
    for i in range(4):
        known = LABELS.is_measured[i].nonzero().flatten()
        select = torch.eye(3, dtype=torch.double)[known]
        total = select @ prior @ select.T + STD[i, known].square().diag()
        gain = prior @ select.T @ torch.linalg.inv(total)
        mean, expected = gain @ Y[i, known].double(), prior - gain @ select @ prior
        std = expected.diagonal().clamp_min(0.0).sqrt()
        assert ((found[i].mean(dim=0) - mean).abs() <= 0.35 * std + 1e-6).all()
        assert torch.allclose(found[i].T.cov(), expected, atol=0.35)
        fixed = std < 1e-6
        assert torch.allclose(found[i][:, fixed], mean[fixed], atol=1e-6)


def test_draws_stay_inside_a_box() -> None:
    # Noise has moved the label out of it.
    draws = draws_of(measured(torch.tensor([[1.2, 0.5]]), 0.2, 0.2), box(2, 0.0))[0]
    assert bool(((draws >= 0) & (draws <= 1)).all())
    grid = torch.linspace(0, 1, 2001)
    density = Normal(1.2, 0.2).log_prob(grid).exp()
    mean = (grid * density).sum() / density.sum()
    assert abs(float(draws[:, 0].mean() - mean)) < 0.02
    for y in ([NAN, 1.0], [NAN, -1.0], [0.3, 1.0]):
        on_bound = measured(torch.tensor([y]), 0.0 if math.isnan(y[0]) else 0.1, 0.0)
        draws = draws_of(on_bound, box(2))[0]
        assert bool((draws[:, 1] == y[1]).all())
        assert float(draws[:, 0].std()) > 0.05


def test_given_draws_come_in_random_order() -> None:
    ordered = torch.randn(2, 40, 2).sort(dim=1).values
    draws = rope().append_calibration(ordered, torch.randn(2, 2)).pairs.theta
    assert not torch.equal(draws, ordered)
    assert torch.equal(draws.sort(dim=1).values, ordered)


def test_the_density_of_a_label_is_that_of_the_posterior_with_its_noise() -> None:
    torch.manual_seed(0)
    mean = torch.tensor([0.3, -0.2, 0.8], dtype=torch.double)
    covariance = 0.01 * torch.eye(3).double() + 0.004
    q = MultivariateNormal(mean, covariance)
    samples = q.sample(torch.Size((200, 1))).expand(-1, 4, -1)
    nodes = nodes_of(LABELS, [samples], PRIOR, num_nodes=2000)
    log_q = q.log_prob(nodes.theta.double())
    found = nodes.log_mean(log_q)
    for i in range(4):
        known = LABELS.is_measured[i].nonzero().flatten()
        exact = MultivariateNormal(
            mean[known], (covariance + STD[i].square().diag())[known][:, known]
        ).log_prob(Y[i, known].double())
        # Of the exact label there is nothing to estimate.
        assert abs(float(found[i] - exact)) < (0.15 if i < 3 else 1e-6)


def log_evidence(y: float, std: float) -> float:
    """Return log p(y) of the uniform prior from -1 to 1, by quadrature."""
    grid = torch.linspace(-1, 1, 20_001, dtype=torch.double)
    noise = Normal(grid, std).log_prob(torch.tensor(y).double())
    return float(noise.exp().mean().log())


@pytest.mark.parametrize(
    ("y", "std", "dim", "num_nodes", "error"),
    [
        (0.9, 0.15, 1, 20_000, 0.03),
        (2.0, 0.15, 1, 64, 0.6),
        # The prior's reference is far outside of the box in most parameters.
        (1.3, 0.3, 6, 32, 1.0),
    ],
)
def test_the_density_of_a_label_is_that_of_quadrature_inside_the_support(
    y: float, std: float, dim: int, num_nodes: int, error: float
) -> None:
    label = measured(torch.full((1, dim), y), *[std] * dim, prior=box(dim))
    nodes = nodes_of(label, [], box(dim), num_nodes=num_nodes)
    assert int(torch.isfinite(nodes.log_weights).sum()) >= 4
    uniform = torch.full(nodes.log_weights.shape, -dim * math.log(2.0)).double()
    found = float(nodes.log_mean(uniform))
    assert found == pytest.approx(dim * log_evidence(y, std), abs=error)


def test_the_density_of_draws_is_relative_to_that_of_the_prior() -> None:
    draws = PRIOR.sample(torch.Size((4, 50)))
    score = nodes_of(given_as(draws), [], PRIOR, num_nodes=7).log_mean(
        PRIOR.log_prob(draws)
    )
    assert torch.allclose(score, torch.zeros(4).double(), atol=1e-6)


def test_ranks_of_noisy_labels_are_uniform_if_the_posterior_is_right() -> None:
    torch.manual_seed(0)
    theta = gaussian.prior().sample((2000,))
    noise = torch.tensor([0.0, 0.8])
    pairs = measured(theta + noise * torch.randn_like(theta), 0.0, 0.8)
    pairs = replace(pairs, x=gaussian.simulator(theta))
    posterior: Any = gaussian.posterior()
    _, ranks, *_ = scores_of_draws(posterior, pairs, seed=0)
    for uniform in ranks.T:
        assert kstest(uniform.numpy(), "uniform").pvalue > 0.01


def line(theta: Tensor) -> Tensor:
    return torch.stack([theta[:, 0] + theta[:, 1], theta[:, 1].square()], dim=1)


def test_moments_of_a_label_average_over_its_parameters() -> None:
    y = torch.tensor([[0.0, 0.0], [0.5, NAN]])
    pairs = measured(y, 0.0, 0.0, prior=box(2))
    torch.manual_seed(0)
    found = moments(rope().source, pairs, 100, line)
    draws = pairs.theta[1].double()
    # Simulations have noise of 0.5, whose square adds 0.25 to the second entry.
    exact = line(draws) + torch.tensor([0.0, 0.25])
    assert torch.allclose(found.mean[1], exact.mean(dim=0), atol=0.25)
    assert float((found.means[1] - exact)[:, 0].abs().mean()) < 0.2
    # The surface of the first label is a point.
    assert float(found.means[0].std(dim=0).max()) < 1e-6
    variance = torch.tensor(0.5).double()
    assert torch.allclose(found.covariance[0, 0, 0], variance, atol=0.2)


def test_the_possible_means_are_shrunk_by_the_noise_in_them_only() -> None:
    torch.manual_seed(0)
    theta = gaussian.prior(5).sample((40,))
    prior = PriorDistribution(gaussian.prior(5))
    nearly_exact = measured(theta, *[1e-3] * 5, prior=prior)
    found = moments(rope(5).source, nearly_exact, 100, lambda x: x)
    # Without the shrinkage the spread is a fifth of the variance of simulations.
    assert float(found.means.var(dim=1).mean()) < 0.03 * gaussian.NOISE_STD**2
    prior = PriorDistribution(gaussian.prior())
    wide = measured(theta[:, :2], 1.0, 1.0, prior=prior)
    error = moments(rope().source, wide, 100, lambda x: x).means - wide.theta.double()
    assert float(error.square().mean()) < 0.06 * gaussian.NOISE_STD**2


def test_a_weight_of_two_counts_as_two_pairs() -> None:
    torch.manual_seed(1)
    m = torch.randn(6, 2, dtype=torch.double)
    z, noise = 1.3 * m + 0.2, 0.01 * torch.eye(2).double()
    weights = torch.tensor([1.0, 2, 1, 2, 1, 1])
    twice = torch.tensor([0, 1, 1, 2, 3, 3, 4, 5])
    a = DiscrepancyModel().fit(z, m, noise, weights=weights)
    b = DiscrepancyModel().fit(z[twice], m[twice], noise)
    assert math.isclose(a.log_evidence, b.log_evidence, rel_tol=1e-9)
    assert math.isclose(a.probability_of_none, b.probability_of_none, rel_tol=1e-6)
    log_scores = torch.randn(6, 3)
    one = stacking_weights(log_scores, pair_weights=weights)
    other = stacking_weights(log_scores[twice])
    assert torch.allclose(one, other, atol=1e-6)


@pytest.mark.medium
def test_tuning_on_partial_labels_keeps_what_x_says_about_missing_parameters() -> None:
    theta, x = gaussian.labelled(600)
    theta[::2, 0] = theta[1::2, 1] = NAN
    finetuner = CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=300)
    conductor = rope(finetuner=finetuner).append_calibration(theta, x)
    conductor.train(seed=0, show_progress_bars=False)
    at = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    level, *moved = conductor.tuned_embedding_net(at).detach()
    # Of exact labels the slope is that of E[0.8 theta | x]. Targets that only know the
    # label would give half of it.
    slope = gaussian.GAIN**2 / gaussian.SCALE
    expected = slope * torch.eye(2)
    assert torch.allclose(torch.stack(moved) - level, expected, atol=0.15 * slope)


@pytest.mark.medium
def test_exact_and_noisy_labels_may_be_appended_one_after_the_other() -> None:
    theta, x = gaussian.labelled(6)
    conductor = rope().append_calibration(theta[:4], x[:4])
    conductor.append_calibration(theta[4:], x[4:], theta_std=0.3)
    assert str(conductor.pairs) == "6 labels, 2 with noise and 0 partial"
    known = conductor.pairs.mean
    assert torch.allclose(known[:4], theta[:4])
    # The posterior mean of a noisy label is nearer to the mean of the prior.
    assert torch.allclose(known[4:], theta[4:] / 1.09, atol=0.1)
    conductor.train(seed=0, show_progress_bars=False)
    with pytest.raises(InvalidInputError, match="as many draws"):
        conductor.append_calibration(theta[:, None].repeat(1, 3, 1), x)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"theta": torch.full((10, 2), NAN)}, "NaN only in 10 of 10 rows"),
        ({"theta": torch.full((10, 2), 90.0)}, r"fit; got others in 10 of 10 rows"),
        ({"theta_std": -0.1}, "not to be negative"),
        ({"theta_std": torch.ones(3)}, r"\(10, 2\); got \(3,\)"),
        ({"weights": torch.zeros(10)}, "positive"),
        ({"groups": [1, 2]}, "each of 10 pairs; got 2"),
    ],
)
def test_labels_that_make_no_sense_are_refused(
    options: dict[str, Any], message: str
) -> None:
    npe = DirectPosterior(gaussian.GaussianEstimator(), box(2))
    good = {"theta": torch.zeros(10, 2), "x": torch.zeros(10, 2), "theta_std": 0.1}
    with pytest.raises(InvalidInputError, match=message):
        RoPE(npe, simulator=gaussian.simulator).append_calibration(**good | options)


def test_groups_are_numbers_or_names_of_all_pairs() -> None:
    theta, x = gaussian.labelled(4)
    for groups in (pd.Series(["a", "a", "b", "c"]), torch.tensor([7, 7, 2, 3])):
        named = rope().append_calibration(theta, x, groups=groups)
        assert named.pairs.group.tolist() == [0, 0, 1, 2]
    named = named.append_calibration(theta, x, groups=["mouse", 2, "rat", "mouse"])
    assert named.pairs.group.tolist() == [0, 0, 1, 2, 3, 1, 4, 3]
    with pytest.raises(InvalidInputError, match="or of none"):
        named.append_calibration(theta, x)


def test_weights_that_were_normalised_are_warned_of() -> None:
    with pytest.warns(RoPEWarning, match="12 pairs sum to 1, .* do not normalise"):
        rope().append_calibration(*gaussian.labelled(12), weights=torch.ones(12) / 12)

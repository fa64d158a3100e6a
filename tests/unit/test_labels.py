"""Labels that are noisy, partial, weighted, or given as draws."""

import math
import warnings
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from sbi.utils import BoxUniform
from torch import Tensor
from torch.distributions import MultivariateNormal

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope._labels import (
    Labels,
    labelled_moments,
    nodes_of,
    parameters_of,
    reference_of,
)
from sbi_rope.discrepancy import DiscrepancyModel, learn_parameters
from sbi_rope.discrepancy.imputation import expected_means
from sbi_rope.errors import InvalidInputError, RoPEWarning, SimulationError
from sbi_rope.metrics import acauc_of, coverage_curve_of, expected_coverage_error_of
from sbi_rope.simulate import Simulator
from sbi_rope.stacking import stacking_weights
from sbi_rope.stacking.scoring import label_levels
from sbi_rope.stacking.workbench import Workbench
from tests import gaussian
from tests.stacks import problem, rope_of

NAN = math.nan
PRIOR = MultivariateNormal(
    torch.zeros(3), torch.tensor([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 2.0]])
)
THETA = torch.tensor([[0.5, -0.3, 1.0], [NAN, 0.4, -1.0], [0.2, NAN, NAN], [0.1, 0, 0]])


def labels() -> Labels:
    """Return a noisy, a noisy partial, a partial and an exact label."""
    covariance = torch.zeros(4, 3, 3, dtype=torch.double)
    covariance[0] = torch.tensor([[0.3, 0.1, 0.0], [0.1, 0.2, 0.0], [0.0, 0.0, 0.5]])
    covariance[1, 1, 1] = 0.2
    return Labels(
        theta=THETA, covariance=covariance, weights=torch.ones(4, dtype=torch.double)
    )


def conditioned(mean: Tensor, covariance: Tensor, i: int) -> tuple[Tensor, Tensor]:
    """Return the normal distribution of theta given label i, in closed form."""
    measured = labels().is_measured[i].nonzero().flatten()
    select = torch.eye(3, dtype=torch.double)[measured]
    noise = labels().covariance[i][measured][:, measured]
    gain = (
        covariance @ select.T @ torch.linalg.inv(select @ covariance @ select.T + noise)
    )
    surprise = THETA[i, measured].double() - select @ mean
    return mean + gain @ surprise, covariance - gain @ select @ covariance


def test_draws_of_parameters_follow_the_prior_given_the_label() -> None:
    found = parameters_of(labels(), PRIOR).draws.double()
    assert found.shape == (4, 100, 3)
    covariance = PRIOR.covariance_matrix.double()
    for i in range(4):
        mean, expected = conditioned(torch.zeros(3).double(), covariance, i)
        std = expected.diagonal().clamp_min(0.0).sqrt()
        assert ((found[i].mean(dim=0) - mean).abs() <= 0.35 * std + 1e-6).all()
        assert torch.allclose(found[i].T.cov(), expected, atol=0.35)
        fixed = std < 1e-6
        assert torch.allclose(found[i][:, fixed], mean[fixed], atol=1e-6)


def test_draws_stay_inside_a_box() -> None:
    box = BoxUniform(torch.zeros(2), torch.ones(2))
    one = Labels.exact(torch.tensor([[1.2, 0.5]]))  # noise has moved it out of the box
    covariance = 0.04 * torch.eye(2, dtype=torch.double)[None]
    noisy = Labels(theta=one.theta, covariance=covariance, weights=one.weights)
    draws = parameters_of(noisy, box).draws[0]
    assert bool(((draws >= 0) & (draws <= 1)).all())
    # The mean of N(1.2, 0.2) below 1, with its lower tail cut at 0.
    below = torch.distributions.Normal(1.2, 0.2)
    grid = torch.linspace(0, 1, 2001)
    density = below.log_prob(grid).exp()
    assert (
        abs(float(draws[:, 0].mean() - (grid * density).sum() / density.sum())) < 0.02
    )


def test_the_density_of_a_label_is_that_of_the_posterior_with_its_noise() -> None:
    torch.manual_seed(0)
    mean = torch.tensor([0.3, -0.2, 0.8], dtype=torch.double)
    covariance = 0.01 * torch.eye(3).double() + 0.004
    q = MultivariateNormal(mean, covariance)
    samples = q.sample(torch.Size((200, 1))).expand(-1, 4, -1)
    nodes = nodes_of(labels(), [reference_of(samples)], PRIOR, num_nodes=2000)
    log_q = q.log_prob(nodes.theta.double())
    found, error = nodes.log_mean(log_q), nodes.standard_error(log_q)
    for i in range(4):
        measured = labels().is_measured[i].nonzero().flatten()
        noise = labels().covariance[i]
        exact = MultivariateNormal(
            mean[measured], (covariance + noise)[measured][:, measured]
        ).log_prob(THETA[i, measured].double())
        assert abs(float(found[i] - exact)) < 4 * float(error[i]) + 1e-6
        assert float(error[i]) < 0.1
    assert float(error[3]) == 0.0  # of an exact label there is nothing to estimate


def test_only_parameters_inside_the_prior_count_in_the_density_of_a_label() -> None:
    box = BoxUniform(torch.zeros(1), torch.ones(1))
    one = Labels(
        theta=torch.tensor([[0.9]]),
        covariance=torch.full((1, 1, 1), 0.04, dtype=torch.double),
        weights=torch.ones(1, dtype=torch.double),
    )
    torch.manual_seed(0)
    q = torch.distributions.Normal(torch.tensor(1.0).double(), 0.3)
    nodes = nodes_of(
        one, [reference_of(q.sample(torch.Size((500, 1, 1))))], box, num_nodes=20_000
    )
    found = nodes.log_mean(q.log_prob(nodes.theta.double()[..., 0]))
    grid = torch.linspace(0, 1, 20_001, dtype=torch.double)
    noise = torch.distributions.Normal(grid, 0.2).log_prob(torch.tensor(0.9).double())
    exact = (q.log_prob(grid) + noise).exp().mean().log()
    assert abs(float(found[0] - exact)) < 0.03


def test_levels_of_noisy_labels_are_uniform_if_the_posterior_is_right() -> None:
    torch.manual_seed(0)
    theta = gaussian.prior().sample((300,))
    noise = torch.tensor([0.0, 0.8])
    noisy = Labels(
        theta=theta + noise * torch.randn_like(theta),
        covariance=torch.diag(noise.double().square()).expand(300, 2, 2),
        weights=torch.ones(300, dtype=torch.double),
    )
    posterior: Any = gaussian.posterior()
    levels, *_ = label_levels(
        posterior, noisy, gaussian.simulator(theta), num_samples=200
    )
    assert torch.allclose(levels.mean(dim=0), torch.tensor(0.5), atol=0.05)


def test_the_density_of_draws_is_relative_to_that_of_the_prior() -> None:
    draws = PRIOR.sample(torch.Size((4, 50)))
    given = Labels(
        theta=draws.mean(dim=1),
        covariance=torch.zeros(4, 3, 3, dtype=torch.double),
        weights=torch.ones(4, dtype=torch.double),
        samples=draws,
    )
    nodes = nodes_of(given, [], PRIOR, num_nodes=7)
    score = nodes.log_mean(PRIOR.log_prob(draws))
    assert torch.allclose(score, torch.zeros(4).double(), atol=1e-6)


# Learning -----------------------------------------------------------------------------


def line(theta: Tensor) -> Tensor:
    return torch.stack([theta[:, 0] + theta[:, 1], theta[:, 1].square()], dim=1)


def test_moments_of_a_label_average_over_its_parameters() -> None:
    box = BoxUniform(-torch.ones(2), torch.ones(2))
    conductor = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
    known = parameters_of(
        Labels.exact(torch.zeros(1, 2))[torch.tensor([0])].appended(
            Labels(
                theta=torch.tensor([[0.5, NAN]]),
                covariance=torch.zeros(1, 2, 2, dtype=torch.double),
                weights=torch.ones(1, dtype=torch.double),
            )
        ),
        box,
    )
    torch.manual_seed(0)
    moments = labelled_moments(
        conductor.source, known, 100, lambda x: line(x), progress=False
    )
    assert moments.possible is not None
    draws = known.draws[1].double()
    # Simulations have noise of 0.5, whose square adds 0.25 to the second entry.
    exact = line(draws) + torch.tensor([0.0, 0.25])
    assert torch.allclose(moments.mean[1], exact.mean(dim=0), atol=0.25)
    residual = moments.possible[1] - exact
    assert float(residual[:, 0].abs().mean()) < 0.2
    # The surface of the first label is a point.
    assert float(moments.possible[0].std(dim=0).max()) < 1e-6
    assert torch.allclose(
        moments.covariance[0, 0, 0], torch.tensor(0.5).double(), atol=0.2
    )


def test_a_few_draws_of_a_label_do_not_hide_the_noise_of_simulations() -> None:
    torch.manual_seed(0)
    few = torch.randn(3, 2, 2)
    known = rope().append_calibration(few, torch.zeros(3, 2)).labelled_parameters
    moments = labelled_moments(rope().source, known, 100, lambda x: x, progress=False)
    at_one = rope().source.moments(few[:, 0], 1000, lambda x: x, progress=False)
    for found, expected in zip(moments.covariance, at_one.covariance, strict=True):
        variances = found.diagonal() / expected.diagonal()
        assert ((variances > 0.6) & (variances < 1.6)).all()


def test_the_order_of_the_draws_of_a_label_does_not_matter() -> None:
    ordered = torch.randn(2, 200, 2).sort(dim=1).values
    draws = rope().append_calibration(ordered, torch.zeros(2, 2)).labelled_parameters
    for first in (draws.draws[:, :10], draws.draws[:, :100]):
        away = (first.mean(dim=1) - ordered.mean(dim=1)).abs().max()
        assert float(away) < 3 / first.shape[1] ** 0.5
    assert torch.equal(draws.draws.sort(dim=1).values, ordered.sort(dim=1).values)


@pytest.mark.medium
def test_the_discrepancy_of_possible_means_is_that_of_the_right_ones() -> None:
    torch.manual_seed(0)
    m = torch.randn(60, 1, dtype=torch.double)
    z = 0.5 * m + 2.0 + 0.05 * torch.randn(60, 1).double()
    noise = torch.tensor([[1e-4]]).double()
    # The right mean is one of two, and the observation tells which.
    possible = torch.stack([m, torch.randn(60, 1).double()], dim=1)
    model = DiscrepancyModel()
    exact = model.fit(z, m, noise).sample(500, seed=0)
    found = model.fit(z, possible, noise).sample(500, seed=0)
    naive = model.fit(z, possible.mean(dim=1), noise).sample(500, seed=0)
    assert abs(float(exact.gain.mean()) - 0.5) < 0.02
    assert abs(float(found.gain.mean()) - 0.5) < 0.05
    assert abs(float(found.offset.mean()) - 2.0) < 0.05
    error = [float(one.error_factor.square().mean().sqrt()) for one in (found, naive)]
    assert error[0] < 0.5 * error[1]


def test_a_weight_of_two_counts_as_two_pairs() -> None:
    torch.manual_seed(1)
    m = torch.randn(6, 2, dtype=torch.double)
    z, noise = 1.3 * m + 0.2, 0.01 * torch.eye(2).double()
    weights = torch.tensor([1.0, 2, 1, 2, 1, 1])
    twice = torch.tensor([0, 1, 1, 2, 3, 3, 4, 5])
    a = DiscrepancyModel().fit(z, m, noise, weights=weights)
    b = DiscrepancyModel().fit(z[twice], m[twice], noise)
    assert math.isclose(a.log_evidence, b.log_evidence, rel_tol=1e-9)
    assert math.isclose(a.log_evidence_of_none, b.log_evidence_of_none, rel_tol=1e-9)
    log_scores = torch.randn(6, 3)
    one = stacking_weights(log_scores, pair_weights=weights)
    other = stacking_weights(log_scores[twice])
    assert torch.allclose(one.weights, other.weights, atol=1e-6)
    assert math.isclose(one.score, other.score, rel_tol=1e-6)


def test_the_distribution_of_parameters_is_learned_from_draws_of_labels() -> None:
    torch.manual_seed(0)
    theta = torch.rand(2000, 1)
    exact = 0.2 * torch.rand(40, 1)
    noisy = (exact[:, None] + 0.01 * torch.randn(40, 12, 1)).clamp(0, 1)
    found = learn_parameters(noisy, theta).probabilities
    wanted = learn_parameters(exact, theta).probabilities
    assert (
        abs(float(found[theta[:, 0] < 0.25].sum() - wanted[theta[:, 0] < 0.25].sum()))
        < 0.05
    )


def test_the_distribution_is_learned_from_pairs_that_count_several_times() -> None:
    torch.manual_seed(0)
    theta, pairs = torch.rand(2000, 1), 0.3 * torch.rand(20, 1)
    weights = torch.tensor([1.0, 3.0] * 10)
    # Parameters between the same two simulations have the same score.
    rows = torch.arange(20).repeat_interleave(weights.long())
    several = pairs[rows] + 1e-7 * torch.arange(len(rows))[:, None]
    found = learn_parameters(pairs, theta, weights=weights)
    wanted = learn_parameters(several, theta)
    assert torch.allclose(found.probabilities, wanted.probabilities, rtol=1e-3)
    assert not torch.allclose(
        found.probabilities, learn_parameters(pairs, theta).probabilities, rtol=0.01
    )


# Calibration --------------------------------------------------------------------------


def test_levels_that_are_not_known_are_left_out() -> None:
    levels = torch.tensor([[0.2, NAN], [0.6, 0.9], [NAN, NAN], [1.0, 0.1]])
    score = acauc_of(levels, allow_missing=True)
    assert math.isclose(score.value, (0.2 + 0.75 + 0.55) / 3 - 0.5, abs_tol=1e-6)
    expected = torch.tensor([0.1, 0.0]).double()
    assert torch.allclose(score.per_parameter, expected, atol=1e-6)
    curve = coverage_curve_of(levels, allow_missing=True)
    half = torch.tensor([1 / 3, 0.5]).double()
    assert torch.allclose(curve.per_parameter[:, 49], half)
    assert 0 < expected_coverage_error_of(levels, allow_missing=True).value < 0.5
    for score_of in (acauc_of, coverage_curve_of, expected_coverage_error_of):
        with pytest.raises(InvalidInputError, match="nan"):
            score_of(levels)


# The border ---------------------------------------------------------------------------


def rope() -> RoPE:
    return RoPE(gaussian.posterior(), simulator=gaussian.simulator)


def test_labels_that_say_nothing_are_left_out() -> None:
    theta, x = gaussian.labelled(6)
    theta[2:4] = NAN
    with pytest.warns(RoPEWarning, match=r"left out: 2 of 6 rows"):
        conductor = rope().append_calibration(theta, x)
    keep = torch.tensor([0, 1, 4, 5])
    assert torch.equal(conductor.calibration[0], theta[keep])
    assert torch.equal(conductor.calibration[1], x[keep])
    assert conductor.labels.are_exact


@pytest.mark.medium
def test_exact_and_noisy_labels_may_be_appended_one_after_the_other() -> None:
    theta, x = gaussian.labelled(6)
    conductor = rope().append_calibration(theta[:4], x[:4])
    conductor.append_calibration(theta[4:], x[4:], theta_std=0.3)
    assert str(conductor.labels) == "6 labels, 2 with noise and 0 partial"
    known, _ = conductor.calibration
    assert torch.allclose(known[:4], theta[:4])
    # The posterior mean of a noisy label is nearer to the mean of the prior.
    assert torch.allclose(known[4:], theta[4:] / 1.09, atol=0.1)
    conductor.train(seed=0, show_progress_bars=False)
    with pytest.raises(InvalidInputError, match="as many draws"):
        conductor.append_calibration(theta[:, None].repeat(1, 3, 1), x)


STD = torch.tensor([0.1, 0.1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"theta_std": -0.1}, "not negative"),
        ({"theta_std": torch.ones(3)}, r"shape \(2,\) or \(10, 2\)"),
        ({"theta_std": STD, "theta_cov": torch.eye(2)}, "got both"),
        ({"theta_std": torch.tensor([0.1, NAN])}, "finite and not negative"),
        ({"theta_cov": torch.eye(3)}, r"\(2, 2\) or \(10, 2, 2\)"),
        ({"theta_cov": -torch.eye(2)}, "positive definite"),
        ({"theta_cov": torch.tensor([[1.0, 0.5], [0.0, 1.0]])}, "positive definite"),
        ({"theta_cov": torch.ones(2, 2)}, "positive definite"),
        ({"weights": torch.zeros(10)}, "positive"),
        ({"weights": torch.ones(9)}, "`weights` of shape"),
        ({"weights": torch.ones(10, 2)}, "`weights` of shape"),
        ({"groups": [1, 2]}, "each of 10 pairs; got 2"),
    ],
)
def test_labels_that_make_no_sense_are_refused(
    options: dict[str, Any], message: str
) -> None:
    conductor = rope()
    with pytest.raises(InvalidInputError, match=message):
        conductor.append_calibration(*gaussian.labelled(10), **options)
    assert not len(conductor.labels)


def test_a_covariance_may_have_parameters_of_very_different_units() -> None:
    theta, x = gaussian.labelled(10)
    covariance = torch.tensor([[1e-6, 1e-2], [1e-2, 1e8]])
    labels = rope().append_calibration(theta, x, theta_cov=covariance).labels
    assert torch.equal(labels.covariance[0].float(), covariance)
    covariance = torch.tensor([[0.0, 0.0], [0.0, 1e14]])
    assert len(rope().append_calibration(theta, x, theta_cov=covariance).labels) == 10


def test_draws_of_labels_are_checked() -> None:
    theta, x = gaussian.labelled(4)
    draws = theta[:, None] + 0.1 * torch.randn(4, 20, 2)
    conductor = rope().append_calibration(draws, x)
    assert torch.allclose(conductor.calibration[0], draws.mean(dim=1), atol=1e-5)
    assert str(conductor.labels) == "4 labels, each given as 20 draws"
    with pytest.raises(InvalidInputError, match="draws of all parameters"):
        rope().append_calibration(draws, x, theta_std=0.1)
    with pytest.raises(InvalidInputError, match="draws of all parameters"):
        rope().append_calibration(draws.where(draws > 0, NAN), x)


def test_a_label_that_fits_no_parameters_of_the_prior_is_named() -> None:
    from sbi.inference import DirectPosterior

    box = BoxUniform(-torch.ones(2), torch.ones(2))
    npe = DirectPosterior(gaussian.GaussianEstimator(), box)
    theta = torch.tensor([[0.0, 0.0], [0.5, 90.0]])
    with pytest.raises(InvalidInputError, match=r"fit; got 1 others .*\[1\]"):
        RoPE(npe, simulator=gaussian.simulator).append_calibration(
            theta, theta, theta_std=0.1
        )


def test_groups_of_labels_that_are_equal() -> None:
    theta = torch.tensor([[0.0, NAN], [1.0, 2.0], [0.0, NAN], [0.0, 3.0]])
    covariance = torch.zeros(4, 2, 2, dtype=torch.double)
    some = Labels(theta=theta, covariance=covariance, weights=torch.ones(4).double())
    assert some.groups.tolist() == [0, 1, 0, 2]
    other = Labels(
        theta=theta,
        covariance=covariance + torch.tensor([0.0, 0, 1, 0])[:, None, None],
        weights=torch.ones(4).double(),
    )
    assert other.groups.tolist() == [0, 1, 2, 3]
    named = some.named(("b", "a", "a", "c"))
    assert named.groups.tolist() == [0, 1, 1, 2]
    assert named[torch.tensor([3, 2, 1])].groups.tolist() == [0, 1, 1]
    assert named.appended(named).groups.tolist() == [0, 1, 1, 2, 0, 1, 1, 2]


def test_groups_are_numbers_or_names_of_all_pairs() -> None:
    theta, x = gaussian.labelled(4)
    numbers = [7, 7, 2, 3]
    array = np.array(numbers)
    for groups in (numbers, array, list(array), torch.tensor(numbers), iter(numbers)):
        named = rope().append_calibration(theta, x, groups=groups)
        assert named.labels.groups.tolist() == [0, 0, 1, 2]
    named = named.append_calibration(theta, x, groups=["mouse", 2, "rat", "mouse"])
    assert named.labels.groups.tolist() == [0, 0, 1, 2, 3, 1, 4, 3]
    with pytest.raises(InvalidInputError, match="or of none"):
        named.append_calibration(theta, x)
    assert len(named.labels) == 8
    with pytest.raises(InvalidInputError, match="or of none"):
        rope().append_calibration(theta, x).append_calibration(theta, x, groups=numbers)
    table = pd.DataFrame({"specimen": ["a", "a", "b", "c"]})
    with pytest.raises(InvalidInputError, match="each of 4 pairs; got 1"):
        rope().append_calibration(theta, x, groups=table)  # type: ignore[arg-type]
    named = rope().append_calibration(theta, x, groups=table["specimen"])
    assert named.labels.groups.tolist() == [0, 0, 1, 2]


# Labels that are nearly exact, and labels near bounds --------------------------------


def measured(theta: Tensor, *std: float) -> Labels:
    """Return labels with the same independent noise."""
    covariance = torch.tensor(std).double().square().diag().expand(len(theta), -1, -1)
    return Labels(
        theta=theta, covariance=covariance, weights=torch.ones(len(theta)).double()
    )


def test_labels_that_are_nearly_exact_leave_a_single_possible_mean() -> None:
    torch.manual_seed(0)
    normal = gaussian.prior(5)
    known = parameters_of(measured(normal.sample((40,)), *[1e-3] * 5), normal)
    conductor = RoPE(gaussian.posterior(5), simulator=gaussian.simulator)
    moments = labelled_moments(
        conductor.source, known, 100, lambda x: x, progress=False
    )
    assert moments.possible is not None
    # Without the shrinkage the spread is a fifth of the variance of simulations.
    spread = moments.possible.var(dim=1).mean()
    assert float(spread) < 0.03 * gaussian.NOISE_STD**2


def test_the_possible_means_of_a_wide_label_are_hardly_shrunk() -> None:
    torch.manual_seed(0)
    normal = gaussian.prior(2)
    known = parameters_of(measured(normal.sample((40,)), 1.0, 1.0), normal)
    moments = labelled_moments(rope().source, known, 100, lambda x: x, progress=False)
    assert moments.possible is not None
    error = moments.possible - known.draws.double()
    assert float(error.square().mean()) < 0.06 * gaussian.NOISE_STD**2


def half_measured(count: int) -> tuple[Tensor, Tensor]:
    """Return pairs of which each has one parameter."""
    torch.manual_seed(0)
    theta = gaussian.prior().sample((count,))
    x = gaussian.real_process(theta)
    theta[::2, 0] = NAN
    theta[1::2, 1] = NAN
    return theta, x


@pytest.mark.medium
def test_targets_of_missing_parameters_are_what_x_says_about_them() -> None:
    theta, x = half_measured(200)
    conductor = RoPE(gaussian.posterior(), simulator=gaussian.simulator)
    bench = Workbench(
        conductor.append_calibration(theta, x),
        num_folds=2,
        seed=0,
        show_progress_bars=False,
    )
    targets = bench.targets(torch.arange(200), seed=0)
    # E[0.8 theta | x], whose mean size is 0.57.
    error = (targets - gaussian.GAIN**2 * gaussian.undo(x))[theta.isnan()]
    assert float(error.abs().mean()) < 0.15


@pytest.mark.medium
def test_tuning_on_partial_labels_keeps_what_x_says_about_missing_parameters() -> None:
    theta, x = half_measured(600)
    finetuner = CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=300)
    conductor = RoPE(
        gaussian.posterior(), simulator=gaussian.simulator, finetuner=finetuner
    )
    conductor.append_calibration(theta, x).train(seed=0, show_progress_bars=False)
    at = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    level, *moved = conductor.tuned_embedding_net(at).detach()
    # Of exact labels the slope is that of E[0.8 theta | x]. Targets that only know the
    # label would give half of it.
    slope = gaussian.GAIN**2 / gaussian.SCALE
    expected = slope * torch.eye(2)
    assert torch.allclose(torch.stack(moved) - level, expected, atol=0.15 * slope)


def test_expected_means_are_those_of_the_normal_posterior() -> None:
    torch.manual_seed(0)
    m = torch.randn(2000, 1).double()
    noise = 0.1 * torch.eye(1).double()
    # Reality has a gain of 0.5, an offset of 2, and errors of variance 0.04.
    z = 0.5 * m + 2.0 + 0.2 * torch.randn_like(m)
    discrepancy = DiscrepancyModel().fit(z, m, noise)
    possible = torch.distributions.Normal(0.0, 1.0).icdf(torch.arange(1, 1000) / 1000)
    at = torch.tensor([[1.5], [2.0], [3.0]]).double()
    found = expected_means(
        discrepancy, at, possible.double()[None, :, None].expand(3, -1, -1)
    )
    expected = 0.5 / (0.25 + 0.04) * (at - 2.0)
    assert torch.allclose(found, expected, atol=0.05)


@pytest.mark.parametrize("smallest", [1e-3, 1e-5, 1e-7])
def test_parameters_may_be_known_with_very_different_precision(smallest: float) -> None:
    box = BoxUniform(-torch.ones(2), torch.ones(2))
    y = torch.tensor([[0.3, -0.2]])
    q = MultivariateNormal(torch.zeros(2).double(), 0.3 * torch.eye(2).double() + 0.1)
    torch.manual_seed(0)
    samples = reference_of(q.sample(torch.Size((200, 1))))
    nodes = nodes_of(measured(y, smallest, 0.1), [samples], box, num_nodes=2000)
    found = nodes.log_mean(q.log_prob(nodes.theta.double()))
    noise = torch.tensor([smallest, 0.1]).double().square().diag()
    exact = MultivariateNormal(q.mean, q.covariance_matrix + noise).log_prob(y.double())
    assert abs(float(found - exact)) < 0.05


@pytest.mark.parametrize("y", [0.9, 1.2, 1.5, 2.0])
def test_the_density_of_a_label_outside_the_support_is_that_of_quadrature(
    y: float,
) -> None:
    box = BoxUniform(-torch.ones(1), torch.ones(1))
    label = measured(torch.tensor([[y]]), 0.15)
    nodes = nodes_of(label, [], box, num_nodes=64)
    found = nodes.log_mean(torch.full(nodes.log_weights.shape, math.log(0.5)).double())
    grid = torch.linspace(-1, 1, 20_001, dtype=torch.double)
    noise = torch.distributions.Normal(grid, 0.15).log_prob(torch.tensor(y).double())
    assert float(found) == pytest.approx(float(noise.exp().mean().log()), abs=0.6)


def test_labels_with_hardly_a_node_inside_get_others() -> None:
    # The reference is far outside of the box in five of six parameters.
    box = BoxUniform(-torch.ones(6), torch.ones(6))
    label = measured(torch.full((1, 6), 1.3), *[0.3] * 6)
    nodes = nodes_of(label, [], box, num_nodes=32)
    assert int(torch.isfinite(nodes.log_weights).sum()) >= 4
    found = nodes.log_mean(torch.full(nodes.log_weights.shape, math.log(0.5**6)))
    grid = torch.linspace(-1, 1, 20_001, dtype=torch.double)
    noise = torch.distributions.Normal(grid, 0.3).log_prob(torch.tensor(1.3).double())
    exact = 6 * float(noise.exp().mean().log())
    assert float(found) == pytest.approx(exact, abs=1.0)


def test_labels_on_a_bound_are_inside() -> None:
    box = BoxUniform(-torch.ones(2), torch.ones(2))
    for theta in ([NAN, 1.0], [NAN, -1.0], [0.3, 1.0]):
        label = measured(torch.tensor([theta]), 0.1, 0.0)
        if math.isnan(theta[0]):
            label = Labels.exact(torch.tensor([theta]))
        draws = parameters_of(label, box).draws[0]
        assert bool((draws[:, 1] == theta[1]).all())
        assert float(draws[:, 0].std()) > 0.05


def test_targets_of_noisy_labels_are_means_of_as_many_simulations_as_asked_for() -> (
    None
):
    called = []

    def simulator(theta: Tensor) -> Tensor:
        called.append(len(theta))
        return gaussian.simulator(theta)

    conductor = RoPE(gaussian.posterior(), simulator=simulator)
    conductor.append_calibration(*gaussian.labelled(3), theta_std=0.3)
    called.clear()
    conductor.draw_targets(simulations_per_target=250, show_progress_bars=False)
    assert sum(called) == 750


# What may be meant differently -------------------------------------------------------


def test_weights_that_were_normalised_are_warned_of() -> None:
    theta, x = gaussian.labelled(12)
    with pytest.warns(RoPEWarning, match="12 pairs sum to 1, .* do not normalise"):
        conductor = rope().append_calibration(theta, x, weights=torch.ones(12) / 12)
    assert "and counted as 1" in str(conductor.labels)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RoPEWarning)
        rope().append_calibration(theta, x, weights=torch.linspace(0.5, 1.5, 12))


@pytest.mark.medium
def test_several_labels_exactly_on_a_bound_of_the_prior_are_named() -> None:
    def appended(*on_bound: int, **options: Any) -> None:
        theta, x = problem(40, seed=1)  # the prior is uniform from -1 to 1
        theta[list(on_bound), 1] = -1.0
        made = rope_of((theta[:0], x[:0]), parameter_names=("height", "harvest"))
        made.append_calibration(theta, x, **options)

    match = "3 of 40 labels of harvest lie exactly on the prior's bound"
    with pytest.warns(RoPEWarning, match=match):
        appended(3, 8, 20)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RoPEWarning)
        appended(3, 8)  # a share that rounding explains
        appended(3, 8, 20, theta_std=0.1)
        theta, x = gaussian.labelled(20)  # a prior without bounds
        rope().append_calibration(theta, x)


def test_a_failed_simulation_is_replaced_by_another_one_of_the_same_label() -> None:
    """A label is lost only if all simulations at its possible parameters failed."""

    def simulator(theta: Tensor) -> Tensor:
        x = theta.clone()
        x[theta[:, 0] > 0] = NAN  # known parameters fail, so that rows can be compared
        return x

    source = Simulator(
        simulator,
        BoxUniform(-torch.ones(2), torch.ones(2)),
        event_shape=torch.Size((2,)),
        like=torch.zeros(1, 2),
    )
    theta = 2 * torch.rand(6, 50, 2) - 1
    with pytest.warns(RoPEWarning, match="Dropped"):
        used, x = source.once_at(theta, lambda x: x, progress=False)
    assert torch.equal(used, x)
    usable = theta[..., 0] <= 0
    assert torch.equal(used[usable], theta[usable])
    for row in range(6):
        known = {tuple(one) for one in theta[row][usable[row]].tolist()}
        assert {tuple(one) for one in used[row].tolist()} == known
        # All of them are used about equally often.
        counts = used[row].unique(dim=0, return_counts=True)[1]
        assert int(counts.max() - counts.min()) <= 1
    theta[2, :, 0] = 0.5
    with pytest.raises(SimulationError, match=r"parameters \[\[0\.5.* failed"):
        source.once_at(theta, lambda x: x, progress=False)

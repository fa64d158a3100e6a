"""What a stack says of itself, against the numbers it is made of."""

import functools
import math
import sys
from dataclasses import replace
from typing import Any

import pytest
import torch

from sbi_rope import CalibrationFinetuner, RoPE, StackedPosterior, plots, stack
from sbi_rope.baselines import PriorPosterior
from sbi_rope.errors import (
    InvalidInputError,
    InvalidTypeError,
    NotReadyError,
    UnsupportedPosteriorError,
)
from sbi_rope.metrics import acauc_of
from sbi_rope.stacking import (
    CouplingCandidate,
    DensityCandidate,
    LearningCurve,
    StackingReport,
    default_candidates,
)
from tests import gaussian

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")

CANDIDATES = (
    CouplingCandidate(gamma=0.1, tau=1.0),
    CouplingCandidate(gamma=0.2, tau=0.5, tuned=False),
    *(c for c in default_candidates() if c.name in ("prior", "NPE")),
)


def the_rope() -> RoPE:
    finetuner = CalibrationFinetuner(num_steps=10, simulations_per_target=5)
    rope = RoPE(gaussian.posterior(), simulator=gaussian.simulator, finetuner=finetuner)
    rope.append_calibration(*gaussian.labelled(12))
    return rope.train(seed=0, show_progress_bars=False)


@functools.cache
def the_stack() -> StackedPosterior:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return stack(
            the_rope(),
            gaussian.labelled(25)[1],
            candidates=CANDIDATES,
            num_simulations=50,
            learning_curve=True,
            seed=0,
            show_progress_bars=False,
        )


def the_report() -> StackingReport:
    return the_stack().report


def test_gains_are_mean_differences_of_scores_on_one_footing() -> None:
    scores = the_report().cross_validation
    for name in ("prior", "NPE"):
        gain = the_report().gain_over(name)
        assert gain is not None
        difference = scores.scores_of("stack") - scores.scores_of(name)
        assert math.isclose(gain.mean, float(difference.mean()), rel_tol=1e-9)
        assert gain.low < gain.mean < gain.high
        assert f"{gain.mean:+.2f} nats a pair" in str(the_report())
    assert the_report().gain_over("nobody") is None


def test_the_scores_of_the_stack_are_with_and_without_normalisation() -> None:
    report = the_report()
    scores = report.cross_validation
    assert math.isclose(report.score[0], float(scores.stack_scores.mean()))
    comparable = scores.scores_of("stack")
    assert math.isclose(report.comparable_score[0], float(comparable.mean()))
    # A Gaussian prior has no bound, so that nothing leaks.
    assert torch.allclose(comparable, scores.stack_scores, atol=1e-3)


def test_weights_of_families_are_summed_and_said_in_words() -> None:
    weights = the_report().family_weights
    assert set(weights) == {"RoPE", "OT-only", "prior", "NPE"}
    assert math.isclose(sum(weights.values()), 1.0, rel_tol=1e-9)
    assert list(weights.values()) == sorted(weights.values(), reverse=True)
    family, weight = next(iter(weights.items()))
    expected = f"mostly {family}" if weight >= 0.5 else "no method has half"
    assert expected in str(the_report())


def test_calibration_is_that_of_held_out_pairs() -> None:
    levels = the_report().cross_validation.levels()
    assert torch.equal(levels, the_report().levels)
    assert the_report().coverage.num_observations == 12
    assert f"ACAUC {acauc_of(levels).value:+.3f}" in str(the_report())
    inside = (levels <= 0.9).double().mean()
    assert f"90% intervals hold {inside:.0%} of the parameters" in str(the_report())


def test_rows_are_sorted_and_make_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = the_report().as_rows()
    scores = [row["score"] for row in rows]
    assert scores == sorted(scores, reverse=True)
    assert {row["candidate"] for row in rows} == {c.name for c in CANDIDATES}
    pandas = pytest.importorskip("pandas")
    assert isinstance(the_report().to_dataframe(), pandas.DataFrame)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        the_report().to_dataframe()


def test_the_learning_curve_has_a_point_for_one_two_and_four_folds() -> None:
    curve = the_report().learning_curve
    assert curve is not None
    assert curve.num_pairs == (2, 4, 9)
    last = the_report().cross_validation.stack_scores
    assert math.isclose(curve.scores[-1], float(last.mean()))
    assert "score when trained on so many pairs: 2: " in str(the_report())


def test_what_more_labels_might_add_follows_the_curve() -> None:
    # s(n) = 1 - 3 / n, so that from 20 to 40 it is 3 / 40.
    curve = LearningCurve(
        num_pairs=(5, 10, 20), scores=(0.4, 0.7, 0.85), standard_errors=(0.1,) * 3
    )
    assert math.isclose(curve.gain_of_doubling(), 3 / 40)
    falling = LearningCurve(
        num_pairs=(5, 10), scores=(0.4, 0.3), standard_errors=(0.1, 0.1)
    )
    assert falling.gain_of_doubling() == 0.0
    single = LearningCurve(num_pairs=(5,), scores=(0.4,), standard_errors=(0.1,))
    assert math.isnan(single.gain_of_doubling())
    report = replace(the_report(), learning_curve=single)
    assert "nan" not in str(report)


@pytest.mark.parametrize("with_curve", [True, False])
def test_the_picture_names_candidates_and_families(with_curve: bool) -> None:
    report = the_report()
    if not with_curve:
        report = replace(report, learning_curve=None)
    figure = plots.stacking_report(report)
    assert len(figure.axes) == (4 if with_curve else 3)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert {*labels} == {"stack", *(c.name for c in CANDIDATES)}
    plots.effective_sample_sizes(the_stack().couplings[0])


def test_stacks_inside_a_cross_validation_have_no_report() -> None:
    _, part = next(iter(the_report().cross_validation.posteriors()))
    with pytest.raises(NotReadyError, match=r"stack\(rope, x_o\)"):
        _ = part.report


# What is asked of a stack ------------------------------------------------------------


def test_whole_numbers_have_the_density_of_these_numbers() -> None:
    posterior = the_stack()
    theta = torch.zeros(3, 25, 2)
    expected = posterior.log_prob_batched(theta, posterior.x_o)
    found = posterior.log_prob_batched(theta.long(), posterior.x_o)
    assert torch.allclose(found, expected)


def test_the_densities_of_candidates_are_normalised_where_rope_is() -> None:
    posterior = the_stack()
    theta = gaussian.labelled(25)[0]
    found = posterior.candidate_log_probs(theta, posterior.x_o)
    estimator: Any = posterior.posterior_estimator
    # Nothing leaks out of an unbounded prior.
    plain = estimator.candidate_log_probs(theta, posterior.x_o)
    assert found.shape == (25, 4)
    assert torch.allclose(found, plain)
    half = torch.full((50,), 0.5, dtype=torch.double)
    masses = {"component_mass": half}
    halved = estimator.candidate_log_probs(theta, posterior.x_o, **masses)
    expected = plain + torch.tensor([math.log(2), math.log(2), 0.0, 0.0])
    assert torch.allclose(halved, expected)


def test_moving_a_stack_leaves_its_report() -> None:
    posterior = the_stack()
    assert posterior.prior is not posterior.report.cross_validation.prior
    _, part = next(iter(posterior.report.cross_validation.posteriors()))
    record = posterior.report.cross_validation.estimators[0]
    assert (
        part.posterior_estimator.coupled[0].simulated is not record.coupled[0].simulated
    )


@pytest.mark.parametrize(
    ("options", "error", "match"),
    [
        ({"build": "posterior"}, InvalidTypeError, "Wrap a posterior"),
        ({"name": "stack"}, InvalidInputError, "another name"),
        ({"name": 3}, InvalidTypeError, "name"),
        ({"fixed": "yes"}, InvalidTypeError, "fixed"),
    ],
)
def test_bad_density_candidates_are_refused(
    options: dict[str, Any], error: type[Exception], match: str
) -> None:
    valid: dict[str, Any] = {"name": "mine", "build": lambda rope, seed: rope.npe}
    with pytest.raises(error, match=match):
        DensityCandidate(**{**valid, **options})


def test_a_prior_of_other_parameters_is_no_candidate() -> None:
    other = DensityCandidate(
        name="other",
        build=lambda rope, seed: PriorPosterior(gaussian.prior(3)),
        fixed=True,
    )
    with pytest.raises(UnsupportedPosteriorError, match="'other'"):
        stack(
            the_rope(),
            gaussian.labelled(25)[1],
            candidates=(*CANDIDATES, other),
            num_simulations=50,
            seed=0,
            show_progress_bars=False,
        )


@pytest.mark.parametrize(
    "rows",
    [torch.tensor([12]), torch.tensor([-1]), torch.tensor([0.0]), torch.ones(())],
)
def test_rows_that_are_no_pairs_are_refused(rows: torch.Tensor) -> None:
    rope = the_rope()
    for call in (rope.with_pairs, rope.draw_targets):
        with pytest.raises(InvalidInputError, match="rows"):
            call(rows)

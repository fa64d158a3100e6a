"""The report of a stack, against the numbers that it is made of."""

import math
import sys
from dataclasses import replace

import pytest
import torch
from torch import nn

from sbi_rope import plots
from sbi_rope.metrics import acauc_of
from sbi_rope.stacking import (
    CrossValidation,
    Difference,
    DiscrepancyCandidate,
    LearningCurve,
    StackingReport,
)
from tests import problems
from tests.stacks import (
    FITTED,
    OT_ONLY,
    PRIOR,
    ROPE,
    observed,
    rope_of,
    stacked,
    the_coupled_stack,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")

DISCREPANCY = DiscrepancyCandidate(space="embedding")
NAMES = ("prior", "NPE", "RoPE (gamma 0.1, tau 1)", "RoPE (gamma 0.1, tau 0)")


def made_up(
    *, n: int = 12, npe: float = -4.0, coupled: float = -1.0, leak: float = 0.2
) -> StackingReport:
    """A report of made-up numbers."""
    generator = torch.Generator().manual_seed(0)
    means = torch.tensor([-2.0, npe, coupled, coupled], dtype=torch.double)
    log_scores = means + 0.3 * torch.randn(n, 4, generator=generator).double()
    scores = CrossValidation(
        names=NAMES,
        families=("prior", "NPE", "RoPE", "RoPE"),
        log_scores=log_scores,
        fold=torch.arange(n) % 3,
        num_trained_on=2 * n // 3,
        stack_scores=log_scores[:, 2] + leak,
        levels=torch.rand(n, 2, generator=generator),
    )
    return StackingReport.of(scores)


def test_gains_are_mean_differences_of_comparable_scores() -> None:
    report = made_up()
    scores = report.cross_validation
    for name in ("prior", "NPE"):
        gain = report.gains[name]
        difference = scores.scores_of("stack") - scores.scores_of(name)
        assert math.isclose(gain.mean, float(difference.mean()), rel_tol=1e-9)
        assert gain.low < gain.mean < gain.high
        assert f"{gain.mean:+.2f} nats a pair" in str(report)
    assert "better than the prior" in str(report)
    assert "WORSE than the prior" in with_gain(report, low=-0.3, high=-0.1)
    assert "not shown to differ from the prior" in with_gain(report, low=-1, high=1)


def with_gain(report: StackingReport, *, low: float, high: float) -> str:
    gain = Difference(mean=(low + high) / 2, low=low, high=high)
    return str(replace(report, gains={"prior": gain}))


def test_the_stated_score_is_that_of_the_normalised_density() -> None:
    report = made_up(leak=0.2)
    scores = report.cross_validation.stack_scores
    mean, error = report.score
    assert math.isclose(mean, float(scores.mean()))
    assert math.isclose(error, float(scores.std()) / 12**0.5)
    assert f"log score of the stack: {mean:.2f} +- {error:.2f} a pair" in str(report)
    comparable = report.cross_validation.scores_of("stack")
    assert math.isclose(report.comparable_score[0], float(comparable.mean()))


def test_weights_of_families_are_summed_and_explained() -> None:
    report = made_up()
    weights = report.family_weights
    assert next(iter(weights)) == "RoPE"
    assert set(weights) == {"prior", "NPE", "RoPE"}
    found = report.cross_validation.weights.weights
    assert weights["RoPE"] == pytest.approx(float(found[2:].sum()))
    assert math.isclose(sum(weights.values()), 1.0, rel_tol=1e-9)
    assert list(weights.values()) == sorted(weights.values(), reverse=True)
    assert "mostly RoPE: tuning and transport repair the simulator" in str(report)
    assert f"RoPE {weights['RoPE']:.0%}" in str(report)
    torn = replace(report, family_weights={"prior": 0.4, "NPE": 0.3, "RoPE": 0.3})
    assert "no method has half of the weight: prior 40%" in str(torn)


def test_the_text_says_whether_the_stack_is_over_or_under_confident() -> None:
    report = made_up(n=400)
    levels = report.levels
    for found, verdict in (
        (levels, "calibrated as far as these pairs can tell"),
        (levels.sqrt(), "over-confident"),
        (levels.square(), "under-confident"),
    ):
        scores = replace(report.cross_validation, levels=found)
        assert f"\n  {verdict}: ACAUC" in str(StackingReport.of(scores))


def test_calibration_is_that_of_held_out_pairs() -> None:
    report = the_coupled_stack().report
    levels = report.cross_validation.levels
    assert torch.equal(levels, report.levels)
    assert report.coverage.num_observations == 20
    assert f"ACAUC {acauc_of(levels).value:+.3f}" in str(report)
    inside = (levels <= 0.9).double().mean()
    assert f"90% intervals hold {inside:.0%} of the parameters" in str(report)


def test_rows_are_sorted_and_make_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    report = the_coupled_stack().report
    rows = report.as_rows()
    scores = [row["score"] for row in rows]
    assert scores == sorted(scores, reverse=True)
    assert {row["candidate"] for row in rows} == {*report.cross_validation.names}
    pandas = pytest.importorskip("pandas")
    assert isinstance(report.to_dataframe(), pandas.DataFrame)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        report.to_dataframe()


def test_the_learning_curve_has_a_point_for_one_two_and_four_folds() -> None:
    candidates = [ROPE, OT_ONLY, PRIOR, FITTED]
    report, without = (
        stacked(
            rope_of(), observed(), candidates=candidates, learning_curve=curve
        ).report
        for curve in (True, False)
    )
    curve = report.learning_curve
    assert curve is not None
    assert curve.num_pairs == (4, 8, 16)
    last = report.cross_validation.stack_scores
    assert math.isclose(curve.scores[-1], float(last.mean()))
    # The stack is the same without its learning curve.
    found = without.cross_validation.log_scores
    assert torch.equal(report.cross_validation.log_scores, found)
    assert without.learning_curve is None
    assert len(set(curve.scores)) == 3
    assert f"on so many pairs: 4: {curve.scores[0]:.2f}, 8: " in str(report)


def test_the_gain_of_twice_as_many_labels_is_extrapolated_from_the_curve() -> None:
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
    assert "nan" not in str(replace(made_up(), learning_curve=single))


def test_the_picture_names_candidates_and_has_a_panel_for_the_learning_curve() -> None:
    curve = LearningCurve(
        num_pairs=(4, 8), scores=(0.3, 0.4), standard_errors=(0.1, 0.1)
    )
    for shown, num_panels in ((curve, 4), (None, 3)):
        figure = plots.stacking_report(replace(made_up(), learning_curve=shown))
        assert len(figure.axes) == num_panels
        labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
        assert {*labels} == {"stack", *NAMES}


def test_printing_a_report_computes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    report = the_coupled_stack().report
    state = torch.get_rng_state()

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("something was computed")

    monkeypatch.setattr(nn.Module, "__call__", refuse)
    with monkeypatch.context() as patch:
        for name in ("mean", "std", "sum", "sort", "logsumexp", "__getitem__"):
            patch.setattr(torch.Tensor, name, refuse)
        assert str(report).startswith("Stack of")
    report.as_rows()
    plots.stacking_report(report)
    assert torch.equal(torch.get_rng_state(), state)


def test_a_cross_validation_holds_only_numbers_and_names() -> None:
    for value in vars(the_coupled_stack().report.cross_validation).values():
        assert isinstance(value, torch.Tensor | tuple | int | float) or (
            type(value).__name__ == "StackingWeights"
        )


def test_a_report_says_how_often_the_simulator_was_called_for_the_stack() -> None:
    rope = rope_of()
    before = rope.num_simulator_calls
    report = stacked(rope, candidates=[PRIOR, DISCREPANCY]).report
    # 300 from the prior and 5 at the parameters of each of 20 pairs.
    assert report.num_simulator_calls == rope.num_simulator_calls - before == 400
    assert "simulator calls: 400" in str(report)
    # Those from the prior are kept for the next stack.
    again = stacked(rope, candidates=[PRIOR, DISCREPANCY]).report
    assert again.num_simulator_calls == 100
    many = replace(report, num_simulator_calls=7421)
    assert "simulator calls: 7,421" in str(many)
    theta = problems.box(2).sample((1000,))
    stored = rope_of(simulations=(theta, problems.simulate(theta)))
    report = stacked(stored, candidates=[PRIOR, DISCREPANCY]).report
    assert report.num_simulator_calls == 0
    assert "simulator calls" not in str(report)

"""What a stack says of itself, against the numbers it is made of."""

import math
import sys
from dataclasses import replace

import pytest
import torch
from torch import nn

from sbi_rope import plots
from sbi_rope.metrics import acauc_of
from sbi_rope.stacking import CrossValidation, LearningCurve, StackingReport
from tests.stacks import rope_of, stacked, the_coupled_stack, the_stack

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")

NAMES = ("prior", "NPE", "RoPE (gamma 0.1, tau 1)", "RoPE (gamma 0.1, tau 0)")


def made_up(
    *, n: int = 12, npe: float = -4.0, coupled: float = -1.0, leak: float = 0.2
) -> StackingReport:
    """A report of numbers alone."""
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


def test_gains_are_mean_differences_of_scores_on_one_footing() -> None:
    report = made_up()
    scores = report.cross_validation
    for name in ("prior", "NPE"):
        gain = report.gains.get(name)
        assert gain is not None
        difference = scores.scores_of("stack") - scores.scores_of(name)
        assert math.isclose(gain.mean, float(difference.mean()), rel_tol=1e-9)
        assert gain.low < gain.mean < gain.high
        assert f"{gain.mean:+.2f} nats a pair" in str(report)
    assert "better than the prior" in str(report)
    assert "WORSE than NPE as it was" in str(made_up(npe=3.0, n=300, coupled=2.99)) or (
        "not shown to differ from NPE" in str(made_up(npe=3.0, n=300, coupled=2.99))
    )


def test_the_score_of_the_stack_is_stated_normalised() -> None:
    report = made_up(leak=0.2)
    scores = report.cross_validation.stack_scores
    mean, error = report.score
    assert math.isclose(mean, float(scores.mean()))
    assert math.isclose(error, float(scores.std()) / 12**0.5)
    assert f"log score of the stack: {mean:.2f} +- {error:.2f} a pair" in str(report)
    comparable = report.cross_validation.scores_of("stack")
    assert math.isclose(report.comparable_score[0], float(comparable.mean()))


def test_weights_of_families_are_summed_and_said_in_words() -> None:
    report = made_up()
    weights = report.family_weights
    (rope, *others) = weights.items()
    assert rope[0] == "RoPE"
    assert math.isclose(sum(weights.values()), 1.0, rel_tol=1e-9)
    assert list(weights.values()) == sorted(weights.values(), reverse=True)
    assert {name for name, _ in others} == {"prior", "NPE"}
    assert "mostly RoPE: tuning and transport repair the simulator" in str(report)
    assert f"RoPE {weights['RoPE']:.0%}" in str(report)
    torn = made_up(npe=-1.0, coupled=-1.0, n=4)
    assert "no method has half of the weight" in str(torn) or (
        max(torn.family_weights.values()) >= 0.5
    )


def test_calibration_is_that_of_held_out_pairs() -> None:
    report = the_stack().report
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
    posterior = stacked(rope_of(), learning_curve=True, tail_mass=0.0)
    report = posterior.report
    curve = report.learning_curve
    assert curve is not None
    assert curve.num_pairs == (4, 8, 16)
    last = report.cross_validation.stack_scores
    assert math.isclose(curve.scores[-1], float(last.mean()))
    # The curve is beside the stack, which is the same without.
    without = the_stack().report.cross_validation
    assert torch.equal(report.cross_validation.log_scores, without.log_scores)
    assert len(set(curve.scores)) == 3
    assert f"on so many pairs: 4: {curve.scores[0]:.2f}, 8: " in str(report)


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
    assert "nan" not in str(replace(made_up(), learning_curve=single))


@pytest.mark.parametrize("with_curve", [True, False])
def test_the_picture_names_candidates_and_families(with_curve: bool) -> None:
    curve = LearningCurve(
        num_pairs=(4, 8), scores=(0.3, 0.4), standard_errors=(0.1, 0.1)
    )
    report = replace(made_up(), learning_curve=curve if with_curve else None)
    figure = plots.stacking_report(report)
    assert len(figure.axes) == (4 if with_curve else 3)
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert {*labels} == {"stack", *NAMES}


@pytest.mark.parametrize("coupled", [False, True])
def test_printing_a_report_computes_nothing(
    coupled: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = (the_coupled_stack() if coupled else the_stack()).report
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


def test_a_report_holds_numbers_alone() -> None:
    for value in vars(the_coupled_stack().report.cross_validation).values():
        assert isinstance(value, torch.Tensor | tuple | int | float) or (
            type(value).__name__ == "StackingWeights"
        )

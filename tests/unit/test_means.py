"""Means over pairs that count differently, or that are not independent."""

import math

import pytest
import torch

from sbi_rope._statistics import interval_of_mean, mean_and_error
from sbi_rope.data import Counts
from sbi_rope.metrics import acauc_of, coverage_curve_of, expected_coverage_error_of
from sbi_rope.stacking import CrossValidation, LearningCurve

torch.manual_seed(0)
VALUES = torch.randn(12, dtype=torch.double)
LEVELS = torch.rand(12, 2, dtype=torch.double)
# Each pair four times.
GROUPS = torch.arange(12).repeat_interleave(4)
REPEATED = Counts(torch.full((48,), 0.25).double(), GROUPS)
TIMES = torch.tensor([1, 2, 3] * 4)


def test_repeated_pairs_give_the_errors_of_single_ones() -> None:
    repeated = VALUES.repeat_interleave(4)
    assert mean_and_error(repeated, REPEATED) == pytest.approx(
        mean_and_error(VALUES, None)
    )
    assert interval_of_mean(repeated, REPEATED) == pytest.approx(
        interval_of_mean(VALUES, None)
    )
    assert REPEATED.effective_number == pytest.approx(12)


def test_an_interval_holds_the_mean_as_often_if_one_pair_counts_as_all_others() -> None:
    generator = torch.Generator().manual_seed(0)
    counts, held = Counts(torch.tensor([29.0] + [1.0] * 29).double()), 0
    for _ in range(400):
        values = torch.randn(30, generator=generator, dtype=torch.double)
        _, low, high = interval_of_mean(values, counts)
        held += low < 0 < high
    # In many more draws it is 98 %; as if 30 pairs counted the same, it is 68 %.
    assert held > 0.93 * 400


def test_repeated_pairs_give_the_calibration_of_single_ones() -> None:
    levels = LEVELS.repeat_interleave(4, dim=0)
    once, found = acauc_of(LEVELS), acauc_of(levels, REPEATED)
    assert found.value == pytest.approx(once.value)
    assert found.interval == pytest.approx(once.interval)
    torch.testing.assert_close(found.per_parameter, once.per_parameter)
    curve, of_pairs = (
        coverage_curve_of(LEVELS),
        coverage_curve_of(levels, REPEATED),
    )
    torch.testing.assert_close(of_pairs.per_parameter, curve.per_parameter)
    torch.testing.assert_close(of_pairs.standard_error, curve.standard_error)
    assert of_pairs.num_observations == 12
    error = expected_coverage_error_of(LEVELS)
    of_pairs = expected_coverage_error_of(levels, REPEATED)
    assert of_pairs.value == pytest.approx(error.value)
    assert of_pairs.standard_error == pytest.approx(error.standard_error)


def test_a_weight_counts_as_so_many_pairs() -> None:
    levels = LEVELS.clone()
    levels[2, 0] = math.nan  # a parameter that was not measured
    counts = Counts(TIMES.double())
    several = levels.repeat_interleave(TIMES, dim=0)
    found = acauc_of(levels, counts)
    expected = acauc_of(several)
    assert found.value == pytest.approx(expected.value)
    torch.testing.assert_close(found.per_parameter, expected.per_parameter)
    torch.testing.assert_close(
        coverage_curve_of(levels, counts).per_parameter,
        coverage_curve_of(several).per_parameter,
    )
    assert expected_coverage_error_of(levels, counts).value == pytest.approx(
        expected_coverage_error_of(several).value
    )


def test_recordings_with_the_same_parameters_do_not_make_a_report_more_certain() -> (
    None
):
    log_scores = torch.randn(12, 2, dtype=torch.double)
    fold = torch.arange(12) % 3

    def scores(times: int) -> CrossValidation:
        groups = torch.arange(12).repeat_interleave(times)
        return CrossValidation(
            names=("prior", "NPE"),
            families=("prior", "NPE"),
            log_scores=log_scores.repeat_interleave(times, dim=0),
            fold=fold.repeat_interleave(times),
            num_trained_on=8,
            stack_scores=VALUES.repeat_interleave(times),
            levels=LEVELS.repeat_interleave(times, dim=0),
            estimates=torch.zeros(12 * times, LEVELS.shape[1]),
            ranks=LEVELS.repeat_interleave(times, dim=0),
            counts=Counts(torch.full((12 * times,), 1 / times), groups)
            if times > 1
            else None,
        )

    once, often = scores(1), scores(4)
    torch.testing.assert_close(often.weights.weights, once.weights.weights)
    assert often.effective_number == pytest.approx(12)
    for name in ("prior", "stack"):
        first, second = (one.difference(name, "NPE") for one in (once, often))
        assert vars(second) == pytest.approx(vars(first), rel=1e-4)
    row, other = once.as_rows()[0], often.as_rows()[0]
    assert other["standard_error"] == pytest.approx(row["standard_error"])
    gains = [LearningCurve.of([one, one]) for one in (once, often)]
    assert gains[1].standard_errors == pytest.approx(gains[0].standard_errors)


def test_an_infinite_score_has_an_infinite_error_whatever_pairs_count_as() -> None:
    values = torch.cat([VALUES, torch.tensor([-math.inf]).double()])
    for counts in (None, Counts(torch.ones(13)), Counts(torch.ones(13), GROUPS[:13])):
        assert mean_and_error(values, counts) == (-math.inf, math.inf)

"""The report of a stack as text, as a page and as a picture, against its numbers."""

import base64
import html
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import scipy.stats
import torch
from torch.distributions import MultivariateNormal

from sbi_rope import diagnose, plots
from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.metrics import Evaluation
from sbi_rope.metrics.statistics import Estimate, TwoSampleTest
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.report import write_html
from sbi_rope.stacking import LearningCurve, StackingReport
from sbi_rope.stacking.candidates import DiscrepancyCandidate
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning
from tests import problems
from tests.stacks import (
    BOX,
    NPE,
    PRIOR,
    QUIET,
    data_of,
    observed,
    problem,
    quick,
    rope_of,
    scores_of,
    stacked,
    the_stack,
    trained,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning")

DISCREPANCY = DiscrepancyCandidate(space="embedding")
CANDIDATES = ("prior", "NPE", "discrepancy", "discrepancy (tuned)")
NAMES = ("mass <kg> & more", 'the "length"')


def made_up(
    *,
    n: int = 12,
    npe: float = -4.0,
    best: float = -1.0,
    leak: float = 0.2,
    weights: list[float] | None = None,
    **options: Any,
) -> StackingReport:
    """A report of made-up numbers."""
    generator = torch.Generator().manual_seed(0)
    means = torch.tensor([-2.0, npe, best, best], dtype=torch.double)
    log_scores = means + 0.3 * torch.randn(n, 4, generator=generator).double()
    ranks = torch.rand(n, 2, generator=generator, dtype=torch.double)
    held_out: dict[str, Any] = {
        "log_prob": log_scores[:, 2] + leak,
        "ranks": ranks,
        "estimates": torch.zeros(n, 2),
    }
    return StackingReport(
        names=CANDIDATES,
        weights=torch.tensor([0.1, 0.0, 0.3, 0.6] if weights is None else weights),
        log_scores=log_scores,
        comparable_scores=log_scores[:, 2],
        fold=torch.arange(n) % 3,
        held_out=Evaluation(**held_out | options),
    )


def flat(report: StackingReport) -> str:
    """The text of a report in one line."""
    return " ".join(str(report).split())


def test_gains_are_mean_differences_of_comparable_scores() -> None:
    report = made_up(leak=0.2)
    # The prior has no mass outside itself, and is compared with what is deployed.
    of_stack = {"NPE": report.comparable_scores, "prior": report.held_out.log_prob}
    for name, of_pairs in of_stack.items():
        difference = (of_pairs - scores_of(report, name)).numpy()
        low, high = scipy.stats.t.interval(
            0.95, df=11, loc=difference.mean(), scale=scipy.stats.sem(difference)
        )
        gain = report.gains[name]
        assert vars(gain) == pytest.approx(
            {"mean": difference.mean(), "low": low, "high": high}
        )
        assert f"{gain:+.2f} nats a pair" in flat(report)
    assert "Better than the prior" in flat(report)


def test_scores_are_stated_in_standard_deviations_of_the_prior() -> None:
    report = the_stack().report
    # The standard deviation of a uniform distribution on [-1, 1].
    unit = 2 * math.log(1 / 3**0.5)
    score, score_z = report.held_out.lpp, report.held_out.lpp_z
    assert vars(score_z) == pytest.approx({k: v + unit for k, v in vars(score).items()})
    assert f"{score_z:.2f} nats a pair with theta in standard" in flat(report)
    rows = report.as_rows()
    assert rows == sorted(rows, key=lambda row: -row["score"])
    assert {row["candidate"] for row in rows} == {*report.names}
    for row in rows:
        assert math.isclose(row["score_z"], row["score"] + unit, rel_tol=1e-6)
    # Without the prior's standard deviations there is one unit only.
    assert "with theta in its own units" in flat(made_up())


def test_a_comparison_says_no_more_than_its_interval(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for low, high, words in (
        (-0.3, -0.1, "Worse than the prior"),
        (-1, 1, "Not shown to differ from the prior"),
        (math.nan, math.inf, "the prior cannot be compared"),
    ):
        gain = {"prior": Estimate((low + high) / 2, low, high)}
        monkeypatch.setattr(StackingReport, "gains", gain)
        assert words in flat(made_up())


class Unstated(MultivariateNormal):
    """A prior that does not state its standard deviation."""

    stddev = property()


def test_the_unit_of_a_prior_is_estimated_from_draws_if_it_is_not_stated() -> None:
    prior = Unstated(torch.zeros(2), torch.diag(torch.tensor([4.0, 0.01])))
    found = float(PriorDistribution(prior).log_units().sum())
    assert found == pytest.approx(math.log(0.2), abs=0.05)


def test_weights_are_listed_and_those_of_the_prior_are_alarming() -> None:
    text, advice = flat(made_up()), "Check that rows of theta and x belong together."
    assert "Weights: discrepancy (tuned) 60%; discrepancy 30%; prior 10%." in text
    assert advice not in text
    assert advice in flat(made_up(weights=[0.7, 0.1, 0.1, 0.1]))


def test_the_text_says_what_to_do_about_over_confidence() -> None:
    narrow = (1 + torch.rand(400, 2).sqrt()) / 2
    assert "Collect more labels" in flat(made_up(n=400, ranks=narrow))
    calibrated = made_up(n=400)
    assert "Collect more labels" not in flat(calibrated)
    assert f"ACAUC {calibrated.held_out.acauc:+.3f}" in flat(calibrated)


@pytest.mark.medium
def test_a_batch_unlike_the_pairs_gives_a_warning_and_is_in_the_text() -> None:
    options = {"candidates": [NPE, PRIOR]}
    with pytest.warns(RoPEWarning, match="differs from the observations of the cal"):
        unlike = stacked(rope_of(), observed() + 1.0, **options).report
    assert "This need not hold for `x_o`, which differs from the pairs" in flat(unlike)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="`x_o` differs")
        like = stacked(rope_of(), observed(), **options).report
    assert "`x_o` is like them (p = " in flat(like)
    assert "`diagnose(rope, x_o, posterior=posterior)` tests others" in flat(made_up())


def test_a_stack_with_a_discrepancy_says_what_the_pairs_say_about_each_entry() -> None:
    report = the_stack().report
    found = report.discrepancy
    assert found is not None
    assert {summary.name for summary in found.summaries} == {"x[0]", "x[1]", "x[2]"}
    # Real observations are 0.4 higher.
    assert all(0.2 < summary.shift.median < 0.6 for summary in found.summaries)
    assert "3 of 3 entries of x are off" in flat(report)
    without = stacked(rope_of(), candidates=[PRIOR, BOX]).report
    assert without.discrepancy is None
    assert "Not tested: x is no complete vector of at most 20 numbers" in flat(without)


@pytest.mark.medium
def test_a_report_names_pairs_whose_parameters_do_not_follow_the_prior() -> None:
    theta = 0.2 * problem(20, seed=1)[0]
    middle = rope_of((theta, problems.simulate(theta) + 0.4))
    text = flat(stacked(middle, candidates=[PRIOR, NPE, DISCREPANCY]).report)
    assert "labels are not distributed like the prior" in text
    assert "default_candidates(rope, learn_prior=False)" in text
    kept = flat(stacked(middle, candidates=[PRIOR, NPE]).report)
    assert "Scores and coverage hold for parameters like these" in kept
    assert "not distributed like the prior" not in flat(the_stack().report)


@pytest.mark.medium
def test_every_model_of_the_discrepancy_knows_the_specimens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = [f"specimen {k % 8}" for k in range(16)]
    rope = rope_of(problem(16, seed=1), theta_std=0.1, groups=names)
    seen: list[Any] = []
    fit = DiscrepancyModel.fit

    def spied(self: Any, *args: Any, **options: Any) -> Any:
        seen.append(options["groups"].tolist())
        return fit(self, *args, **options)

    monkeypatch.setattr(DiscrepancyModel, "fit", spied)
    with quick():
        data = data_of(rope)
        assert "16 calibration pairs in 8 groups" in str(data.discrepancy())
        data.targets(torch.arange(16))
    rope.train(seed=0, **QUIET)
    assert seen == [[*range(8)] * 2] * (3 + 2)


@pytest.mark.medium
def test_recordings_of_a_specimen_count_once_whatever_their_labels_are() -> None:
    specimen = torch.arange(12).repeat_interleave(torch.tensor([3] * 6 + [1] * 6))
    theta = problem(12, seed=1)[0][specimen]
    x = problems.simulate(theta) + 0.4

    def report(labels: torch.Tensor, **options: Any) -> StackingReport:
        rope = rope_of((labels, x), **options)
        return stacked(rope, candidates=[PRIOR, NPE]).report

    # Equal exact labels are found without names.
    found, named = report(theta), report(theta, groups=specimen.tolist())
    assert torch.equal(found.log_scores, named.log_scores)
    assert found.held_out.lpp == named.held_out.lpp
    assert found.held_out.num_independent == pytest.approx(12)
    assert "24 hold-out calibration pairs in 12 groups" in flat(found)
    # Readings of the same specimen differ, and are still held out together.
    noisy = theta + 0.01 * torch.randn(theta.shape)
    together = report(noisy, theta_std=0.01, groups=specimen.tolist())
    assert together.held_out.num_independent == pytest.approx(12)
    assert all(len(together.fold[specimen == k].unique()) == 1 for k in range(12))
    assert report(noisy, theta_std=0.01).held_out.num_independent == 24


@pytest.mark.medium
def test_the_learning_curve_has_a_point_for_one_two_and_four_folds() -> None:
    report, without = (
        stacked(
            rope_of(), candidates=[NPE, PRIOR, BOX], num_folds=5, learning_curve=curve
        ).report
        for curve in (True, False)
    )
    curve = report.learning_curve
    assert curve is not None
    assert curve.num_pairs == (4, 8, 16)
    assert curve.scores[-1] == report.held_out.lpp
    assert len({score.mean for score in curve.scores}) == 3
    gain = curve.scores[1].mean - curve.scores[0].mean
    assert f"training on 4 pairs: {gain:+.2f} nats with 8, " in flat(report)
    # The stack is the same without its learning curve.
    assert torch.equal(report.log_scores, without.log_scores)
    assert without.learning_curve is None


def curve_of(scores: dict[int, torch.Tensor], **options: Any) -> LearningCurve:
    """A curve with a list of scores for each number of pairs."""
    reports = [made_up(n=len(s), log_prob=s, **options) for s in scores.values()]
    evaluations = tuple(one.held_out for one in reports)
    return LearningCurve(num_pairs=tuple(scores), evaluations=evaluations)


def test_the_gain_of_more_labels_is_extrapolated_from_the_curve() -> None:
    # The slopes b of 25 pairs, s(n) = 1 - b / n, and what their mean adds. A stack of
    # 25 pairs averages posteriors that were trained on 20, and one of 50 on 40.
    slopes = torch.linspace(1.0, 7.0, 25).double()
    scores = {n: 1 - slopes / n for n in (5, 10, 20)}
    curve = curve_of(scores)
    gain = curve.gain(25)
    interval = scipy.stats.t.interval(
        0.95, df=24, loc=4, scale=scipy.stats.sem(slopes.numpy())
    )
    expected = [one * (1 / 20 - 1 / 40) for one in (4, *interval)]
    assert [gain.mean, gain.low, gain.high] == pytest.approx(expected)
    assert curve.gain(5).mean == pytest.approx(4 * (1 / 20 - 1 / 24))
    # Recordings of 5 people: labels are those of people.
    fifth = torch.full((25,), 0.2).double()
    of_people = curve_of(scores, weight=fifth, group=torch.arange(25) // 5)
    assert of_people.gain(5).mean == pytest.approx(gain.mean)
    for one, words in ((of_people, "5 more groups"), (curve, "25 more labels")):
        text = flat(replace(made_up(), learning_curve=one))
        assert f"{words} might add {gain.mean:.2f} (" in text
    assert math.isnan(curve_of({5: slopes}).gain(10).mean)


def test_a_score_far_below_the_others_is_an_arrow_with_its_number() -> None:
    for npe, text in ((-382.0, "-382"), (-math.inf, "zero density")):
        scores = plots.stacking_report(made_up(npe=npe)).axes[0]
        low, high = scores.get_xlim()
        assert high - low < 12
        (note,) = scores.texts
        assert note.get_text() == text
        names = [label.get_text() for label in scores.get_yticklabels()]
        assert names[note.xy[1]] == "NPE"
    assert not plots.stacking_report(made_up()).axes[0].texts


@pytest.mark.medium
def test_a_report_says_how_often_the_simulator_was_called_for_the_stack() -> None:
    rope = rope_of()
    # 300 from the prior and 5 at the parameters of each of 20 pairs. Those from the
    # prior are kept for the next stack.
    for expected in (400, 100):
        before = rope.source.num_calls
        report = stacked(rope, candidates=[PRIOR, DISCREPANCY]).report
        assert rope.source.num_calls - before == expected
        assert f"with {expected} calls of the simulator" in flat(report)


@pytest.mark.medium
def test_names_of_parameters_are_given_once() -> None:
    named = rope_of(parameter_names=("slope", "size")).train(seed=0, **QUIET)
    held_out = stacked(named, candidates=[PRIOR, NPE]).report.held_out
    found = diagnose(named, observed(), num_simulations=100, num_folds=None, **QUIET)
    assert held_out.names == found.parameter_names == ("slope", "size")
    with pytest.raises(InvalidInputError, match="2 different names"):
        rope_of(parameter_names=("a", "a"))


def written(report: StackingReport, folder: Path, **options: Any) -> str:
    write_html(report, folder / "report.html", **options)
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.medium
def test_a_page_says_what_printing_says_and_needs_no_other_file(
    tmp_path: Path, rough_pictures: None
) -> None:
    torch.manual_seed(0)
    options: dict[str, Any] = {"num_simulations": 100, "num_folds": None, **QUIET}
    diagnosis = diagnose(trained(), observed(), seed=0, **options)
    unlike = TwoSampleTest(p_value=0.002)
    report, unknown = the_stack().report, torch.tensor([0])
    ranks = report.held_out.ranks.index_fill(1, unknown, torch.nan)
    held_out = replace(report.held_out, ranks=ranks, parameter_names=NAMES)
    report = replace(report, batch=unlike, held_out=held_out)
    x_names = ("a", "b", "<top>")
    source = written(report, tmp_path, diagnosis=diagnosis, x_names=x_names)
    assert source.startswith("<!DOCTYPE html>\n<html lang=")
    tags = re.findall(r"<(\w+)", source)
    for tag in ("table", "section", "p"):
        assert tags.count(tag) == source.count(f"</{tag}>") > 0
    # Pictures are part of the page, and nothing is loaded. Names are text.
    assert not {"script", "link", "iframe", "kg"} & {*tags}
    links = re.findall(r'(?:src|href)="data:image/png;base64,([^"]*)"', source)
    assert len(links) == 3
    for link in links:
        assert base64.b64decode(link, validate=True).startswith(b"\x89PNG")
    assert "http" not in re.sub(r"base64,[^\"]*", "", source)
    words = " ".join(html.unescape(re.sub(r"<[^>]*>", " ", source)).split())
    for text in (
        "<top>",
        "This need not hold for x_o",
        f"{NAMES[0]} was not measured",
        *(f"{gain:+.2f} nats a pair" for gain in report.gains.values()),
        *(f"{row['candidate']} " for row in report.as_rows()),
        *(f"{row['score_z']:.2f}" for row in report.as_rows()),
        *(finding.sentence.replace("`", "") for finding in diagnosis.findings),
        *(f"{what} {value}" for what, value in report.provenance.items()),
    ):
        assert text in words


def test_names_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    report = the_stack().report
    with pytest.raises(InvalidInputError, match="Expected `x_names`"):
        written(report, tmp_path, x_names=("a", "b"))
    assert not list(tmp_path.iterdir())

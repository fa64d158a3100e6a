"""The report of a stack as text, as a page and as a picture, against its numbers."""

import base64
import html
import math
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import scipy.stats
import torch
from torch.distributions import Cauchy, Independent, MultivariateNormal

from sbi_rope import diagnose, load, plots, stack
from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.metrics import Evaluation
from sbi_rope.metrics.statistics import Estimate, TwoSampleTest
from sbi_rope.npe.prior import PriorDistribution
from sbi_rope.report import write_html
from sbi_rope.saving import save
from sbi_rope.stacking import DiscrepancyCandidate, LearningCurve, StackingReport
from sbi_rope.utils.errors import InvalidInputError, RoPEWarning
from tests import problems
from tests.stacks import (
    BOX,
    DEFAULTS,
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
        families=("prior", "NPE", "discrepancy", "discrepancy"),
        weights=torch.tensor([0.1, 0.0, 0.3, 0.6] if weights is None else weights),
        log_scores=log_scores,
        comparable_scores=log_scores[:, 2],
        fold=torch.arange(n) % 3,
        held_out=Evaluation(**held_out | options),
    )


def flat(report: StackingReport) -> str:
    """The text of a report in one line."""
    return " ".join(str(report).split())


# Scores and weights -------------------------------------------------------------------


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


@pytest.mark.parametrize(
    ("low", "high", "words"),
    [
        (-0.3, -0.1, "Worse than the prior"),
        (-0.03, -0.01, "Slightly worse than the prior"),
        (0.01, 0.03, "Slightly better than the prior"),
        (-1, 1, "Not shown to differ from the prior"),
        (1e9, 2e9, "the prior cannot be compared"),
    ],
)
def test_a_comparison_says_no_more_than_its_interval(
    low: float, high: float, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    gain = {"prior": Estimate((low + high) / 2, low, high)}
    monkeypatch.setattr(StackingReport, "gains", gain)
    assert words in flat(made_up())


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


class Unstated(MultivariateNormal):
    """A prior that does not state its standard deviation."""

    stddev = property()


def test_the_unit_of_a_prior_is_estimated_from_draws_or_unknown() -> None:
    covariance = torch.diag(torch.tensor([4.0, 0.01]))
    heavy = Independent(Cauchy(torch.zeros(2), torch.ones(2)), 1)
    priors = MultivariateNormal, Unstated
    stated, estimated, unknown = (
        float(PriorDistribution(prior).log_units().sum())
        for prior in (*(one(torch.zeros(2), covariance) for one in priors), heavy)
    )
    assert math.isclose(stated, math.log(2.0) + math.log(0.1), abs_tol=1e-6)
    assert math.isclose(estimated, stated, abs_tol=0.05)
    assert math.isnan(unknown)


def test_weights_of_families_are_summed_and_explained() -> None:
    text = flat(made_up())
    assert "Weights: discrepancy 90% (2 candidates); prior 10%." in text
    assert "Mostly NPE of simulations that a linear model" in text
    advice = "Check that rows of theta and x belong together."
    assert advice not in text
    assert advice in flat(made_up(weights=[0.7, 0.1, 0.1, 0.1]))
    assert "No method has half" in flat(made_up(weights=[0.4, 0.4, 0.1, 0.1]))


# Calibration --------------------------------------------------------------------------


def test_estimates_and_ranks_are_those_of_hold_out_pairs() -> None:
    with quick(), patch("sbi_rope.stacking.scoring.NUM_SAMPLES", 400):
        report = stack(rope_of(), **DEFAULTS).report
    held_out, theta = report.held_out, rope_of().pairs.mean
    # Of pairs in another order the correlation is 0.24.
    above = torch.stack(
        [held_out.ranks.flatten(), (theta - held_out.estimates).flatten()]
    )
    assert float(above.double().corrcoef()[0, 1]) > 0.7
    assert f"ACAUC {held_out.acauc:+.3f}" in flat(report)


def test_the_text_says_what_to_do_about_over_confidence() -> None:
    narrow = (1 + torch.rand(400, 2).sqrt()) / 2
    assert "Collect more labels" in flat(made_up(n=400, ranks=narrow))
    assert "Collect more labels" not in flat(made_up(n=400))


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
    found = stacked(middle, candidates=[PRIOR, NPE, DISCREPANCY]).report
    text = flat(found)
    assert "labels are not distributed like the prior" in text
    assert "The stack expects the same of new observations" in text
    assert "default_candidates(rope, learn_prior=False)" in text
    kept = flat(stacked(middle, candidates=[PRIOR, NPE]).report)
    assert "Scores and coverage hold for parameters like these" in kept
    assert "learn_prior=False" not in kept
    assert "not distributed like the prior" not in flat(the_stack().report)


# Groups -------------------------------------------------------------------------------


@pytest.mark.medium
def test_every_model_of_the_discrepancy_knows_the_specimens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    theta, x = problem(16, seed=1)
    names = [f"specimen {k % 8}" for k in range(16)]
    rope = rope_of(problem(0, seed=1))
    rope.append_calibration(theta, x, theta_std=0.1, groups=names)
    seen: list[Any] = []
    fit = DiscrepancyModel.fit

    def spied(self: Any, *args: Any, **options: Any) -> Any:
        seen.append(options["groups"])
        return fit(self, *args, **options)

    monkeypatch.setattr(DiscrepancyModel, "fit", spied)
    with quick():
        data = data_of(rope)
        assert "16 calibration pairs in 8 groups" in str(data.discrepancy())
        assert len(seen) == x.shape[1]
        data.targets(torch.arange(16))
    rope.train(seed=0, show_progress_bars=False)
    assert len(seen) == x.shape[1] + 2
    assert all(groups.tolist() == [*range(8)] * 2 for groups in seen)


@pytest.mark.medium
def test_recordings_of_a_specimen_count_once_whatever_their_labels_are() -> None:
    theta, _ = problem(12, seed=1)
    repeats = torch.tensor([3] * 6 + [1] * 6)
    theta = theta.repeat_interleave(repeats, dim=0)
    names = [f"specimen {k}" for k in range(12) for _ in range(int(repeats[k]))]
    x = problems.simulate(theta) + 0.4

    def report(labels: torch.Tensor, **options: Any) -> StackingReport:
        rope = rope_of(problem(0, seed=1)).append_calibration(labels, x, **options)
        return stacked(rope, candidates=[PRIOR, NPE]).report

    # Equal exact labels are found without names.
    found, named = report(theta), report(theta, groups=names)
    assert torch.equal(found.log_scores, named.log_scores)
    assert found.held_out.lpp == named.held_out.lpp
    assert found.held_out.num_independent == pytest.approx(12)
    assert "24 hold-out calibration pairs in 12 groups" in flat(found)
    # Readings of the same specimen differ, and are still held out together.
    noisy = theta + 0.01 * torch.randn(theta.shape)
    apart, together = (
        report(noisy, theta_std=0.01, groups=groups) for groups in (None, names)
    )
    assert apart.held_out.num_independent == 24
    assert together.held_out.num_independent == pytest.approx(12)
    for specimen in range(12):
        rows = [row for row, name in enumerate(names) if name.endswith(f" {specimen}")]
        assert len(together.fold[rows].unique()) == 1


# Learning curves ----------------------------------------------------------------------


@pytest.mark.medium
def test_the_learning_curve_has_a_point_for_one_two_and_four_folds() -> None:
    candidates = [NPE, PRIOR, BOX]
    report, without = (
        stacked(
            rope_of(), candidates=candidates, num_folds=5, learning_curve=curve
        ).report
        for curve in (True, False)
    )
    curve = report.learning_curve
    assert curve is not None
    assert curve.num_pairs == (4, 8, 16)
    assert curve.scores[-1] == report.held_out.lpp
    assert len({score.mean for score in curve.scores}) == 3
    gain = curve.scores[1].mean - curve.scores[0].mean
    expected = f"Compared with training on 4 pairs: {gain:+.2f} nats with 8, "
    assert expected in flat(report)
    # The stack is the same without its learning curve.
    assert torch.equal(report.log_scores, without.log_scores)
    assert without.learning_curve is None


def curve_of(scores: dict[int, list[float]], **options: Any) -> LearningCurve:
    """A curve with a list of scores for each number of pairs."""
    evaluations = [
        made_up(n=len(column), log_prob=torch.tensor(column).double(), **options)
        for column in scores.values()
    ]
    return LearningCurve(
        num_pairs=tuple(scores), evaluations=tuple(one.held_out for one in evaluations)
    )


def test_the_gain_of_more_labels_is_extrapolated_from_the_curve() -> None:
    # The slopes b of 25 pairs, s(n) = 1 - b / n, and what their mean adds. A stack of
    # 25 pairs averages posteriors that were trained on 20, and one of 50 on 40.
    slopes = torch.linspace(1.0, 7.0, 25).double()
    scores = {n: (1 - slopes / n).tolist() for n in (5, 10, 20)}
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
    assert "5 more groups might add" in flat(
        replace(made_up(), learning_curve=of_people)
    )
    text = flat(replace(made_up(), learning_curve=curve))
    assert f"25 more labels might add {gain:.2f} nats a pair" in text
    assert math.isnan(curve_of({5: [0.4, 0.3]}).gain(10).mean)


# Pictures, provenance, names ----------------------------------------------------------


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
    before = rope.source.num_calls
    report = stacked(rope, candidates=[PRIOR, DISCREPANCY]).report
    # 300 from the prior and 5 at the parameters of each of 20 pairs.
    assert calls_of(report) == rope.source.num_calls - before == 400
    assert "with 400 calls of the simulator" in flat(report)
    # Those from the prior are kept for the next stack.
    assert calls_of(stacked(rope, candidates=[PRIOR, DISCREPANCY]).report) == 100
    theta = problems.box(2).sample((1000,))
    stored = rope_of(simulations=(theta, problems.simulate(theta)))
    assert calls_of(stacked(stored, candidates=[PRIOR, DISCREPANCY]).report) == 0


def calls_of(report: StackingReport) -> int:
    return int(report.provenance["simulator calls"])


def test_the_provenance_names_default_candidates_that_the_data_do_not_allow() -> None:
    made = stacked(rope_of(problem(8, seed=1))).report.provenance
    assert "regression; regression (embedding)" in made["left out"]
    # Candidates that a user has chosen leave nothing out.
    chosen = stacked(rope_of(), candidates=[PRIOR]).report.provenance
    assert chosen["left out"] == "none"
    assert chosen["seed"] == "0"


@pytest.mark.medium
def test_names_of_parameters_are_given_once(tmp_path: Path) -> None:
    named = rope_of(parameter_names=("slope", "size")).train(seed=0, **QUIET)
    posterior = stacked(named, candidates=[PRIOR, NPE])
    x = observed()
    for text in (written(posterior.report, tmp_path), str(posterior.report.held_out)):
        assert "theta_1" not in text
    save(posterior, tmp_path / "stack.pt")
    assert load(tmp_path / "stack.pt").report.held_out.names == ("slope", "size")
    found = diagnose(named, x, num_simulations=100, num_folds=None, **QUIET)
    assert found.parameter_names == ("slope", "size")
    with pytest.raises(InvalidInputError, match="2 different names"):
        rope_of(parameter_names=("a", "a"))


# The page -----------------------------------------------------------------------------


def written(report: StackingReport, folder: Path, **options: object) -> str:
    write_html(report, folder / "report.html", **options)  # type: ignore[arg-type]
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.mark.medium
def test_a_page_says_what_printing_says_and_needs_no_other_file(
    tmp_path: Path, rough_pictures: None
) -> None:
    torch.manual_seed(0)
    options: dict[str, Any] = {"num_simulations": 100, "num_folds": None, **QUIET}
    diagnosis = diagnose(trained(), observed(), seed=0, **options)
    unlike = TwoSampleTest(p_value=0.002)
    held_out = the_stack().report.held_out
    # The coverage of the first parameter depends on its estimate.
    ranks, n = held_out.ranks.clone(), len(held_out)
    order = held_out.estimates[:, 0].argsort()
    ranks[order, 0] = torch.linspace(0.99, 0.01, n).to(ranks)
    held_out = replace(held_out, ranks=ranks, parameter_names=NAMES)
    report = replace(the_stack().report, held_out=held_out, batch=unlike)
    source = written(
        report,
        tmp_path,
        diagnosis=diagnosis,
        x_names=("left", "right", "<top>"),
    )
    assert source.startswith("<!DOCTYPE html>\n<html lang=")
    tags = re.findall(r"<(\w+)", source)
    for tag in ("table", "section", "p"):
        assert tags.count(tag) == source.count(f"</{tag}>") > 0
    assert not {"script", "link", "iframe"} & {*tags}
    # Pictures are part of the page, and neither they nor the style load anything.
    links = re.findall(r'(?:src|href)="([^"]*)"', source)
    assert len(links) == 3
    for link in links:
        data = base64.b64decode(link.partition("base64,")[2], validate=True)
        assert data.startswith(b"\x89PNG")
        assert b"http" not in data
    assert "http" not in re.sub(r"base64,[^\"]*", "", source)
    # Names are text and no elements.
    assert "<kg>" not in source
    words = " ".join(html.unescape(re.sub(r"<[^>]*>", " ", source)).split())
    for name in ("left", "<top>"):
        assert name in words
    assert "This need not hold for x_o" in words
    assert f"The coverage of {NAMES[0]} depends on its estimate" in words
    for gain in report.gains.values():
        assert f"{gain:+.2f} nats a pair" in words
    for row in report.as_rows():
        assert f"{row['candidate']} " in words
        assert f"{row['score_z']:.2f}" in words
    for finding in diagnosis.findings:
        assert finding.sentence.replace("`", "") in words
    for what, value in report.provenance.items():
        assert f"{what} {value}" in words


def test_names_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    report = the_stack().report
    with pytest.raises(InvalidInputError, match="Expected `x_names`"):
        written(report, tmp_path, x_names=("a", "b"))
    assert not list(tmp_path.iterdir())

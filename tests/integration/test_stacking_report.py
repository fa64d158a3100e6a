"""The report of a stack, against the numbers that it is made of."""

import math
import warnings
from dataclasses import replace
from typing import Any

import pytest
import scipy.stats
import torch
from torch.distributions import Cauchy, Distribution, Independent, MultivariateNormal

from sbi_rope import plots
from sbi_rope._prior import PriorDistribution
from sbi_rope._statistics import TwoSampleTest
from sbi_rope.data import Counts
from sbi_rope.discrepancy import DiscrepancyModel
from sbi_rope.errors import InvalidInputError, RoPEWarning
from sbi_rope.metrics import LPPScore, acauc_of, coverage_by_estimate
from sbi_rope.stacking import (
    CrossValidation,
    Difference,
    DiscrepancyCandidate,
    LearningCurve,
    StackingReport,
)
from tests import problems
from tests.stacks import (
    BOX,
    NPE,
    PRIOR,
    data_of,
    observed,
    problem,
    quick,
    rope_of,
    stacked,
    the_stack,
)

# Batches and calibration sets are small here on purpose.
pytestmark = pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning")

DISCREPANCY = DiscrepancyCandidate(space="embedding")
NAMES = ("prior", "NPE", "discrepancy", "discrepancy (tuned)")


def made_up(
    *, n: int = 12, npe: float = -4.0, best: float = -1.0, leak: float = 0.2
) -> StackingReport:
    """A report of made-up numbers."""
    generator = torch.Generator().manual_seed(0)
    means = torch.tensor([-2.0, npe, best, best], dtype=torch.double)
    log_scores = means + 0.3 * torch.randn(n, 4, generator=generator).double()
    scores = CrossValidation(
        names=NAMES,
        families=("prior", "NPE", "discrepancy", "discrepancy"),
        log_scores=log_scores,
        fold=torch.arange(n) % 3,
        num_trained_on=2 * n // 3,
        stack_scores=log_scores[:, 2] + leak,
        levels=torch.rand(n, 2, generator=generator),
        estimates=torch.zeros(n, 2),
        ranks=torch.full((n, 2), torch.nan),
    )
    return StackingReport.of(scores)


def test_gains_are_mean_differences_of_comparable_scores() -> None:
    report = made_up(leak=0.2)
    scores = report.cross_validation
    # The prior has no mass outside itself, and is compared with what is deployed.
    of_stack = {"prior": scores.stack_scores, "NPE": scores.scores_of("stack")}
    for name, of_pairs in of_stack.items():
        gain = report.gains[name]
        difference = of_pairs - scores.scores_of(name)
        assert math.isclose(gain.mean, float(difference.mean()), rel_tol=1e-9)
        assert gain.low < gain.mean < gain.high
        assert f"{gain.mean:+.2f} nats a pair" in str(report)
    assert "better than the prior" in str(report)
    assert "  worse than the prior" in with_gain(report, low=-0.3, high=-0.1)
    assert "slightly worse than the prior" in with_gain(report, low=-0.03, high=-0.01)
    assert "slightly better than the prior" in with_gain(report, low=0.01, high=0.03)
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
    assert f"{mean:.2f} +- {error:.2f} with theta in its own units" in str(report)
    # Without the prior's standard deviations there is one unit only.
    assert "standard deviations of the prior" not in str(report)
    comparable = report.cross_validation.scores_of("stack")
    assert math.isclose(report.comparable_score[0], float(comparable.mean()))
    # The score that the differences start from is named beside it, with the reason.
    other = f"{report.comparable_score[0]:.2f} before correction for mass outside"
    assert other in str(report)
    assert "so that a difference from NPE starts from this number" in str(report)
    same = str(replace(report, comparable_score=report.score))
    assert "correction for mass outside the prior" not in same


def test_scores_are_stated_in_standard_deviations_of_the_prior_too() -> None:
    posterior = the_stack()
    report = posterior.report
    # The standard deviation of a uniform distribution on [-1, 1].
    unit = 2 * math.log(1 / 3**0.5)
    assert math.isclose(report.score_z[0], report.score[0] + unit, rel_tol=1e-6)
    assert math.isclose(report.score_z[1], report.score[1])
    stated = (
        f"{report.score_z[0]:.2f} +- {report.score_z[1]:.2f} with theta in standard"
    )
    assert stated in str(report)
    for row in report.as_rows():
        assert math.isclose(row["score_z"], row["score"] + unit, rel_tol=1e-6)
    # It is the score of the density of the standardised parameters.
    scores = LPPScore(log_probs=report.cross_validation.stack_scores)
    std = torch.full((2,), 1 / 3**0.5)
    assert math.isclose(report.score_z[0], scores.standardised(std).mean, rel_tol=1e-6)


class Unstated(MultivariateNormal):
    """A prior that does not state its standard deviation."""

    @property
    def stddev(self) -> torch.Tensor:
        raise NotImplementedError


def log_unit(prior: Distribution) -> float:
    return float(PriorDistribution(prior).log_units().sum())


def test_the_unit_of_a_prior_is_estimated_from_draws_or_unknown() -> None:
    covariance = torch.diag(torch.tensor([4.0, 0.01]))
    stated = log_unit(MultivariateNormal(torch.zeros(2), covariance))
    assert math.isclose(stated, math.log(2.0) + math.log(0.1), abs_tol=1e-6)
    state = torch.get_rng_state()
    estimated = log_unit(Unstated(torch.zeros(2), covariance))
    assert math.isclose(estimated, stated, abs_tol=0.05)
    assert torch.equal(torch.get_rng_state(), state)
    heavy = Independent(Cauchy(torch.zeros(2), torch.ones(2)), 1)
    assert math.isnan(log_unit(heavy))


def test_weights_of_families_are_summed_and_explained() -> None:
    report = made_up()
    weights = report.family_weights
    assert next(iter(weights)) == "discrepancy"
    assert set(weights) == {"prior", "NPE", "discrepancy"}
    found = report.cross_validation.weights.weights
    assert weights["discrepancy"] == pytest.approx(float(found[2:].sum()))
    assert math.isclose(sum(weights.values()), 1.0, rel_tol=1e-9)
    assert list(weights.values()) == sorted(weights.values(), reverse=True)
    assert "mostly discrepancy: NPE of simulations that a linear model" in str(report)
    assert f"discrepancy {weights['discrepancy']:.0%} (2 candidates)" in str(report)
    torn = replace(report, family_weights={"prior": 0.4, "NPE": 0.3, "RVNP": 0.3})
    assert "no method has half of the weight: prior 40%" in str(torn)


def test_the_text_says_whether_the_stack_is_over_or_under_confident() -> None:
    report = made_up(n=400)
    levels = report.levels
    for found, verdict in (
        (levels, "calibrated as far as these pairs can tell"),
        (levels.sqrt(), "over-confident on held-out pairs"),
        (levels.square(), "too wide on held-out pairs"),
    ):
        scores = replace(report.cross_validation, levels=found)
        text = str(StackingReport.of(scores))
        assert f"\n  {verdict}: ACAUC" in text
        assert (
            "(0 is calibrated, positive is over-confident, negative is too wide)"
            in text
        )
        assert ("More labels help most." in text) == (verdict[:4] == "over")


def test_parameters_that_are_not_calibrated_by_themselves_are_named() -> None:
    """One is over-confident and one too wide, so that their mean looks calibrated."""
    report = made_up(n=400)
    levels = report.levels
    opposite = torch.stack([levels[:, 0].sqrt(), levels[:, 1].square()], dim=1)
    scores = replace(report.cross_validation, levels=opposite)
    text = str(StackingReport.of(scores))
    average = "calibrated, on average over the parameters, as far as these pairs can"
    assert f"\n  {average} tell: ACAUC" in text
    assert "theta_1 by itself is over-confident: ACAUC +0.1" in text
    assert "theta_2 by itself is too wide: ACAUC -0.1" in text
    assert "97.5 % interval" in text
    named = StackingReport.of(scores, parameter_names=("slope", "size"))
    assert "slope by itself is over-confident: ACAUC +0.1" in str(named)
    assert "by itself" not in str(report)
    # The verdict on a single parameter is that on the stack.
    single = replace(report.cross_validation, levels=levels[:, :1].sqrt())
    assert "by itself" not in str(StackingReport.of(single))


@pytest.mark.medium
@pytest.mark.parametrize("groups", [False, True])
def test_a_parameter_whose_coverage_depends_on_its_estimate_is_named(
    groups: bool,
) -> None:
    """The second has intervals that are too narrow where its estimate is large."""
    report, n = made_up(n=100), 100
    assert "the estimate" not in str(report)  # where ranks are not known
    generator = torch.Generator().manual_seed(4)
    ranks = torch.rand(n, 2, generator=generator, dtype=torch.double)
    estimates = torch.randn(n, 2, generator=generator, dtype=torch.double)
    scores = replace(report.cross_validation, ranks=ranks, estimates=estimates)
    if groups:  # every two pairs are of one specimen
        halves = torch.full((n,), 0.5)
        scores = replace(scores, counts=Counts(halves, torch.arange(n) // 2))
    sentence = "no sign that coverage depends on the estimate (smallest p-value of 2:"
    assert sentence in str(StackingReport.of(scores))
    if groups:  # a pair and its twin are no more evidence than one of them
        alone = coverage_by_estimate(ranks[::2], estimates[::2])
        rows = torch.arange(n) // 2 * 2
        twins = replace(scores, ranks=ranks[rows], estimates=estimates[rows])
        of_twins = StackingReport.of(twins).by_estimate
        assert of_twins is not None
        assert of_twins.p_values == alone.p_values
    high = estimates[:, 1] > estimates[:, 1].median()
    off = ranks.clone()
    off[high, 1] = ranks[high, 1].round() * 0.98 + 0.01
    scores = replace(scores, ranks=off)
    found = StackingReport.of(scores, parameter_names=("slope", "size"))
    assert found.by_estimate.depends == (False, True)
    low, middle, high_share = found.by_estimate.shares[1].tolist()
    assert high_share == 0.0
    text = " ".join(str(found).split())
    p_value = f"(p = {found.by_estimate.p_values[1]:.1g})"
    assert (
        f"the coverage of size depends on its estimate {p_value}: for the lowest"
        in text
    )
    assert f"hold {low:.0%}, {middle:.0%} and 0% of the parameters, and " in text
    assert "label more observations there" in text
    assert "the coverage of slope" not in text


def test_estimates_and_ranks_are_those_of_held_out_pairs() -> None:
    scores = the_stack().report.cross_validation
    assert scores.ranks is not None
    assert scores.estimates is not None
    # The levels come from all 40 draws, and the ranks from half of them. They differ by
    # 0.10 on average, with a standard error of 0.013, and unrelated ones by a third.
    assert float((2 * scores.ranks - 1).abs().sub(scores.levels).abs().mean()) < 0.15
    theta = rope_of().calibration[0]
    is_above = scores.ranks > 0.5
    agrees = is_above == (theta > scores.estimates)
    assert float(agrees.double().mean()) > 0.8


def test_the_text_names_what_calibration_assumes_about_a_batch() -> None:
    report = made_up()
    assert "holds for observations like those of the pairs" in str(report)
    tests = "`diagnose(rope, x_o)` tests whether a batch is like them\n"
    assert tests in f"{report}\n"
    like, unlike = (
        str(replace(report, batch=TwoSampleTest(p_value=p, spread=0.4)))
        for p in (0.32, 0.002)
    )
    assert "no sign of a difference (p = 0.32)" in like
    assert "this need NOT hold for the batch" in unlike
    assert "look at `diagnose(rope, x_o)`" in unlike


@pytest.mark.medium
def test_a_batch_unlike_the_pairs_gives_a_warning() -> None:
    options = {"candidates": [NPE, PRIOR]}
    corner = observed() + 1.0
    with pytest.warns(RoPEWarning, match="differs from the observations of the cal"):
        report = stacked(rope_of(), corner, **options).report
    assert report.batch is not None
    assert report.batch.is_different
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message="`x_o` differs")
        like = stacked(rope_of(), observed(), **options).report
    assert like.batch is not None
    assert not like.batch.is_different
    assert the_stack().report.batch is None


def test_a_stack_with_a_discrepancy_says_what_the_pairs_say_about_each_entry() -> None:
    found = the_stack().report.discrepancy
    assert found is not None
    assert {summary.name for summary in found.summaries} == {"x[0]", "x[1]", "x[2]"}
    assert found.num_pairs == 20
    # Real observations are 0.4 higher.
    assert all(0.2 < summary.shift.median < 0.6 for summary in found.summaries)
    without = stacked(rope_of(), candidates=[PRIOR, BOX]).report
    assert without.discrepancy is None


def test_a_report_names_pairs_whose_parameters_do_not_follow_the_prior() -> None:
    theta = problem(20, seed=1)[0]
    middle = rope_of((0.2 * theta, problems.simulate(0.2 * theta) + 0.4))
    candidates = [PRIOR, NPE, DISCREPANCY]
    found = stacked(middle, candidates=candidates).report
    assert found.probability_of_prior is not None
    assert found.probability_of_prior < 1e-3
    text = " ".join(str(found).split())
    assert "pairs are not distributed like the prior (probability that" in text
    assert "The stack expects the same of new observations" in text
    assert "default_candidates(rope, learn_prior=False)" in text
    # What keeping it would score: the better of the prior and NPE.
    scores = found.cross_validation
    best = max(float(scores.scores_of(name).mean()) for name in ("prior", "NPE"))
    assert found.score_of_prior_kept == pytest.approx(best)
    assert f"The best candidate that keeps the prior scores {best:.2f} here" in text
    # These pairs follow the prior.
    usual = the_stack().report
    assert usual.probability_of_prior is not None
    assert usual.probability_of_prior > 0.5
    assert "not distributed like the prior" not in str(usual)


@pytest.mark.medium
def test_a_stack_that_keeps_the_prior_says_what_holds_for_the_pairs_only() -> None:
    theta = 0.2 * problem(20, seed=1)[0]
    middle = rope_of((theta, problems.simulate(theta) + 0.4))
    kept = stacked(middle, candidates=[PRIOR, NPE]).report
    assert not kept.learns_prior
    assert "not distributed like the prior" in str(kept)
    assert "The stack keeps the prior." in str(kept)
    assert "learn_prior=False" not in str(kept)
    # A user's candidate that is trained on the pairs does not keep it.
    mixed = stacked(middle, candidates=[PRIOR, NPE, BOX]).report
    assert mixed.learns_prior
    assert "The stack expects the same of new observations" in str(mixed)


def test_a_report_knows_how_it_was_made() -> None:
    made = the_stack().report.provenance
    assert made["seed"] == "0"
    assert f"torch {torch.__version__}" in made["versions"]
    assert "UTC" in made["finished"]
    assert made["longest"].count(" s") == 3
    # Candidates that a user has chosen leave nothing out.
    chosen = stacked(rope_of(), candidates=[PRIOR]).report
    assert "left out" not in chosen.provenance


def test_a_report_says_which_default_candidates_the_data_do_not_allow() -> None:
    rope = rope_of(problem(8, seed=1))
    text = " ".join(str(stacked(rope).report).split())
    assert (
        "regression (needs 10 exact labels of continuous parameters, x without NaN)"
        in text
    )
    assert "fine-tuned NPE, rehearsed (needs 100 pairs, long x)" in text


def test_calibration_is_that_of_held_out_pairs() -> None:
    report = the_stack().report
    levels = report.cross_validation.levels
    assert torch.equal(levels, report.levels)
    assert report.coverage.num_observations == 20
    assert f"ACAUC {acauc_of(levels).value:+.3f}" in str(report)
    inside = (levels <= 0.9).double().mean()
    assert f"90% intervals hold {inside:.0%} of the parameters" in str(report)


def test_rows_are_sorted() -> None:
    report = the_stack().report
    rows = report.as_rows()
    scores = [row["score"] for row in rows]
    assert scores == sorted(scores, reverse=True)
    assert {row["candidate"] for row in rows} == {*report.cross_validation.names}


def test_recordings_with_the_same_parameters_count_once() -> None:
    theta, _ = problem(12, seed=1)
    theta = theta.repeat_interleave(torch.tensor([3] * 6 + [1] * 6), dim=0)
    pairs = theta, problems.simulate(theta) + 0.4
    report = stacked(rope_of(pairs), candidates=[PRIOR, NPE]).report
    scores = report.cross_validation
    assert scores.effective_number == pytest.approx(12)
    assert scores.counts is not None
    means, _ = scores.counts.of_groups(scores.stack_scores)
    assert len(means) == 12
    assert report.score == pytest.approx(
        (float(means.mean()), float(means.std()) / 12**0.5)
    )
    assert "24 held-out calibration pairs in 12 groups, each" in str(report)


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
        assert "the 16 pairs count as " in str(data.discrepancy())
        assert len(seen) == x.shape[1]
        data.targets(torch.arange(16))
    rope.train(seed=0, show_progress_bars=False)
    assert len(seen) == x.shape[1] + 2
    assert all(groups.tolist() == [*range(8)] * 2 for groups in seen)


@pytest.mark.medium
def test_recordings_of_a_named_specimen_count_once_whatever_their_labels_are() -> None:
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
    assert torch.equal(
        found.cross_validation.log_scores, named.cross_validation.log_scores
    )
    assert found.score == named.score
    # Readings of the same specimen differ, and are still held out together.
    noisy = theta + 0.01 * torch.randn(theta.shape)
    apart, together = (
        report(noisy, theta_std=0.01, groups=groups) for groups in (None, names)
    )
    assert apart.cross_validation.effective_number == 24
    assert together.cross_validation.effective_number == pytest.approx(12)
    data = data_of(rope_of((noisy, x), groups=names))
    assert "24 calibration pairs in 12 groups" in str(data.discrepancy())
    assert "24 calibration pairs in 12 groups, not trained" in repr(data.rope)
    folds = together.cross_validation.fold
    for specimen in range(12):
        rows = [row for row, name in enumerate(names) if name.endswith(f" {specimen}")]
        assert len(folds[rows].unique()) == 1


@pytest.mark.medium
def test_the_learning_curve_has_a_point_for_one_two_and_four_folds() -> None:
    candidates = [NPE, PRIOR, BOX]
    report, without = (
        stacked(
            rope_of(),
            candidates=candidates,
            num_folds=5,
            learning_curve=curve,
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
    assert f"in its own units: 4 pairs: {curve.scores[0]:.2f}, 8 " in str(report)


def curve_of(num_pairs: tuple[int, ...], *scores: list[float]) -> LearningCurve:
    """A curve with a column of scores for each number of pairs."""
    return LearningCurve(
        num_pairs=num_pairs, pair_scores=torch.tensor(scores, dtype=torch.double)
    )


def test_the_gain_of_more_labels_is_extrapolated_from_the_curve() -> None:
    # The slopes b of 25 pairs, s(n) = 1 - b / n, and what their mean adds. A stack of
    # 25 pairs averages posteriors that were trained on 20, and one of 50 on 40.
    slopes = torch.linspace(1.0, 7.0, 25).double()
    curve = curve_of((5, 10, 20), *((1 - slopes / n).tolist() for n in (5, 10, 20)))
    gain = curve.gain(25)
    interval = scipy.stats.t.interval(
        0.95, df=24, loc=4, scale=scipy.stats.sem(slopes.numpy())
    )
    for found, expected in zip(
        (gain.mean, gain.low, gain.high), (4, *interval), strict=True
    ):
        assert math.isclose(found, expected * (1 / 20 - 1 / 40))
    assert curve.gain(5).mean == pytest.approx(4 * (1 / 20 - 1 / 24))
    weights = torch.zeros(25)
    weights[:2] = 1.0
    weighted = replace(curve, counts=Counts(weights))
    assert weighted.gain(25).mean == pytest.approx(1.125 / 40)
    # Recordings of 5 people: labels are those of people.
    people = Counts(torch.full((25,), 0.2), torch.arange(25) // 5)
    of_people = replace(curve, counts=people)
    assert of_people.gain(5).mean == pytest.approx(gain.mean)
    assert "5 more groups of 5 pairs might add" in str(
        replace(made_up(), learning_curve=of_people)
    )
    with pytest.raises(InvalidInputError, match="`num_more`"):
        curve.gain(0)
    assert f"25 more labels might add {gain.mean:.2f} nats a pair" in str(
        replace(made_up(), learning_curve=curve)
    )
    single = curve_of((5,), [0.4, 0.3])
    assert math.isnan(single.gain(10).mean)
    assert "nan" not in str(replace(made_up(), learning_curve=single))


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
    before = rope.num_simulator_calls
    report = stacked(rope, candidates=[PRIOR, DISCREPANCY]).report
    # 300 from the prior and 5 at the parameters of each of 20 pairs.
    assert calls_of(report) == rope.num_simulator_calls - before == 400
    assert "with 400 calls of the simulator" in str(report)
    # Those from the prior are kept for the next stack.
    assert calls_of(stacked(rope, candidates=[PRIOR, DISCREPANCY]).report) == 100
    theta = problems.box(2).sample((1000,))
    stored = rope_of(simulations=(theta, problems.simulate(theta)))
    assert calls_of(stacked(stored, candidates=[PRIOR, DISCREPANCY]).report) == 0
    # These candidates need no simulations.
    assert calls_of(stacked(rope_of(), candidates=[PRIOR, NPE]).report) == 0


def calls_of(report: StackingReport) -> int:
    return int(report.provenance["simulator calls"])

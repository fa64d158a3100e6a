"""The report of a stack as an HTML page: whole, valid, alone, and about its numbers."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from sbi_rope import diagnose, load
from sbi_rope._statistics import TwoSampleTest
from sbi_rope.diagnosis import Diagnosis, Finding
from sbi_rope.diagnosis.report import UNLIKE_PAIRS
from sbi_rope.errors import InvalidInputError
from sbi_rope.reports.page import number, percent
from sbi_rope.stacking import LearningCurve, StackingReport
from tests.stacks import (
    NPE,
    PRIOR,
    QUIET,
    observed,
    rope_of,
    stacked,
    the_stack,
    trained,
)

pytest.importorskip("matplotlib")
# Batches and calibration sets are small here on purpose.
pytestmark = [
    pytest.mark.filterwarnings("ignore::sbi_rope.errors.RoPEWarning"),
    # The page that most tests share is made before, with pictures as users see them.
    pytest.mark.usefixtures("rough_pictures"),
]

NAMES = ("mass <kg> & more", 'the "length"')
# Elements without an end.
VOID = {"meta", "img", "br"}


class Page(HTMLParser):
    """Reads a page, and fails where an element is not closed as it was opened."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [v or "" for name, v in attrs if name in ("src", "href")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self) -> str:
        return re.sub(r"\s+", " ", " ".join(self.words))


def written(report: StackingReport, folder: Path, **options: object) -> str:
    report.to_html(folder / "report.html", **options)  # type: ignore[arg-type]
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def diagnosis() -> Diagnosis:
    torch.manual_seed(0)
    return diagnose(
        trained(), observed(), num_simulations=100, num_folds=None, seed=0, **QUIET
    )


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory, diagnosis: Diagnosis) -> str:
    """A page with everything that a page can hold."""
    curve = LearningCurve(
        num_pairs=(4, 8), pair_scores=torch.tensor([[0.2, 0.4], [0.3, 0.5]])
    )
    report = replace(
        the_stack().report,
        learning_curve=curve,
        batch=TwoSampleTest(p_value=0.002, spread=0.3),
    )
    return written(
        report,
        tmp_path_factory.mktemp("page"),
        diagnosis=diagnosis,
        parameter_names=NAMES,
        x_names=("left", "right", "<top>"),
    )


@pytest.mark.medium
def test_names_of_parameters_are_given_once(tmp_path: Path) -> None:
    named = rope_of(parameter_names=("slope", "size")).train(seed=0, **QUIET)
    posterior = stacked(named, candidates=[PRIOR, NPE])
    report, x = posterior.report, observed()
    for page in (
        written(report, tmp_path),
        str(posterior.credible_intervals(0.9, x[0])),
    ):
        assert "slope" in page
        assert "theta_1" not in page
    posterior.save(tmp_path / "stack.pt")
    loaded = load(tmp_path / "stack.pt")
    for one in (loaded, named.build_posterior(x, num_simulations=100, seed=0)[0]):
        rows = one.credible_intervals_batched(0.9, x[:1], num_samples=20).as_rows()
        assert [row["parameter"] for row in rows] == ["slope", "size"]
    found = diagnose(named, x, num_simulations=100, num_folds=None, **QUIET)
    assert found.parameter_names == ("slope", "size")
    # What is passed comes before what is known, and is not called another name.
    text = Page(written(report, tmp_path, diagnosis=found)).text
    assert "In this section" not in text
    assert (
        "Slope" in Page(written(report, tmp_path, parameter_names=["Slope", "s"])).text
    )
    for names in (("slope",), ("a", "a"), ("a", "b", "c")):
        with pytest.raises(InvalidInputError, match="2 different names"):
            rope_of(parameter_names=names)


@pytest.mark.medium
def test_the_page_is_valid_and_needs_nothing_else(source: str) -> None:
    page = Page(source)
    assert source.startswith("<!DOCTYPE html>\n<html lang=")
    assert {"title", "style", "table", "section", "img"} <= set(page.tags)
    assert not {"script", "link", "iframe"} & set(page.tags)
    # Pictures are part of the page, and neither they nor the style load anything.
    assert page.links
    assert all(link.startswith("data:image/png;base64,") for link in page.links)
    for link in page.links:
        data = base64.b64decode(link.partition(",")[2], validate=True)
        assert data.startswith(b"\x89PNG")
        assert b"http" not in data
    assert "http" not in re.sub(r"base64,[^\"]*", "", source)
    assert "url(" not in source
    assert "@import" not in source


@pytest.mark.medium
def test_names_are_text_and_not_elements(source: str) -> None:
    assert "<kg>" not in source
    assert "<top>" not in source
    text = Page(source).text
    for name in (*NAMES, "left", "<top>"):
        assert name in text


def test_the_page_holds_the_numbers_of_the_report(source: str) -> None:
    report, text = the_stack().report, Page(source).text
    for name in ("prior", "NPE"):
        gain = report.gains[name]
        assert f"{number(gain.mean, sign=True)} nats a measurement" in text
        assert (
            f"{number(gain.low, sign=True)} to {number(gain.high, sign=True)}" in text
        )
    for row in report.as_rows():
        assert row["candidate"] in text
        assert number(row["score"]) in text
        assert number(row["score_z"]) in text
    low, high = (number(end, sign=True, digits=3) for end in report.acauc.interval)
    assert f"{low} to {high}" in text
    families = report.cross_validation.families
    for name, weight in report.family_weights.items():
        row = f"{name} {families.count(name)} {percent(weight)}"
        assert row in text.replace("\N{NO-BREAK SPACE}", " ")
    discrepancy = report.discrepancy
    assert discrepancy is not None
    for summary in discrepancy.summaries:
        assert str(summary.gain) in text
        assert str(summary.shift) in text


def test_the_page_says_what_a_diagnosis_found(
    source: str, diagnosis: Diagnosis
) -> None:
    text = Page(source).text
    assert "Diagnosis of the batch" in text
    for finding in diagnosis.findings:
        assert finding.sentence.replace(" %", "\N{NO-BREAK SPACE}%") in text
    assert text.count("Alarming: ") == len(diagnosis.alarming)
    assert diagnosis.verdict in text
    # Its sentences have names of their own, which the page explains.
    assert f"In this section theta_1 is {NAMES[0]}, theta_2 is {NAMES[1]}." in text


def test_the_verdict_names_a_batch_that_differs_from_the_pairs(source: str) -> None:
    assert "differs from them (p = 0.002), so that it need not hold there" in source


@pytest.mark.medium
def test_the_verdict_holds_the_comparison_of_a_diagnosis(
    tmp_path: Path, diagnosis: Diagnosis
) -> None:
    def verdict(findings: tuple[Finding, ...]) -> str:
        found = replace(diagnosis, findings=findings)
        return Page(written(the_stack().report, tmp_path, diagnosis=found)).text

    others = tuple(f for f in diagnosis.findings if f.name != UNLIKE_PAIRS)
    unlike = replace(diagnosis[UNLIKE_PAIRS], alarming=True, value=0.003)
    text = verdict((*others, unlike))
    assert "The batch of the diagnosis differs from them (p = 0.003)" in text
    text = verdict((*others, replace(unlike, alarming=False, value=0.4)))
    assert "The batch of the diagnosis shows no sign of a difference (p = 0.40)" in text
    text = verdict((*others, replace(unlike, alarming=False, value=None)))
    assert "Whether the batch of the diagnosis is like them was not tested" in text
    assert "This report does not compare" not in text


@pytest.mark.medium
def test_rows_are_to_be_checked_if_the_stack_is_mostly_the_prior(
    tmp_path: Path,
) -> None:
    report = the_stack().report
    for weights in ({"NPE": 0.9, "prior": 0.1}, {"prior": 0.9, "NPE": 0.1}):
        shown = replace(report, family_weights=weights)
        text = Page(written(shown, tmp_path)).text
        expected = weights["prior"] == 0.9
        assert ("pairs belong together, row by row." in text) == expected
        assert ("pairs belong together, row by row" in str(shown)) == expected


@pytest.mark.medium
def test_the_page_shows_where_coverage_depends_on_the_estimate(tmp_path: Path) -> None:
    report = the_stack().report
    page = Page(written(report, tmp_path)).text
    assert "There is no sign of it here." in page
    assert "depends on its estimate" not in page
    scores = report.cross_validation
    assert scores.ranks is not None
    ranks, n = scores.ranks.clone(), len(scores)
    order = scores.estimates[:, 0].argsort()  # type: ignore[index]
    ranks[order, 0] = torch.linspace(0.99, 0.01, n).to(ranks)
    shuffled = torch.randperm(n, generator=torch.Generator().manual_seed(0))
    ranks[:, 1] = torch.linspace(0, 1, n).to(ranks)[shuffled]
    off = StackingReport.of(replace(scores, ranks=ranks))
    page = Page(written(off, tmp_path, parameter_names=NAMES)).text
    assert f"The coverage of {NAMES[0]} depends on its estimate (p = 0.001)" in page
    assert f"The coverage of {NAMES[1]} depends" not in page
    assert "Here it depends on the estimate." in page
    assert off.by_estimate is not None
    shares = (percent(share) for share in off.by_estimate.shares[0].tolist())
    assert " ".join([NAMES[0], *shares, number(0.000999, digits=3)]) in page


def test_the_page_says_how_the_stack_was_made(source: str) -> None:
    report, text = the_stack().report, Page(source).text
    for what, value in report.provenance.items():
        assert f"{what} {value}" in text


@pytest.mark.medium
def test_an_own_report_is_replaced_and_nothing_else(tmp_path: Path) -> None:
    report = the_stack().report
    first = written(report, tmp_path)
    assert written(report, tmp_path, parameter_names=("a", "b")) != first
    other = tmp_path / "thesis.html"
    other.write_text("<html>years of work</html>")
    for path in (other, tmp_path):
        with pytest.raises(InvalidInputError, match="an earlier report"):
            report.to_html(path)
    assert other.read_text() == "<html>years of work</html>"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["report.html", "thesis.html"]


def test_names_and_a_diagnosis_that_do_not_fit_are_refused(
    tmp_path: Path, diagnosis: Diagnosis
) -> None:
    report, path = the_stack().report, tmp_path / "report.html"
    with pytest.raises(InvalidInputError, match="`parameter_names` to be 2"):
        report.to_html(path, parameter_names=("a",))
    with pytest.raises(InvalidInputError, match="Expected `x_names`"):
        report.to_html(path, x_names=("a", "b"))
    with pytest.raises(InvalidInputError, match="Expected no `x_names`"):
        replace(report, discrepancy=None).to_html(path, x_names=("a", "b", "c"))
    with pytest.raises(InvalidInputError, match="`diagnosis` to be a Diagnosis"):
        report.to_html(path, diagnosis=SimpleNamespace())
    three = replace(diagnosis, parameter_names=("a", "b", "c"))
    for names in (None, NAMES):
        with pytest.raises(InvalidInputError, match="a batch with 2 parameters"):
            report.to_html(path, diagnosis=three, parameter_names=names)
    assert not path.exists()

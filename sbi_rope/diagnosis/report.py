"""A diagnosis: its findings in words and numbers, and the arrays behind them."""

import textwrap
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from torch import Tensor

from sbi_rope.discrepancy.parameters import is_improbable
from sbi_rope.stacking import StackingReport

__all__ = [
    "IN_BRIEF",
    "OF_OTHERS",
    "UNLIKE_PAIRS",
    "Diagnosis",
    "Finding",
    "read_for",
    "whom_it_concerns",
    "why_expected",
]

Concerned = Literal["NPE", "RoPE", "stack and RoPE"]

UNLIKE_PAIRS = "batch unlike the calibration pairs"
# Whom an alarm concerns, in words. Those that concern most come last.
IN_WORDS: dict[Concerned, str] = {
    "NPE": "NPE as it was trained, before any repair",
    "RoPE": "the posterior of RoPE, and not about that of `stack`, which has no "
    "couplings",
    "stack and RoPE": "the posterior of `stack` and that of RoPE",
}
IN_BRIEF: dict[Concerned, str] = {
    "NPE": "NPE",
    "RoPE": "RoPE",
    "stack and RoPE": "RoPE and any stack",
}
# The heading of findings that do not concern the posterior in use.
OF_OTHERS = "about RoPE, and not about this stack, which has no couplings"
HOW_TO_COUNT = (
    "`diagnose(rope, x_o, posterior=posterior)` counts only the alarms that concern "
    "the posterior that you use."
)


@dataclass(frozen=True, kw_only=True)
class Finding:
    """The result of one test: a number, its threshold and what it means.

    Attributes:
        name: The name of the test.
        value: The number.
        threshold: The threshold beyond which the number is alarming.
        alarming: Whether the number is beyond the threshold.
        sentence: The finding in plain words.
        reason: On which side of the threshold the number is alarming, and why.
        concerns: Whose posterior an alarm is about: "NPE" as it was, that of "RoPE"
            only, or those of "stack and RoPE".
        is_p_value: Whether the number is a p-value.
        is_expected: Whether the number is alarming, but no reason to distrust the
            posterior: NPE is expected to be wrong where the simulator is, and a batch
            is expected to differ from the prior as the pairs do, if a stack has learned
            this from them.
    """

    name: str
    value: float
    threshold: float
    alarming: bool
    sentence: str
    reason: str
    concerns: Concerned
    is_p_value: bool = False
    is_expected: bool = False

    @property
    def number(self) -> str:
        """The number and its threshold as they are printed."""
        value = f"{self.value:.3g}"
        return f"{'p = ' * self.is_p_value}{value} (threshold {self.threshold:.3g})"

    def __str__(self) -> str:
        mark = "!" if self.alarming and not self.is_expected else "-"
        text = f"{self.sentence} {whom_it_concerns(self)} {self.reason}"
        return f"{mark} {self.name}: {self.number}\n{_indented(text)}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Diagnosis:
    r"""Findings about a batch of real observations, and the arrays behind them.

    All tensors are float64 on the CPU unless said otherwise. Print it: alarms come
    first and in full, and the other findings have a line each. Those that do not
    concern the posterior in use come last, if one was given.

    Attributes:
        findings: The results of all tests.
        notes: Which tests were left out, and what else there is to know.
        flags: Indices of the observations that no simulation matches, int64.
        effective_sample_size: Of each observation's row of the coupling, ``(n_o,)``.
        distance: Distance from :math:`g(x_o)` to the nearest simulation, ``(n_o,)``, in
            units of the median distance from a simulation to its nearest neighbour.
        theta: The parameters of the simulations, ``(n_s, d)``.
        implied: Weights of ``theta`` that estimate the distribution of the parameters
            of the batch, ``(n_s,)``. They sum to one.
        unshifted: The same weights for a batch that follows the prior. They are blurred
            as ``implied`` is.
        residuals: :math:`g(x) - E[h(S(\theta))]` of each calibration pair, with a g
            trained on other pairs, ``(n_c, l)``; None if they were left out.
        parameter_names: One name for each parameter.
        prior: Draws of the prior, ``(n, d)``, for pictures.
        like_pairs: The names of parameters of which NPE's estimates show no sign that
            the batch differs from the calibration pairs.
        used: The kind of the posterior in use, if one was given. RoPE's couplings and
            embedding net have no part in a stack.
    """

    findings: tuple[Finding, ...]
    notes: tuple[str, ...]
    flags: Tensor
    effective_sample_size: Tensor = field(repr=False)
    distance: Tensor = field(repr=False)
    theta: Tensor = field(repr=False)
    implied: Tensor = field(repr=False)
    unshifted: Tensor = field(repr=False)
    residuals: Tensor | None = field(repr=False)
    parameter_names: tuple[str, ...]
    prior: Tensor = field(repr=False)
    like_pairs: tuple[str, ...] = ()
    used: Literal["stack", "posterior"] | None = None

    @property
    def alarming(self) -> tuple[Finding, ...]:
        """All findings beyond their thresholds, also those that are expected."""
        return tuple(finding for finding in self.findings if finding.alarming)

    @property
    def unexpected(self) -> tuple[Finding, ...]:
        """The alarming findings that nobody expected, and that call for action.

        Those about all posteriors come first, and those about NPE alone last. Those
        that do not concern the posterior in use are left out, if one was given.
        """
        order = list(reversed(IN_WORDS))
        unexpected = [one for one in self._own if one.alarming and not one.is_expected]
        return tuple(sorted(unexpected, key=lambda one: order.index(one.concerns)))

    @property
    def expected(self) -> tuple[Finding, ...]:
        """The alarming findings that are expected, see ``Finding.is_expected``."""
        return tuple(one for one in self._own if one.alarming and one.is_expected)

    @property
    def quiet(self) -> tuple[Finding, ...]:
        """The findings that are not alarming, without those about other posteriors."""
        return tuple(one for one in self._own if not one.alarming)

    @property
    def others(self) -> tuple[Finding, ...]:
        """The findings that do not concern the posterior in use, if one was given."""
        return tuple(one for one in self.findings if not self._concerns(one))

    @property
    def _own(self) -> tuple[Finding, ...]:
        return tuple(one for one in self.findings if self._concerns(one))

    def _concerns(self, finding: Finding) -> bool:
        return self.used != "stack" or finding.concerns != "RoPE"

    @property
    def verdict(self) -> str:
        """How many findings are alarming, in a sentence."""
        count = len(self.unexpected)
        whose = f" that concern this {self.used}" if self.used else ""
        verdict = (
            f"{count or 'none'} of {len(self._own)} findings{whose} "
            f"{'is' if count < 2 else 'are'} alarming."
        )
        for why, found in _by_reason(self.expected).items():
            number = f"{len(found)}{' others' * bool(count)} are"
            if len(found) == 1:
                number = f"{'Another' if count else 'One'} is"
            verdict += f" {number} as expected {why}."
        return verdict

    def __contains__(self, name: str) -> bool:
        """Tell whether there is a finding of a name."""
        return any(finding.name == name for finding in self.findings)

    def __getitem__(self, name: str) -> Finding:
        """Return the finding of a name."""
        return {finding.name: finding for finding in self.findings}[name]

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each finding, ready for a dataframe."""
        return [asdict(finding) for finding in self.findings]

    def __str__(self) -> str:
        count = len(self.distance)
        lines = [
            _indented(
                f"Diagnosis of {count} observation{'s' * (count > 1)} against "
                f"{len(self.theta)} simulations: {self.verdict}{self._like_pairs}",
                first="",
            ),
            *map(str, self.unexpected),
        ]
        for why, found in _by_reason(self.expected).items():
            lines.append(_indented(f"as expected {why}:", first=""))
            for one in found:
                lines += [f"  {one.name}: {one.number}", _indented(one.sentence)]
        lines += self._without_alarm()
        if self.others:
            lines.append(f"{OF_OTHERS}:")
        lines += [
            f"  {one.name}: {one.number}{', alarming' * one.alarming}"
            for one in self.others
        ]
        notes = list(self.notes)
        if self.used is None and self.unexpected:
            notes.append(HOW_TO_COUNT)
        lines += [_indented(note, first="* ") for note in notes]
        return "\n".join(lines)

    def _without_alarm(self) -> list[str]:
        """Return a line for each quiet finding; of one posterior, not whose it is."""
        if not self.quiet:
            return []
        lines = [f"  {one.name}: {one.number}" for one in self.quiet]
        if self.used is not None:
            return ["no alarm:", *lines]
        whose = [f" [{IN_BRIEF[one.concerns]}]" for one in self.quiet]
        return [
            "no alarm (an alarm would be about the posteriors in brackets):",
            *(line + text for line, text in zip(lines, whose, strict=True)),
        ]

    @property
    def _like_pairs(self) -> str:
        """Say in a sentence what decides whether what was found on pairs holds here."""
        if UNLIKE_PAIRS not in self or self[UNLIKE_PAIRS].alarming:
            return ""
        value = f"p = {self[UNLIKE_PAIRS].value:.3g}"
        return f" No sign that the batch is unlike the calibration pairs ({value})."


def read_for(diagnosis: Diagnosis, report: StackingReport | None) -> Diagnosis:
    """Return a diagnosis as it is to be read by somebody who uses a posterior.

    What the parameters of the batch have in common with those of the pairs is expected
    of a stack that has learned where these are, unless the batch is unlike the pairs.

    Args:
        diagnosis: What was found.
        report: The report of the stack that is used; None for another posterior, which
            all findings concern.
    """
    is_like_pairs = UNLIKE_PAIRS in diagnosis and not diagnosis[UNLIKE_PAIRS].alarming
    has_learned = (
        report is not None
        and report.learns_prior
        and is_improbable(report.probability_of_prior)
    )
    findings = tuple(
        replace(one, is_expected=one.alarming and is_like_pairs and has_learned)
        if one.name.partition(": ")[2] in diagnosis.like_pairs
        else one
        for one in diagnosis.findings
    )
    used = "posterior" if report is None else "stack"
    return replace(diagnosis, findings=findings, used=used)


def whom_it_concerns(finding: Finding) -> str:
    """Return a sentence that says which posteriors a finding is about."""
    return f"This is about {IN_WORDS[finding.concerns]}."


def why_expected(finding: Finding) -> str:
    """Say why a finding is expected, after "as expected"."""
    if finding.concerns == "NPE":
        return "where the simulator is wrong"
    return "of this stack, which has learned from the pairs where parameters are"


def _by_reason(findings: Iterable[Finding]) -> dict[str, list[Finding]]:
    """Return expected findings by why they are expected."""
    reasons: dict[str, list[Finding]] = {}
    for one in findings:
        reasons.setdefault(why_expected(one), []).append(one)
    return reasons


def _indented(text: str, *, first: str = "  ") -> str:
    return textwrap.fill(text, 88, initial_indent=first, subsequent_indent="  ")

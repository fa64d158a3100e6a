"""A diagnosis: its findings in words and numbers, and the arrays behind them."""

import textwrap
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from torch import Tensor

from sbi_rope._notebooks import shown_as_text

__all__ = ["Diagnosis", "Finding"]

Concerned = Literal["NPE", "RoPE", "stack and RoPE"]

# Whom an alarm concerns, in words.
IN_WORDS: dict[Concerned, str] = {
    "NPE": "NPE as it was trained, before any repair",
    "RoPE": "RoPE, and not a stack without couplings among its candidates",
    "stack and RoPE": "the posterior of `stack` and that of RoPE",
}


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
        is_expected: Whether the number is alarming, but expected where the simulator is
            wrong, and no reason to distrust a repaired posterior.
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
        whom = f"This is about {IN_WORDS[self.concerns]}."
        return "\n".join(
            [
                f"{mark} {self.name}: {self.number}",
                _indented(f"{self.sentence} {whom} {self.reason}"),
            ]
        )


@shown_as_text
@dataclass(frozen=True, eq=False, kw_only=True)
class Diagnosis:
    r"""Findings about a batch of real observations, and the arrays behind them.

    All tensors are float64 on the CPU unless said otherwise. Print it: alarms come
    first and in full, and the other findings have a line each.

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

    @property
    def alarming(self) -> tuple[Finding, ...]:
        """The findings beyond their thresholds, the expected ones included."""
        return tuple(finding for finding in self.findings if finding.alarming)

    @property
    def unexpected(self) -> tuple[Finding, ...]:
        """The alarming findings that nobody expected, and that call for action.

        Those about all posteriors come first, and those about NPE alone last.
        """
        order = list(reversed(IN_WORDS))
        unexpected = [one for one in self.alarming if not one.is_expected]
        return tuple(sorted(unexpected, key=lambda one: order.index(one.concerns)))

    @property
    def expected(self) -> tuple[Finding, ...]:
        """The findings that only say that the simulator is wrong, as expected."""
        return tuple(one for one in self.alarming if one.is_expected)

    @property
    def verdict(self) -> str:
        """How many findings are alarming, in a sentence."""
        count = len(self.unexpected)
        verdict = (
            f"{count or 'none'} of {len(self.findings)} findings "
            f"{'is' if count < 2 else 'are'} alarming."
        )
        if self.expected:
            one = "Another" if count else "One"
            verdict += f" {one} is as expected where the simulator is wrong."
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
        quiet = [finding for finding in self.findings if not finding.alarming]
        count = len(self.distance)
        lines = [
            _indented(
                f"Diagnosis of {count} observation{'s' * (count > 1)} against "
                f"{len(self.theta)} simulations: {self.verdict}",
                first="",
            ),
            *_in_full(self.unexpected),
        ]
        if self.expected:
            lines.append("as expected where the simulator is wrong:")
        for one in self.expected:
            lines += [f"  {one.name}: {one.number}", _indented(one.sentence)]
        if quiet:
            lines.append("no alarm (in brackets whose posterior one would be about):")
        lines += [f"  {one.name}: {one.number} [{one.concerns}]" for one in quiet]
        lines += [_indented(note, first="* ") for note in self.notes]
        return "\n".join(lines)


def _in_full(findings: Iterable[Finding]) -> list[str]:
    """Return the text of each finding; a reason that follows itself is left out."""
    lines, given = [], ""
    for one in findings:
        text = str(one)
        if one.reason == given:
            head, _, _ = text.partition("\n")
            text = f"{head}\n{_indented(one.sentence)}"
        lines.append(text)
        given = one.reason
    return lines


def _indented(text: str, *, first: str = "  ") -> str:
    return textwrap.fill(text, 88, initial_indent=first, subsequent_indent="  ")

"""A diagnosis: its findings in words and numbers, and the arrays behind them."""

import textwrap
from dataclasses import asdict, dataclass, field
from typing import Any

from torch import Tensor

__all__ = ["Diagnosis", "Finding"]


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
    """

    name: str
    value: float
    threshold: float
    alarming: bool
    sentence: str
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class Diagnosis:
    r"""Findings about a batch of real observations, and the arrays behind them.

    All tensors are float64 on the CPU unless said otherwise.

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

    @property
    def alarming(self) -> tuple[Finding, ...]:
        """The findings beyond their thresholds."""
        return tuple(finding for finding in self.findings if finding.alarming)

    def __getitem__(self, name: str) -> Finding:
        """Return the finding of a name."""
        return {finding.name: finding for finding in self.findings}[name]

    def as_rows(self) -> list[dict[str, Any]]:
        """Return a row for each finding, ready for a dataframe."""
        return [asdict(finding) for finding in self.findings]

    def __str__(self) -> str:
        count = len(self.alarming)
        lines = [
            f"Diagnosis of {len(self.distance)} observations against {len(self.theta)} "
            f"simulations: {count} of {len(self.findings)} findings "
            f"{'is' if count == 1 else 'are'} alarming."
        ]
        given = ""
        for finding in self.findings:
            mark = "!" if finding.alarming else "-"
            lines.append(
                f"{mark} {finding.name}: {finding.value:.3g} "
                f"(threshold {finding.threshold:.3g})"
            )
            # All parameters have the same reason, which is printed only once.
            reason = "" if finding.reason == given else finding.reason
            lines.append(_indented(f"{finding.sentence} {reason}"))
            given = finding.reason
        lines += [_indented(note, first="* ") for note in self.notes]
        return "\n".join(lines)


def _indented(text: str, *, first: str = "  ") -> str:
    return textwrap.fill(text, 88, initial_indent=first, subsequent_indent="  ")

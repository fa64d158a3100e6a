"""A diagnosis: its findings in words and numbers, and the arrays behind them."""

import textwrap
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True)
class Finding:
    """What one test found.

    Attributes:
        name: The name of the test.
        sentence: What was found, and what to do about an alarm; or why the test was
            left out.
        alarming: Whether it is an alarm about the posterior in use.
        value: The number that was tested; None if the test was left out.
        threshold: The limit of this number. P-values are alarming below it, other
            numbers above.
    """

    name: str
    sentence: str
    alarming: bool = False
    value: float | None = None
    threshold: float | None = None

    def __str__(self) -> str:
        return _wrapped(f"{'!' if self.alarming else '-'} {self.name}: {self.sentence}")


@dataclass(frozen=True, eq=False, kw_only=True)
class Diagnosis:
    """Findings about a batch of real observations, and the arrays behind them.

    Print it: alarms come first, and say what to do. ``diagnosis[name]`` is the finding
    of a name. All tensors are float64 on the CPU unless said otherwise.

    Attributes:
        findings: What the tests found that concern the posterior in use, alarms first;
            ready for ``pandas.DataFrame``.
        distance: Distance from :math:`g(x_o)` to the nearest simulation, ``(n_o,)``, in
            units of the limit above which an observation is flagged.
        theta: The parameters of the simulations, ``(n_s, d)``.
        implied: Weights of ``theta`` that estimate the distribution of the parameters
            of the batch, ``(n_s,)``. They sum to one.
        unshifted: The same weights for a batch that follows the prior. They are blurred
            as ``implied`` is.
        prior: Draws of the prior, ``(n, d)``, for pictures.
        parameter_names: One name for each parameter.
    """

    findings: tuple[Finding, ...]
    distance: Tensor = field(repr=False)
    theta: Tensor = field(repr=False)
    implied: Tensor = field(repr=False)
    unshifted: Tensor = field(repr=False)
    prior: Tensor = field(repr=False)
    parameter_names: tuple[str, ...]

    @property
    def flags(self) -> Tensor:
        """Indices of the observations that no simulation matches, int64."""
        return (self.distance > 1).nonzero().flatten()

    @property
    def alarming(self) -> tuple[Finding, ...]:
        """The findings that are alarms."""
        return tuple(one for one in self.findings if one.alarming)

    def __getitem__(self, name: str) -> Finding:
        """Return the finding of a name."""
        return {one.name: one for one in self.findings}[name]

    def __str__(self) -> str:
        count, alarms = len(self.distance), len(self.alarming)
        tests = sum(one.value is not None for one in self.findings)
        title = (
            f"Diagnosis of {count} observation{'s' * (count > 1)} against "
            f"{len(self.theta)} simulations: {alarms or 'no'} "
            f"alarm{'s' * (alarms > 1)} in {tests} tests."
        )
        return "\n".join([_wrapped(title), *map(str, self.findings)])


def _wrapped(text: str) -> str:
    return textwrap.fill(text, 80, subsequent_indent="  ", break_on_hyphens=False)

"""The candidates of a stack that are trained on observations without labels."""

from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

from sbi_rope._sbi import estimator_of
from sbi_rope._validation import column_names
from sbi_rope.errors import InvalidInputError
from sbi_rope.mixture import Part, part_of
from sbi_rope.settings import check
from sbi_rope.stacking.candidates import AmortisedCandidate
from sbi_rope.stacking.folds import Fold
from sbi_rope.stacking.workbench import Workbench
from sbi_rope.tensors import as_numbers

__all__ = ["RVNPCandidate"]

# With fewer observations, or with more statistics, the default stack does without it.
# One of thousands of steps takes .05 s with 6 statistics, .4 s with 20 and 3 s with 50.
MIN_OBSERVATIONS, MAX_STATISTICS = 100, 20
# Training takes longer with every observation. None of these was tuned.
MAX_OBSERVATIONS = 1000


@dataclass(frozen=True, eq=False)
class RVNPCandidate(AmortisedCandidate):
    """NPE with an error model that is learned from observations without labels.

    See :class:`~sbi_rope.baselines.RVNP`. It is trained once, because it does not see
    the labels of the pairs, which only decide about its weight.

    Args:
        x_o: Real observations, shape ``(n_o, *event)``. The stack may be asked about
            these or about others. The observations of the calibration pairs should
            not be among them, so that the scores are those of new observations. If
            there are more than 1000, a thousand of them are drawn.
        space: What the errors are in: the ``"embedding"`` h(x), or the ``"input"`` x,
            whose shape must be ``(l,)`` then. The default stack has the latter if x
            is a short vector and NPE has an embedding net. Training takes minutes
            with a few statistics, and hours with fifty.

    Raises:
        InvalidInputError: If x_o holds no numbers.
        InvalidInputError: If ``space`` is something else, or x_o is a table whose
            columns have names. Shape and values of x_o are checked when the stack is
            made.
    """

    x_o: Tensor = field(repr=False)
    space: Literal["embedding", "input"] = field(default="embedding", kw_only=True)
    fixed = True

    def __post_init__(self) -> None:
        """Check the fields, and take a copy of the observations."""
        check("space", self.space, Literal["embedding", "input"])
        if column_names(self.x_o):
            raise InvalidInputError(
                "Expected `x_o` without names of columns, whose order is not checked "
                f"here; got {type(self.x_o).__name__}. Use `default_candidates(rope, "
                "x_o)`, which checks it, or pass `x_o.to_numpy()`."
            )
        object.__setattr__(self, "x_o", as_numbers("x_o", self.x_o).clone())

    @property
    def name(self) -> str:  # type: ignore[override]
        """The name of the method and its setting."""
        return "RVNP" if self.space == "embedding" else "RVNP (input)"

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "RVNP"

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether there are enough observations of a few statistics."""
        if len(self.x_o) < MIN_OBSERVATIONS:
            return False
        reads_x = bench.reads_summaries and bool(torch.isfinite(self.x_o).all())
        if self.space != ("input" if reads_x else "embedding"):
            return False
        statistics = bench.simulations[1] if reads_x else bench.embedded
        varies = bool((statistics != statistics[0]).any())
        return varies and statistics.shape[1] <= MAX_STATISTICS

    def parts(self, fold: Fold) -> list[Part]:
        """Train errors and posterior on the observations; return the density."""
        # Importing the package does not load the baselines.
        from sbi_rope.baselines.rvnp import RVNP

        bench = fold.bench
        method = RVNP.from_posterior(bench.npe, noise_on=self.space)
        # The fold has seeded the random numbers.
        x_o = self.x_o
        if len(x_o) > MAX_OBSERVATIONS:
            x_o = x_o[torch.randperm(len(x_o))[:MAX_OBSERVATIONS]]
        # What a user passed is checked before anything is simulated.
        method.append_observations(x_o).append_simulations(*bench.simulations)
        method.train(show_progress_bars=bench.show)
        return [part_of(estimator_of(method.build_posterior()))]

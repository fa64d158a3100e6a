"""The candidates of a stack that are trained on observations without labels."""

from dataclasses import dataclass, field
from typing import Literal

from torch import Tensor

from sbi_rope._sbi import estimator_of
from sbi_rope._validation import check_choice
from sbi_rope.mixture import Part, part_of
from sbi_rope.stacking.candidates import AmortisedCandidate
from sbi_rope.stacking.folds import Fold, Workbench

__all__ = ["RVNPCandidate"]

# With fewer observations the default stack does without it. Fixed beforehand.
MIN_OBSERVATIONS = 100


@dataclass(frozen=True, eq=False)
class RVNPCandidate(AmortisedCandidate):
    """NPE with an error model that is learned from observations without labels.

    See :class:`~sbi_rope.baselines.RVNP`. It is trained once, because it does not see
    the labels of the pairs, which only decide about its weight.

    Args:
        x_o: Real observations, shape ``(n_o, *event)``. The stack may be asked about
            these or about others. The observations of the calibration pairs should
            not be among them, so that the scores are those of new observations.
        space: What the errors are in: the ``"embedding"`` h(x), or the ``"input"`` x,
            whose shape must be ``(l,)`` then. The default stack has the latter if x
            is a short vector and NPE has an embedding net.

    Raises:
        InvalidInputError: If an argument is outside its range. Shape and values of x_o
            are checked when the stack is made.
    """

    x_o: Tensor = field(repr=False)
    space: Literal["embedding", "input"] = "embedding"
    fixed = True

    def __post_init__(self) -> None:
        """Check the value of the field."""
        check_choice("space", self.space, ("embedding", "input"))

    @property
    def name(self) -> str:  # type: ignore[override]
        """The name of the method and its setting."""
        return "RVNP" if self.space == "embedding" else "RVNP (input)"

    @property
    def family(self) -> str:
        """The method that it is a setting of."""
        return "RVNP"

    def applies_to(self, bench: Workbench) -> bool:
        """Tell whether there are enough observations, and errors suit the space."""
        suits = "input" if bench.reads_summaries else "embedding"
        return len(self.x_o) >= MIN_OBSERVATIONS and self.space == suits

    def parts(self, fold: Fold) -> list[Part]:
        """Train errors and posterior on the observations; return the density."""
        # Importing the package does not load the baselines.
        from sbi_rope.baselines.rvnp import RVNP

        bench = fold.bench
        method = RVNP.from_posterior(bench.npe, noise_on=self.space)
        # What a user passed is checked before anything is simulated.
        method.append_observations(self.x_o).append_simulations(*bench.simulations)
        # The fold has seeded the random numbers.
        method.train(show_progress_bars=bench.show)
        return [part_of(estimator_of(method.build_posterior()))]

"""What is said about simulations that are missing."""

from sbi_rope._simulator.calls import Failure, Simulated
from sbi_rope.errors import SimulationError, warn_user

__all__ = ["Failures", "warn_of_few"]

# With fewer simulations than these there is a warning. RoPE couples with as many.
FEW = 1000


class Failures:
    """Counts the rows in which a simulator raised while it simulates many.

    Args:
        total: How many rows are to be simulated.

    Attributes:
        count: In how many of them it raised so far.
        first: The first of these.
    """

    def __init__(self, total: int) -> None:
        self.total = total
        self.count = 0
        self.first: Failure | None = None

    def add(self, simulated: Simulated, start: int) -> None:
        """Count the failures among some more rows.

        Args:
            simulated: These rows.
            start: The number of the first of them.

        Raises:
            SimulationError: If the simulator has raised in more than half of all rows.
        """
        self.count += simulated.num_failed
        if self.first is None and simulated.first is not None:
            self.first = simulated.first.moved_by(start)
        if 2 * self.count > self.total:
            raise SimulationError(
                "Expected the simulator to work for at least half of the parameters; "
                f"it raised for {self.count} of {self.total}, first {self.first}. "
                "Repair that, or return NaN where a simulation cannot be made."
            ) from self.cause

    @property
    def cause(self) -> Exception | None:
        """What the simulator raised first."""
        return None if self.first is None else self.first.error

    def warn(self) -> None:
        """Warn if the simulator raised."""
        if self.count:
            warn_user(
                f"The simulator raised for {self.count} of {self.total} parameters, "
                f"first {self.first}. Their simulations count as NaN."
            )

    def warn_of_dropped(self, dropped: int, what: str) -> None:
        """Warn if simulations were dropped, and say why.

        Args:
            dropped: How many were dropped, with those for which the simulator raised.
            what: What was simulated.
        """
        if dropped:
            warn_user(
                f"Dropped {dropped} of {self.total} {what} because they contain NaN or "
                f"Inf.{self}"
            )

    def __str__(self) -> str:
        """Say what the simulator raised, after a sentence on what is missing."""
        if self.first is None:
            return ""
        return f" For {self.count} of them the simulator raised, first {self.first}."


def warn_of_few(count: int) -> None:
    """Warn if there are few stored simulations, and say what that costs."""
    if count < FEW:
        warn_user(
            f"Only {count} simulations are stored. For each label those with the "
            "nearest parameters are looked up, and among so few these are far from the "
            "label's own. The tuned embedding and the discrepancy model are then less "
            f"accurate, and RoPE couples a batch with {count} simulations at most. "
            f"Store {FEW} or more, or pass the simulator."
        )

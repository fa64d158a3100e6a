"""Made-up results of the benchmark."""

from typing import Any

import numpy as np

from benchmarks.cells import Cell
from benchmarks.store import Result


def result_of(cell: Cell, lpp: float | str, acauc: float = 0.01) -> Result:
    """Make up a result: a finished cell of this score, or a failed one."""
    row: dict[str, Any] = {**vars(cell), "git_commit": "1234567"}
    if isinstance(lpp, str):
        return Result(row | {"status": "failed", "error": "ValueError: no"}, {})
    row |= dict.fromkeys(("lpp", "lpp_z", "lpp_median"), lpp)
    row |= {"seconds_npe": 1, "seconds_train": 0, "seconds_couple": 0}
    row |= {"status": "finished", "lpp_standard_error": 0.1, "acauc": acauc}
    row |= {"converged": True, "n_test": 1000, "stand_in": cell.variant == "synthetic"}
    return Result(row, {"log_probs": np.full(3, lpp)})

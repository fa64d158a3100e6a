"""Count what all public callables do with bad inputs: python -m tests.faults."""

import sys
from collections import Counter

from tests.faults.trials import trials

counts: Counter[str] = Counter()
for trial in trials():
    outcome = trial()
    counts[outcome.verdict] += 1
    if outcome.verdict in ("raw", "silent") or "-v" in sys.argv:
        print(outcome, flush=True)
print(f"{counts.total()} inputs: {dict(counts)}")

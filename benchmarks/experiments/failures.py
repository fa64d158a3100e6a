"""What do a stack's report and the diagnosis say where a linear discrepancy must fail?

The suite `failures` has the scores. Here a stack is trained on the calibration pairs of
each of its variants, and its report is printed, followed by what the diagnosis of the
test set finds alarming.

    python -m benchmarks.experiments.failures
"""

import argparse

from benchmarks.experiments.common import add_task, begin
from benchmarks.experiments.data import case_of
from benchmarks.scoring import rope_of
from sbi_rope import stack
from sbi_rope.diagnosis import diagnose

VARIANTS = ("curved", "heavy_tails", "biased_calibration")
OPTIONS = {
    "--variants": {"nargs": "+", "default": VARIANTS},
    "--n-calibration": {"type": int, "default": 50},
}


def report(args: argparse.Namespace, variant: str) -> str:
    """Return the report of a stack and what is alarming about the test set."""
    args = argparse.Namespace(**{**vars(args), "variant": variant})
    case = case_of(args, n_calibration=args.n_calibration)
    rope = rope_of(case).append_calibration(*case.calibration)
    posterior = stack(rope, seed=case.seed, show_progress_bars=False)
    rope.train(seed=case.seed, show_progress_bars=False)
    found = diagnose(rope, case.test_set[1], seed=case.seed, show_progress_bars=False)
    alarming = [f"! {one.sentence}" for one in found.findings if one.alarming]
    return "\n".join([str(posterior.report), *(alarming or ["nothing alarming"])])


def main() -> None:
    """Print all reports."""
    options = add_task(OPTIONS)
    options["--task"] = {"default": "linear_gaussian"}
    args = begin(__doc__, options, threads=1)
    for variant in args.variants:
        print(f"## {variant}\n\n{report(args, variant)}\n", flush=True)


if __name__ == "__main__":
    main()

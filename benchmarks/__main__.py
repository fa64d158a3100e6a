"""The benchmark as one command, which can be killed and resumed.

    python -m benchmarks run smoke
    python -m benchmarks run main --task pendulum --jobs 2 --root FOLDER
    python -m benchmarks status
    python -m benchmarks summary

`run` keeps each result in `OUT/SUITE` as soon as it is there, and computes only what is
missing; `--retry` also what failed, and `--again` also what another version of the code
has made. It ends with status 1 if a cell failed. `status` counts cells. `summary`
writes the tables of README and of pages of docs, and draws their picture. With
`--out benchmarks/results` it goes on from the committed results.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.cases import Workplace
from benchmarks.figures import draw_overview, draw_suite
from benchmarks.pages import pages_with_blocks, write_pages
from benchmarks.published import Published
from benchmarks.runner import run_cells
from benchmarks.store import Results
from benchmarks.suites import list_suites, load_suite

ROOT = Path(__file__).parents[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = commands.add_parser("run", help="run the cells of a suite")
    run.set_defaults(command=_run)
    run.add_argument("suite", help=f"one of {', '.join(list_suites())}, or a TOML file")
    for name, kind in {
        "task": str,
        "method": str,
        "n-calibration": int,
        "repetition": int,
    }.items():
        run.add_argument(f"--{name}", nargs="+", type=kind, help="these only")
    run.add_argument("--jobs", type=int, default=1, help="at a time; -1: all cores")
    run.add_argument("--device", default="cpu", help="%(default)s, or cuda")
    run.add_argument("--root", type=Path, help="folder of recorded data")
    run.add_argument(
        "--hemodynamics", type=Path, help="folder with simulator.npz and real.npz"
    )
    run.add_argument(
        "--again", action="store_true", help="also what other versions have made"
    )
    run.add_argument("--retry", action="store_true", help="also what failed")
    status = commands.add_parser("status", help="count cells")
    status.set_defaults(command=_status)
    summary = commands.add_parser("summary", help="write the pages' tables")
    summary.set_defaults(command=_summary)
    for command, out in (
        (run, "results/benchmark"),
        (status, "results/benchmark"),
        (summary, ROOT / "benchmarks/results"),
    ):
        command.add_argument("--out", type=Path, default=out, help="(%(default)s)")
    args = parser.parse_args(arguments)
    return args.command(args)


def _run(args: argparse.Namespace) -> int:
    suite = load_suite(args.suite)
    cells = suite.select(
        task=args.task,
        method=args.method,
        n_calibration=args.n_calibration,
        repetition=args.repetition,
    )
    results = Results(args.out / suite.name)
    place = Workplace(args.out, args.root, args.hemodynamics, args.device)
    counts = run_cells(
        cells, results, place, jobs=args.jobs, again=args.again, retry=args.retry
    )
    results.sort(suite.cells)
    draw_suite(suite, results.rows, results.folder)
    rows = results.rows.loc[cells]
    table = rows.pivot_table("lpp_z", "method", ["task", "n_calibration"], sort=False)
    print(table.round(2).to_string(na_rep="-"))
    failed = rows["error"][rows["status"] == "failed"]
    for cell, error in failed.items():
        print(f"failed: {cell}: {error.splitlines()[0][:150]}")
    print(", ".join(f"{count} {what}" for what, count in counts.items()))
    print(f"Written: {results.path}")
    return 1 if len(failed) else 0


def _status(args: argparse.Namespace) -> int:
    print(f"{'suite':<14}{'cells':>10}{'finished':>10}{'failed':>10}{'not run':>10}")
    for name in list_suites():
        cells = load_suite(name).cells
        known = Results(args.out / name).rows["status"].to_dict()
        found = [known.get(cell, "not run") for cell in cells]
        counts = [found.count(what) for what in ("finished", "failed", "not run")]
        print(f"{name:<14}" + "".join(f"{n:>10}" for n in (len(cells), *counts)))
    return 0


def _summary(args: argparse.Namespace) -> int:
    published, pages = Published.read(args.out), pages_with_blocks(ROOT)
    write_pages(published, pages)
    draw_overview(published, ROOT / "docs/pictures/benchmark.png")
    print(f"Written: {', '.join(map(str, pages))}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

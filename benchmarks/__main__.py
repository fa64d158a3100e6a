"""The benchmark as one command, which can be killed and resumed.

    python -m benchmarks run smoke
    python -m benchmarks run main --task pendulum --jobs 2 --root FOLDER
    python -m benchmarks status
    python -m benchmarks restore
    python -m benchmarks report
    python -m benchmarks summary
    python -m benchmarks claims

Cells that are finished are kept, whichever suite asked for them, and are not computed
again. Cells that failed are kept with their error; `--retry` computes them again. `run`
ends with status 1 if one of its cells failed or has no result. `restore` makes cells of
the committed tables, so that `run` computes only what these do not hold.
"""

import argparse
import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.blocks import pages_with_blocks
from benchmarks.cases import Sources
from benchmarks.cells import Suite, list_suites, load_suite
from benchmarks.claims import claims, missing_claims
from benchmarks.prices import Prices
from benchmarks.published import Published
from benchmarks.report import write_report
from benchmarks.runner import run_cells
from benchmarks.store import Workplace
from benchmarks.summary import write_summary
from benchmarks.table import COUNTED, Table, read_table, restore_cells, write_table
from sbi_rope.errors import InvalidInputError, RoPEError

DEFAULT_OUT = Path("results/benchmark")
PUBLISHED = Path(__file__).parent / "results"
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
    run.add_argument(
        "--task", nargs="+", action="extend", dest="tasks", help="these tasks only"
    )
    run.add_argument(
        "--method",
        nargs="+",
        action="extend",
        dest="methods",
        help="these methods only",
    )
    run.add_argument(
        "--repetition",
        nargs="+",
        action="extend",
        type=int,
        dest="repetitions",
        help="these only",
    )
    run.add_argument("--jobs", type=int, default=1, help="at a time; -1: all cores")
    run.add_argument(
        "--backend",
        default="loky",
        choices=["loky", "multiprocessing", "threading", "sequential", "dask"],
        help="backend of joblib (%(default)s)",
    )
    run.add_argument("--scheduler", help="address of a dask scheduler")
    run.add_argument("--device", default="cpu", help="%(default)s, or cuda")
    run.add_argument("--root", type=Path, help="folder of recorded data")
    run.add_argument(
        "--hemodynamics", type=Path, help="folder with simulator.npz and real.npz"
    )
    run.add_argument("--again", action="store_true", help="also what is finished")
    run.add_argument("--retry", action="store_true", help="also what failed")
    _add_out(run, DEFAULT_OUT)

    status = commands.add_parser("status", help="count cells, price those not run")
    status.set_defaults(command=_status)
    _add_out(status, DEFAULT_OUT)

    restore = commands.add_parser("restore", help="take over what is committed")
    restore.set_defaults(command=_restore)
    restore.add_argument(
        "--tables", type=Path, default=PUBLISHED, help="folder of tables (%(default)s)"
    )
    _add_out(restore, DEFAULT_OUT)

    report = commands.add_parser("report", help="write tables and figures again")
    report.set_defaults(command=_report)
    report.add_argument("suites", nargs="*", help="all that have results if none")
    _add_out(report, PUBLISHED)

    summary = commands.add_parser("summary", help="write what all suites say together")
    summary.set_defaults(command=_summary)
    summary.add_argument(
        "--pages",
        type=Path,
        nargs="+",
        help="files with places for blocks of results (README and pages of docs)",
    )
    _add_out(summary, PUBLISHED)

    claims = commands.add_parser("claims", help="check sentences of docs that count")
    claims.set_defaults(command=_claims)
    _add_out(claims, PUBLISHED)
    args = parser.parse_args(arguments)
    try:
        return args.command(args)
    except RoPEError as error:
        # What the user can put right: the message says how, a traceback would hide it.
        raise SystemExit(f"{type(error).__name__}: {error}") from error


def _add_out(parser: argparse.ArgumentParser, default: Path) -> None:
    parser.add_argument("--out", type=Path, default=default, help="(%(default)s)")


def _run(args: argparse.Namespace) -> int:
    if args.jobs == 0:
        raise InvalidInputError("Expected `--jobs` of 1 or more, or -1; got 0.")
    if args.scheduler and args.backend != "dask":
        raise InvalidInputError("Expected `--backend dask` with `--scheduler`.")
    suite = load_suite(args.suite)
    cells = suite.select(
        tasks=args.tasks, methods=args.methods, repetitions=args.repetitions
    )
    workplace = Workplace(
        folder=args.out,
        sources=Sources(root=args.root, hemodynamics=args.hemodynamics),
        device=args.device,
    )
    with _scheduler(args):
        counts = run_cells(
            cells,
            workplace,
            jobs=args.jobs,
            backend=args.backend,
            again=args.again,
            retry=args.retry,
        )
    print(", ".join(f"{count} {what}" for what, count in counts.items()))
    folder = args.out / suite.name
    table = write_table(suite, workplace.results, folder)
    path = write_report(suite, table, folder)
    print(f"Written: {path}")
    unfinished = 0
    for cell, status in zip(cells, table.statuses(cells), strict=True):
        if status == "not run":
            print(f"no result: {cell}")
        elif status == "failed":
            error = table.rows["error"][cell].splitlines()[0]
            print(f"failed: {cell}: {error[:150]}")
        unfinished += status != "finished"
    return 1 if unfinished else 0


@contextlib.contextmanager
def _scheduler(args: argparse.Namespace) -> Iterator[None]:
    """Connect to a dask cluster, or start one on this machine, if dask is asked for."""
    if args.backend != "dask":
        yield
        return
    from distributed import Client

    options = (
        {"address": args.scheduler}
        if args.scheduler
        else {"n_workers": max(args.jobs, 1), "threads_per_worker": 1}
    )
    with Client(**options):
        yield


def _status(args: argparse.Namespace) -> int:
    results = Workplace(folder=args.out, sources=Sources()).results
    suites = [load_suite(name) for name in list_suites()]
    cells = dict.fromkeys(cell for suite in suites for cell in suite.cells)
    rows = {cell: row for cell in cells if (row := results.read(cell)) is not None}
    table = Table.of(rows, {})
    prices = Prices([table.finished])
    counts = "".join(f"{what:>10}" for what in ("cells", *COUNTED))
    print(f"{'suite':<14}{counts}  hours of a core")
    for suite in suites:
        statuses = table.statuses(suite.cells)
        numbers = len(statuses), *(statuses.count(what) for what in COUNTED)
        counts = "".join(f"{number:>10}" for number in numbers)
        print(f"{suite.name:<14}{counts}  {prices.of(table.not_run(suite))}")
    print("? stands for what a cell of a method takes that was never run.")
    return 0


def _restore(args: argparse.Namespace) -> int:
    results = Workplace(folder=args.out, sources=Sources()).results
    for name in _with_tables(args.tables):
        table = read_table(load_suite(name), args.tables / name)
        print(f"{name}: {restore_cells(table, results)} cells restored")
    return 0


def _with_tables(folder: Path) -> list[str]:
    """Return the suites that a folder holds tables of."""
    names = [name for name in list_suites() if (folder / name / "results.csv").exists()]
    if not names:
        raise SystemExit(f"No results in {folder}. Use `run` first, or another folder.")
    return names


def _report(args: argparse.Namespace) -> int:
    for name in args.suites or _with_tables(args.out):
        suite: Suite = load_suite(name)
        folder = args.out / suite.name
        if not (folder / "results.csv").exists():
            raise SystemExit(f"No results of {suite.name} in {args.out}.")
        print(f"Written: {write_report(suite, read_table(suite, folder), folder)}")
    return 0


def _summary(args: argparse.Namespace) -> int:
    pages = args.pages or pages_with_blocks(ROOT)
    page = write_summary(args.out, pages=pages)
    print(f"Written: {', '.join(map(str, (page, *pages)))}")
    return 0


def _claims(args: argparse.Namespace) -> int:
    found = claims(Published.read(args.out))
    missing = missing_claims(found, ROOT)
    for claim in missing:
        print(f"{claim.page} does not say: {claim.text}")
    print(
        f"{len(found) - len(missing)} of {len(found)} sentences are as they should be."
    )
    return 1 if missing else 0


if __name__ == "__main__":
    raise SystemExit(main())

"""Break the code in known ways, one at a time, and see which test notices.

    python -m tests.mutations --out mutations.json
    python -m tests.mutations --quick --only 3 17

Where the named test files notice nothing, all tests of `make test` are run, which
takes as long as they do.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from tests.mutations.catalogue import Mutation, faults_of, read_mutations
from tests.mutations.trials import broken, copy_of_project, first_failure

CAUGHT, SURVIVED, UNSEEN = "caught", "survived", "not seen by the named files"


def main() -> None:
    arguments = _arguments()
    mutations = read_mutations()
    if faults := faults_of(mutations):
        raise SystemExit("\n".join(faults))
    names = {mutation.name for mutation in mutations}
    results = {k: v for k, v in _read(arguments.out).items() if k in names}
    with copy_of_project() as root:
        for number, mutation in enumerate(mutations, start=1):
            if arguments.only and number not in arguments.only:
                continue
            known = results.get(mutation.name, {})
            if not _is_settled(known, quick=arguments.quick):
                known = _tried(root, mutation, known, arguments)
                results[mutation.name] = known
                _write(arguments.out, results)
            print(_line(number, mutation, known), flush=True)
        wrong = _failing_anyway(root, results, arguments.timeout)
    outcomes = [result["outcome"] for result in results.values()]
    print(", ".join(f"{outcomes.count(o)} {o}" for o in (CAUGHT, SURVIVED, UNSEEN)))
    if wrong:
        raise SystemExit(f"This test fails without any mutation: {wrong}")
    raise SystemExit(0 if set(outcomes) <= {CAUGHT} else 1)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m tests.mutations")
    parser.add_argument("--only", nargs="+", type=int, help="numbers of mutations")
    parser.add_argument(
        "--quick", action="store_true", help="run the named test files alone"
    )
    parser.add_argument(
        "--out", type=Path, help="file of results, from which a run goes on"
    )
    parser.add_argument(
        "--timeout",
        type=float,
        default=3600.0,
        help="seconds after which tests that hang have noticed",
    )
    return parser.parse_args()


def _is_settled(result: dict[str, Any], *, quick: bool) -> bool:
    outcome = result.get("outcome")
    return outcome in (CAUGHT, SURVIVED) or (quick and outcome == UNSEEN)


def _tried(
    root: Path, mutation: Mutation, known: dict[str, Any], options: argparse.Namespace
) -> dict[str, Any]:
    """Make a mutation and run the named test files, then all if these pass."""
    start = time.perf_counter()
    with broken(root, mutation):
        failure = None
        if known.get("outcome") != UNSEEN:
            failure = first_failure(root, mutation.tests, timeout=options.timeout)
        if failure is None and not options.quick:
            failure = first_failure(root, (), timeout=options.timeout)
    outcome = UNSEEN if options.quick else SURVIVED
    return {
        "outcome": outcome if failure is None else CAUGHT,
        "by": failure,
        "seconds": round(time.perf_counter() - start, 1),
    }


def _failing_anyway(
    root: Path, results: dict[str, dict[str, Any]], timeout: float
) -> str | None:
    """Return a test that has noticed something, but fails without it as well."""
    found = {result["by"] for result in results.values() if result["by"]}
    tests = sorted(test for test in found if "::" in test)
    return first_failure(root, tests, timeout=timeout) if tests else None


def _read(path: Path | None) -> dict[str, dict[str, Any]]:
    if path is None or not path.exists():
        return {}
    return json.loads(path.read_text(encoding="utf-8"))


def _write(path: Path | None, results: dict[str, dict[str, Any]]) -> None:
    if path is not None:
        text = json.dumps(results, indent=1) + "\n"
        path.write_text(text, encoding="utf-8")


def _line(number: int, mutation: Mutation, result: dict[str, Any]) -> str:
    by = f" by {result['by']}" if result["by"] else ""
    seconds = f"{result['seconds']:.0f} s"
    return f"{number:3} {mutation.name}: {result['outcome']}{by} ({seconds})"


if __name__ == "__main__":
    main()

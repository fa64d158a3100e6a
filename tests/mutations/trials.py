"""Runs the tests on a broken copy of the project."""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from tests.mutations.catalogue import ROOT, Mutation

NOT_COPIED = shutil.ignore_patterns(
    ".git", ".venv*", ".hypothesis", ".*_cache", "__pycache__", "*.egg-info"
)
# What pytest returns where no test has failed and none was run.
PASSED, NOTHING_RUN = 0, {4, 5}


@contextmanager
def copy_of_project() -> Iterator[Path]:
    """Copy the working tree to a folder of its own, and remove it in the end."""
    with tempfile.TemporaryDirectory(prefix="mutations-") as folder:
        root = Path(folder, "project")
        shutil.copytree(ROOT, root, ignore=NOT_COPIED)
        shared = ROOT.parent / "shared"
        if shared.is_dir():  # recorded data
            Path(folder, "shared").symlink_to(shared, target_is_directory=True)
        yield root


@contextmanager
def broken(root: Path, mutation: Mutation) -> Iterator[None]:
    """Break a file of a copy for the time of a block."""
    path = root / mutation.file
    text = path.read_text(encoding="utf-8")
    path.write_text(mutation.applied_to(text), encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(text, encoding="utf-8")


def first_failure(root: Path, tests: Sequence[str], *, timeout: float) -> str | None:
    """Run tests in a copy and return the first that fails; None if all pass.

    Args:
        root: The copy.
        tests: Files or names of tests; those of `make test` if there are none.
        timeout: Seconds after which the tests count as failed.

    Raises:
        SystemExit: If no test could be run.
    """
    # A file of the same size may be written twice in a second, which the cache of
    # compiled modules would not notice.
    environment = {"OMP_NUM_THREADS": "1"} | os.environ
    environment |= {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    options = ("-x", "-q", "--tb=no", "-p", "no:cacheprovider")
    process = subprocess.Popen(
        [sys.executable, "-m", "pytest", *options, *tests],
        cwd=root,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        return f"nothing but the time: no result in {timeout:.0f} s"
    finally:
        _end(process)
    if process.returncode in NOTHING_RUN:
        raise SystemExit(f"pytest ran no test of {', '.join(tests)}:\n{output}")
    return None if process.returncode == PASSED else _named_in(output)


def _end(process: subprocess.Popen[str]) -> None:
    """End a process with all that it has started."""
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _named_in(output: str) -> str:
    lines = output.splitlines()
    for line in lines:
        verdict, _, rest = line.partition(" ")
        if verdict in ("FAILED", "ERROR"):
            return rest.split(" - ")[0]
    return lines[-1] if lines else "a crash without a word"

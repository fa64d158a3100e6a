"""The list of mutations in ``mutations.toml``, and what makes one of use."""

import ast
import sys
from dataclasses import dataclass
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, kw_only=True)
class Mutation:
    """A small break of the code that the tests must notice.

    Attributes:
        name: What is broken, in a sentence.
        file: The file, relative to the root of the project.
        before: A text that occurs exactly once in it.
        after: What takes its place.
        tests: The test files that are most likely to notice.
    """

    name: str
    file: str
    before: str
    after: str
    tests: tuple[str, ...]

    def applied_to(self, text: str) -> str:
        """Return the text of the file with the break in it."""
        return text.replace(self.before, self.after)

    def faults(self, root: Path = ROOT) -> list[str]:
        """Return why the mutation cannot be made; an empty list if it can."""
        names = (self.file, *self.tests)
        if missing := [name for name in names if not (root / name).is_file()]:
            return [f"there is no file {name}" for name in missing]
        text = (root / self.file).read_text(encoding="utf-8")
        if (count := text.count(self.before)) != 1:
            return [f"`before` occurs {count} times in {self.file}, not once"]
        unbroken, broken = ast.parse(text), ast.parse(self.applied_to(text))
        if ast.dump(unbroken) == ast.dump(broken):
            return ["`after` means the same as `before`"]
        return []


def read_mutations() -> list[Mutation]:
    """Read the list."""
    text = Path(__file__).with_name("mutations.toml").read_text(encoding="utf-8")
    return [
        Mutation(**entry | {"tests": tuple(entry["tests"])})
        for entry in tomllib.loads(text)["mutation"]
    ]


def faults_of(mutations: list[Mutation]) -> list[str]:
    """Return why some mutations of a list cannot be made, each with its name."""
    return [
        f"{mutation.name}: {fault}"
        for mutation in mutations
        for fault in mutation.faults()
    ]

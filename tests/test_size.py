"""The package stays small enough to be held in one head.

    make size    # prints lines, room by room

Whoever needs more lines takes them from another room, in the same change.
"""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
# The most lines of all files of a kind in folders, docstrings included. The core is the
# package without its tasks and baselines.
BUDGETS = {
    "core": 12_000,
    "sbi_rope/baselines/*.py": 2_900,
    "sbi_rope/tasks/*.py": 6_300,
    "benchmarks/*.py": 2_900,
    "tests/*.py": 14_500,
    "docs/*.md": 2_800,
}
# Checks live at the boundary: in settings, tensors, and where a posterior is split.
MOST_CHECKS, CHECKS = 15, ("check", "warn", "refuse")


def lines_of(place: str) -> int:
    """Count the lines of files, such as "docs/*.md", in a folder and all below it."""
    if place == "core":
        others = [one for one in BUDGETS if one.startswith("sbi_rope/")]
        return lines_of("sbi_rope/*.py") - sum(map(lines_of, others))
    folder, pattern = place.rsplit("/", 1)
    files = (ROOT / folder).rglob(pattern)
    return sum(
        len(file.read_text(encoding="utf-8").splitlines())
        for file in files
        if "_build" not in file.parts
    )


def checks() -> list[str]:
    """Return the functions of the package whose name says that they check or warn."""
    return [
        f"{file.relative_to(ROOT)}: {node.name}"
        for file in sorted((ROOT / "sbi_rope").rglob("*.py"))
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
        and node.name.lstrip("_").startswith(CHECKS)
    ]


@pytest.mark.parametrize("place", BUDGETS)
def test_a_room_is_within_its_budget(place: str) -> None:
    assert lines_of(place) <= BUDGETS[place]


def test_few_functions_check_and_warn() -> None:
    assert len(found := checks()) <= MOST_CHECKS, "\n".join(found)


def main() -> None:
    for room in sorted((ROOT / "sbi_rope").iterdir()):
        if (room / "__init__.py").exists():
            print(f"{lines_of(f'sbi_rope/{room.name}/*.py'):7,}  sbi_rope/{room.name}")
    for place, budget in BUDGETS.items():
        print(f"{lines_of(place):7,}  {place} (at most {budget:,})")
    print(f"{lines_of('sbi_rope/*.py'):7,}  sbi_rope/*.py")
    print(f"{len(checks()):7,}  functions that check or warn (at most {MOST_CHECKS})")


if __name__ == "__main__":
    main()

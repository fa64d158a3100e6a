"""Blocks of a page in Markdown that are written from the tables of the suites."""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

__all__ = ["check_blocks", "fill_blocks", "pages_with_blocks"]

END = "<!-- /results -->"
BLOCK = re.compile(rf"(<!-- results: ([\w-]+) -->\n)(.*?){END}", re.DOTALL)
# What begins or ends a block, also one that is not whole.
MARKER = re.compile(r"<!-- /?results")


def pages_with_blocks(root: Path) -> list[Path]:
    """Return README and the pages of docs of a project, where they have blocks."""
    docs = root / "docs"
    # `make docs` copies pages into this folder.
    built = docs / "_build"
    written = [page for page in docs.rglob("*.md") if built not in page.parents]
    pages = [root / "README.md", *sorted(written)]
    return [page for page in pages if MARKER.search(page.read_text(encoding="utf-8"))]


def check_blocks(path: Path, known: Sequence[str]) -> None:
    """Check that a page has blocks, that they are whole and that all are known.

    Raises:
        SystemExit: If not. It names the page and what it needs.
    """
    text = path.read_text(encoding="utf-8")
    blocks = BLOCK.findall(text)
    if not blocks or len(MARKER.findall(text)) != 2 * len(blocks):
        raise SystemExit(
            f"{path} needs a line <!-- results: NAME --> and, below it, a line {END} "
            "for each block, and at least one block."
        )
    for _, name, _ in blocks:
        if name not in known:
            raise SystemExit(
                f"{path} has a block named {name}; expected one of {', '.join(known)}."
            )


def fill_blocks(path: Path, lines_of: Mapping[str, Callable[[Path], list[str]]]) -> str:
    """Return the text of a page with its blocks written anew, and all else as it is.

    Args:
        path: The page, which `check_blocks` has checked.
        lines_of: By name of a block: makes its lines, from the path of the page.
    """

    def filled(block: re.Match[str]) -> str:
        begin, name, _ = block.groups()
        return "\n".join([begin.rstrip(), *lines_of[name](path), END])

    return BLOCK.sub(filled, path.read_text(encoding="utf-8"))

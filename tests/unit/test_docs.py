"""Links of the README, of the documentation, and of what the code says of them."""

import re
from pathlib import Path

import sbi_rope

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    path
    for pattern in ("*.md", "docs/**/*.md", "benchmarks/**/*.md", "tests/data/*.md")
    for path in ROOT.glob(pattern)
    if "_build" not in path.parts
)


def prose(page: Path) -> str:
    """Return a page without blocks of code, in which brackets are no links."""
    return re.sub(r"(?ms)^( *)```.*?^\1```$", "", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub and Sphinx make them."""
    headings = re.findall(r"^#+ (.*)$", prose(page), flags=re.MULTILINE)
    plain = (re.sub(r"\[(.*?)\]\(.*?\)", r"\1", heading) for heading in headings)
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in plain}


def test_links_between_pages_lead_to_files_and_headings_that_exist() -> None:
    broken = []
    for page in PAGES:
        for link in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
            if re.match(r"[a-z]+:", link):  # `make docs-links` asks other sites
                continue
            path, _, anchor = link.partition("#")
            target = page.parent / path if path else page
            if not target.exists() or (
                anchor and target.suffix == ".md" and anchor not in anchors(target)
            ):
                broken.append(f"{page.relative_to(ROOT)}: {link}")
    assert broken == []


def test_the_reference_describes_all_that_the_package_exports() -> None:
    page = (ROOT / "docs/reference/sbi_rope.md").read_text()
    described = re.findall(r"^\.\. auto\w+:: (\w+)$", page, flags=re.MULTILINE)
    assert sorted(described) == sorted(sbi_rope.__all__)

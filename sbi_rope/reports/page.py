"""The parts of an HTML page that needs no other file; every text in it is escaped."""

import base64
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from sbi_rope.errors import InvalidInputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "definitions",
    "finding",
    "number",
    "page",
    "paragraph",
    "percent",
    "picture",
    "section",
    "table",
    "verdict",
    "write_page",
]

# By this a page of this package is recognised.
GENERATOR = '<meta name="generator" content="sbi_rope'
DPI = 130

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 52rem; padding: 1.2rem; background: #fff;
  color: #1d2430; font: 16px/1.55 system-ui, "Segoe UI", Roboto, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: .4rem 0 .2rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; padding-top: .7rem;
  border-top: 1px solid #d5dbe4; }
p, ul, dl { margin: .6rem 0; }
ul { padding-left: 1.3rem; }
.note { color: #566070; font-size: .9rem; }
.verdict { border-left: 4px solid #0072b2; background: #f1f6fa; padding: .5rem 1rem; }
.verdict li.alarm, p.alarm { color: #a03c00; font-weight: 600; }
.wide { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .92rem;
  font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .3rem .8rem .3rem 0; vertical-align: top;
  border-bottom: 1px solid #e4e8ee; }
th { font-weight: 600; border-bottom-color: #9aa5b4; }
td.number, th.number { text-align: right; white-space: nowrap; }
tr.strong td { font-weight: 600; background: #f1f6fa; }
tr.alarm td { background: #fdf1e8; }
.finding { border-left: 4px solid #d5dbe4; padding: .1rem .9rem; margin: .7rem 0; }
.finding.alarm { border-left-color: #d55e00; background: #fdf1e8; }
.finding span { color: #566070; font-size: .9rem; white-space: nowrap; }
.finding p { margin: .2rem 0 .4rem; }
img { display: block; max-width: 100%; height: auto; }
.wide img { max-width: none; width: 46rem; }
figure { margin: .8rem 0; }
figcaption { color: #566070; font-size: .9rem; }
dt { font-weight: 600; margin-top: .5rem; }
dd { margin: 0; }
@media (max-width: 600px) { body { padding: .8rem; font-size: 15px; } }
"""


def paragraph(text: str, *, kind: str = "") -> str:
    """Return a paragraph."""
    return f"<p{_class(kind)}>{_text(text)}</p>"


def verdict(texts: Iterable[tuple[str, bool]]) -> str:
    """Return the box of the verdict, of sentences that are alarming or not."""
    lines = [
        f"<li{_class('alarm' if alarming else '')}>{_text(text)}</li>"
        for text, alarming in texts
    ]
    return "\n".join(['<div class="verdict">', "<ul>", *lines, "</ul>", "</div>"])


def definitions(words: Mapping[str, str]) -> str:
    """Return a list of words with what they mean; all are escaped."""
    lines = [
        f"<dt>{_text(word)}</dt><dd>{_text(text)}</dd>" for word, text in words.items()
    ]
    return "\n".join(["<dl>", *lines, "</dl>"])


def table(
    heads: Sequence[str] | None,
    rows: Iterable[Sequence[str]],
    *,
    numbers: Iterable[int] = (),
    strong: Iterable[int] = (),
    alarming: Iterable[int] = (),
) -> str:
    """Return a table that scrolls by itself on a narrow screen.

    Args:
        heads: The heads of its columns, which are escaped, as all cells are. None for a
            table without heads.
        rows: The cells of each row.
        numbers: The columns that hold numbers, which are set to the right.
        strong: The rows to be set in bold.
        alarming: The rows to be marked.
    """
    right, bold, marked = set(numbers), set(strong), set(alarming)

    def cells(tag: str, values: Sequence[str]) -> str:
        kinds = [_class("number" if k in right else "") for k in range(len(values))]
        return "".join(
            f"<{tag}{kind}>{_text(value)}</{tag}>"
            for kind, value in zip(kinds, values, strict=True)
        )

    lines = ['<div class="wide">', "<table>"]
    if heads is not None:
        lines += ["<thead>", f"<tr>{cells('th', heads)}</tr>", "</thead>"]
    lines.append("<tbody>")
    for k, row in enumerate(rows):
        kind = "strong" if k in bold else "alarm" if k in marked else ""
        lines.append(f"<tr{_class(kind)}>{cells('td', row)}</tr>")
    return "\n".join([*lines, "</tbody>", "</table>", "</div>"])


def picture(figure: "Figure", *, caption: str, wide: bool = False) -> str:
    """Return a picture as part of the page."""
    buffer = io.BytesIO()
    # By default matplotlib would write a link to its own site into the file.
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    data = base64.b64encode(buffer.getvalue()).decode("ascii")
    text = _text(caption)
    image = f'<img alt="{text}" src="data:image/png;base64,{data}">'
    if wide:
        image = f'<div class="wide">{image}</div>'
    return f"<figure>{image}<figcaption>{text}</figcaption></figure>"


def finding(name: str, value: str, text: str, *, alarming: bool) -> str:
    """Return the result of a test: its name and number, and what it says."""
    mark = "Alarming: " if alarming else ""
    return (
        f"<div{_class('finding alarm' if alarming else 'finding')}>"
        f"<strong>{mark}{_text(name)}</strong> <span>{_text(value)}</span>"
        f"<p>{_text(text)}</p></div>"
    )


def section(title: str, *parts: str) -> str:
    """Return a section with a title, which is escaped."""
    return "\n".join(["<section>", f"<h2>{_text(title)}</h2>", *parts, "</section>"])


def page(title: str, *parts: str) -> str:
    """Return a whole page."""
    version = import_module("sbi_rope").__version__
    head = [
        "<!DOCTYPE html>",
        '<html lang="en">',
        "<head>",
        '<meta charset="utf-8">',
        f'{GENERATOR} {version}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{_text(title)}</title>",
        f"<style>{STYLE}</style>",
        "</head>",
        "<body>",
        f"<h1>{_text(title)}</h1>",
    ]
    return "\n".join([*head, *parts, "</body>", "</html>", ""])


def write_page(path: Path, text: str) -> None:
    """Write a page, and replace no file but another page of this package."""
    if path.exists() and not (path.is_file() and GENERATOR.encode() in _start(path)):
        raise InvalidInputError(
            "Expected `path` to be a new file or an earlier report, which is replaced; "
            f"got {path}."
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _start(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(1000)


def number(value: float, *, sign: bool = False, digits: int = 2) -> str:
    """Return a number with a true minus sign, or "unknown" for NaN."""
    if math.isnan(value):
        return "unknown"
    text = f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}").replace("inf", "infinite")


def percent(share: float) -> str:
    """Return a share in per cent, "below 1 %" included."""
    if 0 < share < 0.005:
        return "<1 %"
    return f"{100 * share:.0f} %"


def _text(text: str) -> str:
    """Return text for a page; a number and its per cent sign stay on one line."""
    return escape(text).replace(" %", "&nbsp;%")


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""

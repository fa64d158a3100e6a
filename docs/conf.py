"""How Sphinx builds the documentation site; ``make docs`` runs it."""

import os
import re
import typing
from pathlib import Path
from unittest.mock import patch

from sphinx.application import Sphinx


class WithoutRange:
    """Stands for ``Annotated``: pages show a setting as `float`, and say its range."""

    def __class_getitem__(cls, hint: tuple[type, object]) -> type:
        return hint[0]


with patch.object(typing, "Annotated", WithoutRange):
    import sbi_rope
    import sbi_rope.baselines
    import sbi_rope.tasks

DOCS = Path(__file__).parent
ROOT = DOCS.parent
# GitHub sets these two where the site is published.
SERVER = os.environ.get("GITHUB_SERVER_URL", "https://github.com")
REPOSITORY = os.environ.get("GITHUB_REPOSITORY")

project = "sbi_rope"
author = copyright = "The sbi_rope developers"
version = release = sbi_rope.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
exclude_patterns = ["_build", "**/sbi-logs"]

# References inside the package are checked. The inventories of other packages would
# need the network at every build.
nitpicky = True
OTHERS = r"(abc|collections|numpy|os|pathlib|sbi|torch)\..*|Figure|DirectPosterior"
# Modules inside of rooms, and rooms that are not on the pages.
INSIDE = r"sbi_rope\.(_.*|[a-z_]+\.[a-z_]+\..*|(data|ensemble|labels|simulate)\..*)"
nitpick_ignore_regex = [("py:.*", f"{OTHERS}|{INSIDE}")]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

nb_execution_mode = "cache"
nb_execution_timeout = 3600
nb_execution_raise_on_error = True
# Warnings of other packages name folders of the machine that built the site.
nb_output_stderr = "remove"

autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
# What sbi documents is not said again.
autodoc_inherit_docstrings = False
napoleon_use_ivar = True
python_use_unqualified_type_names = True
toc_object_entries_show_parents = "hide"

copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True

# Publishers refuse programs, and GitHub makes its anchors in the browser.
linkcheck_ignore = [r"https://doi\.org/.*"]
linkcheck_anchors_ignore_for_url = [r"https://github\.com/.*"]

html_theme = "sphinx_book_theme"
html_title = "sbi_rope"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_theme_options = {
    "show_toc_level": 2,
    "use_download_button": False,
    "navbar_persistent": [],  # the search is in the sidebar
}
if REPOSITORY:
    html_theme_options |= {
        "repository_url": f"{SERVER}/{REPOSITORY}",
        "use_repository_button": True,
        "use_issues_button": True,
    }


def link_to_repository(app: Sphinx, docname: str, source: list[str]) -> None:
    """Let links to files outside of ``docs`` lead to the repository.

    On GitHub they work as they are written. Where no repository is known, as on a
    developer's machine, Sphinx copies the file and links to the copy.
    """
    here = Path(app.env.doc2path(docname)).parent

    def rewritten(match: re.Match[str]) -> str:
        path, anchor = match["path"], match["anchor"] or ""
        target = (here / path).resolve()
        if not target.exists() or target.is_relative_to(DOCS):
            return match[0]
        if not REPOSITORY:
            return f"](path:{path})"
        file = target.relative_to(ROOT).as_posix()
        return f"]({SERVER}/{REPOSITORY}/blob/main/{file}{anchor})"

    # Pictures, which begin with an exclamation mark, are copied by Sphinx.
    link = r"(?<!\.png)\]\((?P<path>\.\./[^)#\s]+(?<!\.png))(?P<anchor>#[^)\s]*)?\)"
    source[0] = re.sub(link, rewritten, source[0])


def setup(app: Sphinx) -> None:
    """Register what is done to the sources."""
    app.connect("source-read", link_to_repository)

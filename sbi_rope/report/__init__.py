"""Reports as HTML pages that can be sent: they need no other file and no network."""

from sbi_rope.report.html import write_html

__all__ = ["write_html"]

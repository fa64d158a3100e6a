"""Reports as files that can be sent: HTML pages that need nothing else."""

from sbi_rope.reports.stacking import write_stacking_report

__all__ = ["write_stacking_report"]

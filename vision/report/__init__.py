"""report.html: one page that holds everything about a run and needs no network."""

from vision.report.page import write_report

__all__ = ["write_report"]

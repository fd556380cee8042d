"""report.html: what a run, or a suite of runs, came to, on one page that opens from disk, without network."""

from .run import REPORT, write
from .suite import write_suite

__all__ = ["REPORT", "write", "write_suite"]

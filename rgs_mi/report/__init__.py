"""What a run, or a suite of runs, came to: pages that open from disk, without network, tables and pictures."""

from .run import REPORT, write
from .suite import write_suite

__all__ = ["REPORT", "write", "write_suite"]

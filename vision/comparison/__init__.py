"""Compare several finished tests: one table, a joint μ, the collapse, the trends."""

from vision.comparison.comparison import Comparison, compare, write_comparison
from vision.comparison.joint import CompareSettings
from vision.comparison.runs import read_tests

__all__ = ["CompareSettings", "Comparison", "compare", "read_tests", "write_comparison"]

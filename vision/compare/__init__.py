"""Several finished tests side by side: one table, one μ, the collapse, the trends."""

from vision.compare.comparison import Comparison, compare
from vision.compare.joint import CompareSettings
from vision.compare.tests import read_tests

__all__ = ["CompareSettings", "Comparison", "compare", "read_tests"]

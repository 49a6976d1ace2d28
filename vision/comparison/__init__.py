"""Compare several finished tests: one table, a joint μ, the collapse, deformation and shells, the trends."""

from vision.comparison.comparison import Comparison, compare, write_comparison
from vision.comparison.joint import CompareSettings

__all__ = ["CompareSettings", "Comparison", "compare", "write_comparison"]

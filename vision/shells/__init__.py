"""Which sheets are stiff, and the size of the stiff inner shell of each side in each stick phase."""

from vision.shells.classify import classify_shells, with_model
from vision.shells.judge import deformation_table, judge_sheets

__all__ = ["classify_shells", "deformation_table", "judge_sheets", "with_model"]

"""Which sheets are stiff, and the size of the stiff inner shell of each side in each stick phase."""

from vision.shells.shells import (
    ShellSettings,
    classify_sheets,
    classify_shells,
    deformation_table,
    with_model,
)

__all__ = ["ShellSettings", "classify_sheets", "classify_shells", "deformation_table", "with_model"]

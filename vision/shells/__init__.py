"""Classification of sheets as stiff or mobile, and the size of the stiff shell of each side."""

from vision.shells.shells import (
    ShellSettings,
    classify_sheets,
    classify_shells,
    deformation_table,
    with_model,
)

__all__ = ["ShellSettings", "classify_sheets", "classify_shells", "deformation_table", "with_model"]

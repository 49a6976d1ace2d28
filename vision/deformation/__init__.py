"""Horizontal deformation of each sheet in each stick phase: δx, σ_x, σ_x/Λ_st."""

from vision.deformation.motion import horizontal_deformation
from vision.deformation.settings import DeformationSettings

__all__ = ["DeformationSettings", "horizontal_deformation"]

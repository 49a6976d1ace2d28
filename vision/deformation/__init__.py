"""Horizontal deformation of each sheet in each stick phase: δx, σ_x, σ_x/Λ_st."""

from vision.deformation.creep import DeformationSettings
from vision.deformation.motion import horizontal_deformation

__all__ = ["DeformationSettings", "horizontal_deformation"]

"""How far each sheet moves sideways in each stick phase: δx, σ_x, σ_x/Λ_st."""

from vision.deformation.motion import VideoClock, horizontal_deformation
from vision.deformation.single_stick import stick_displacement

__all__ = ["VideoClock", "horizontal_deformation", "stick_displacement"]

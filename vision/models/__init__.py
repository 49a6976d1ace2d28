"""Equations of the publication and fits of them to recordings."""

from vision.models.fits import fit_models
from vision.models.single_fits import Estimate, ModelFits

__all__ = ["Estimate", "ModelFits", "fit_models"]

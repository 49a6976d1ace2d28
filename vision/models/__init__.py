"""Equations of the publication and fits of them to recordings."""

from vision.models.fits import fit_models
from vision.models.single_fits import Estimate, FitSettings, ModelFits, both_errors, plus_minus

__all__ = ["Estimate", "FitSettings", "ModelFits", "both_errors", "fit_models", "plus_minus"]

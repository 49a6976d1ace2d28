"""The equations of the paper, and the fits to them."""

from vision.models.fits import Estimate, Goodness, ModelFits, fit_models

__all__ = ["Estimate", "Goodness", "ModelFits", "fit_models"]

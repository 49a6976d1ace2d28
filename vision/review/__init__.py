"""The run in a browser: look at it, correct it, keep it."""

from vision.review.session import Session

__all__ = ["Session"]

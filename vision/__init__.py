"""From a video of interleaved sheets to x(n,t)."""

__version__ = "0.1.0"

"""The run in a browser: look at it, correct it, keep it."""

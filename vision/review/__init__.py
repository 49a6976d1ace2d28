"""The run in a browser: see it, correct it, save it."""

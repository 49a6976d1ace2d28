"""Review a run in a browser: look at it, correct it, save it."""

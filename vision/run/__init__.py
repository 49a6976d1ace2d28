"""The run folder: written, read back, exported."""

"""The run folder: all of it or none, with where everything came from."""

"""`track` and its subcommands: arguments in, calls of the packages above, files out."""

from vision.command.main import main

__all__ = ["main"]

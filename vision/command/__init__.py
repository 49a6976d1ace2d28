"""`track` and its subcommands: arguments in, calls of the rooms above, files out."""

from vision.command.main import main

__all__ = ["main"]

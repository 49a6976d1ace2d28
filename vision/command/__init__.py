"""`track` and its subcommands: arguments in, calls of the packages above, files out."""

import sys


def main() -> None:
    """Run the command line and exit with its status, also if it is interrupted while it is imported."""
    try:
        from vision.command.main import main as run_command
    except KeyboardInterrupt:
        sys.stderr.write("track: interrupted; nothing was begun\n")
        sys.exit(130)
    run_command()

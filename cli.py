"""Run `track` from a checkout: python cli.py VIDEO."""

import sys

# Behind the libraries, so that a file beside this one is never taken for one of theirs.
if not sys.flags.safe_path:  # with -P it is not there, and the first is another
    sys.path.append(sys.path.pop(0))

from vision.command import main

main()

"""Run `track` from a checkout: python cli.py VIDEO."""

from vision.command import main

main()

"""`python -m vision.command`: `track`, also where its script is not on the path of a cluster's node."""

from vision.command import main

main()

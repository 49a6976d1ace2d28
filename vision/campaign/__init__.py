"""Track many films, here or on a cluster: read a table, plan the jobs, run them, compare the results."""

from vision.campaign.results import open_tables

__all__ = ["open_tables"]

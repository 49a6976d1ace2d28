"""Track many films, here or on a cluster: read a table, plan the jobs, run them, compare the results."""

from vision.campaign.films import CampaignSettings
from vision.campaign.plan import Plan, PlannedFilm, State, make_plan, read_plan
from vision.campaign.results import open_tables

__all__ = ["CampaignSettings", "Plan", "PlannedFilm", "State", "make_plan", "open_tables", "read_plan"]

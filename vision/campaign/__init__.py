"""Many films, here or on a cluster: a table becomes a plan, Snakemake its jobs, the runs a pool."""

from vision.campaign.plan import Plan, PlannedFilm, State, make_plan, read_plan
from vision.campaign.results import open_tables
from vision.campaign.settings import CampaignSettings

__all__ = ["CampaignSettings", "Plan", "PlannedFilm", "State", "make_plan", "open_tables", "read_plan"]

"""Many films, here or on a cluster: a table becomes a plan, Snakemake its jobs, the runs a pool."""

from vision.campaign.plan import Plan, PlannedFilm, make_plan, read_plan
from vision.campaign.settings import CampaignSettings
from vision.campaign.states import State
from vision.campaign.tables import open_tables

__all__ = ["CampaignSettings", "Plan", "PlannedFilm", "State", "make_plan", "open_tables", "read_plan"]

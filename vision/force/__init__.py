"""A testing machine's recording becomes stick-slip events."""

from vision.force.events import find_stick_slip
from vision.force.recording import good_samples, parse_columns, read_force
from vision.force.settings import ForceSettings

__all__ = ["ForceSettings", "find_stick_slip", "good_samples", "parse_columns", "read_force"]

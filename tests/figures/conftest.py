"""What several tests of figures look at."""

import pytest

from tests.scenes.report_data import make_tracks, sawtooth

JUMP_PX = 4.0


@pytest.fixture(scope="module")
def tracks():
    """Ten sheets that open by `JUMP_PX` and close again, a thousand frames."""
    return make_tracks(sawtooth(1000, 10, jump_px=JUMP_PX))


def by_label(figure):
    """The series of a figure's panel by their labels."""
    return {series.label: series for series in figure.panel.series}

"""Settings reach what they are for, and none is there for nothing."""

import re
from dataclasses import FrozenInstanceError, fields
from pathlib import Path

import numpy as np
import pytest

import vision.sheets
from tests.scenes.combs import comb, ridges, strip
from vision.data import operations_of
from vision.sheets import TrackingSettings, track_sheets

SOURCE = "\n".join(
    path.read_text(encoding="utf-8")
    for path in Path(vision.sheets.__file__).parent.glob("*.py")
    if path.name != "settings.py"
)


def picture():
    contrast = np.where(np.arange(16) == 4, 0.3, 1.0)
    return strip(ridges(comb(60, per_side=8, axis_px=260, slip=0.4), width=520, contrast=contrast))


@pytest.mark.parametrize("name", [field.name for field in fields(TrackingSettings)])
def test_every_setting_is_used(name):
    """A failure means that somebody turns a knob that is connected to nothing."""
    assert re.search(rf"\b(settings|costs)\.{name}\b", SOURCE)


def test_settings_are_taken_over_and_recorded():
    """A failure means that `settings` stops somewhere on the way, or that nobody can tell what was used."""
    usual = track_sheets(picture())
    assert (usual["flag"] == "ok").all() and usual.sizes["sheet"] == 16
    strict = TrackingSettings(doubt=1e6)
    doubted = track_sheets(picture(), settings=strict)
    assert (doubted["flag"] == "doubtful").any()
    assert operations_of(doubted)[-1]["parameters"]["settings"]["doubt"] == 1e6
    blind = track_sheets(picture(), settings=TrackingSettings(faint_fraction=0.5, faint_contrast=10.0))
    assert blind.sizes["sheet"] == 15
    wide = track_sheets(picture(), settings=TrackingSettings(standard_window_px=11))
    assert wide.attrs["window_px"] == 11


def test_settings_cannot_be_changed_behind_the_back():
    """A failure means that one run's settings change another's."""
    with pytest.raises(FrozenInstanceError):
        TrackingSettings().doubt = 1.0

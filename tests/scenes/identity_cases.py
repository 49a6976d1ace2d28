"""Recordings on which sheets are easily mistaken for each other, each with its truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from tests.scenes.combs import comb, ridges, strip
from vision.numeric import Bools, Floats

FRAMES = 300


@dataclass(frozen=True)
class Case:
    """One recording.

    truth_px is where every sheet is (frame, N), seen or not; seen, where it is drawn inside the picture;
    least_found, the fraction of those that must have a position.
    """

    truth_px: Floats
    picture: xr.DataArray
    pitch_px: float = 20.0
    seen: Bools | None = None
    least_found: float = 0.995
    sheets: int | None = None

    @property
    def visible(self) -> Bools:
        """Sheets drawn and at least half a pitch away from the border."""
        width = self.picture.sizes["x"]
        inside = (self.truth_px > self.pitch_px / 2) & (self.truth_px < width - 1 - self.pitch_px / 2)
        return inside if self.seen is None else inside & self.seen


CASES: dict[str, Callable[[], Case]] = {}


def case(name: str) -> Callable[[Callable[[], Case]], Callable[[], Case]]:
    """Register a recording under a name."""

    def register(make: Callable[[], Case]) -> Callable[[], Case]:
        CASES[name] = make
        return make

    return register


def brightness(sheets: int = 50, seed: int = 5) -> Floats:
    """Contrasts as sheets have them: 15 % scatter."""
    return np.asarray(np.clip(1 + 0.15 * np.random.default_rng(seed).normal(size=sheets), 0.5, 1.5))


def jumps(*pitches: float, pitch_px: float = 20.0, every: int = 30, frames: int = FRAMES) -> Floats:
    """Displacement (frame, 1) of a whole comb that jumps by these pitches in turn, between two frames."""
    step = np.zeros(frames)
    at = np.arange(every, frames, every)
    step[at] = np.resize(pitches, len(at))
    return np.asarray(np.cumsum(step)[:, None] * pitch_px)


# slips

for _slip in (0.3, 0.6, 0.85):
    for _fwhm in (3.0, 7.0, 12.0):

        @case(f"slip {_slip} pitch, {_fwhm:.0f} px wide")
        def _(slip: float = _slip, fwhm: float = _fwhm) -> Case:
            x = comb(FRAMES, slip=slip)
            return Case(x, strip(ridges(x, fwhm_px=fwhm, contrast=brightness())))


@case("slip 0.85 pitch, equal brightness")
def _() -> Case:
    x = comb(FRAMES, slip=0.85)
    return Case(x, strip(ridges(x)))


@case("slip 0.85 pitch, uneven pitch 20 %")
def _() -> Case:
    x = comb(FRAMES, slip=0.85, uneven=0.1)
    return Case(x, strip(ridges(x, contrast=brightness())))


@case("uneven pitch ±20 %, equal brightness")
def _() -> Case:
    x = comb(FRAMES, slip=0.4, uneven=0.2)
    return Case(x, strip(ridges(x)))


@case("slips every 2 to 3 frames")
def _() -> Case:
    x = comb(FRAMES, slip=0.85, period=2.5)
    return Case(x, strip(ridges(x, contrast=brightness())))


@case("avalanche from the outside in, sheet by sheet")
def _() -> Case:
    late = 24.5 - np.abs(np.arange(50) - 24.5)  # outer sheets first, one frame each
    time = np.arange(FRAMES)[:, None] - np.round(late)
    side, n = np.sign(np.arange(50) - 24.5), np.abs(np.arange(50) - 24.5) + 0.5
    phase = (time / 50.0) % 1 - 0.5
    x = 600 + side * (n - 0.5) * 20 - side * 0.6 * 20 * (n / 25) ** 2.3 * phase
    return Case(x, strip(ridges(x, contrast=brightness())))


@case("sheets slip one by one at random")
def _() -> Case:
    shift = np.random.default_rng(8).uniform(0, 25, 50)
    side, n = np.sign(np.arange(50) - 24.5), np.abs(np.arange(50) - 24.5) + 0.5
    phase = ((np.arange(FRAMES)[:, None] + shift) / 25.0) % 1 - 0.5
    x = 600 + side * (n - 0.5) * 20 - side * 0.3 * 20 * (n / 25) ** 2.3 * phase
    return Case(x, strip(ridges(x, contrast=brightness())))


# the whole comb

for _pitches in (
    (0.5, -0.5),
    (1.0, -1.0),
    (1.5, -1.5),
    (2.0, -2.0),
    (2.0, 1.0, -2.0, -1.0),
    (-1.7, 0.9, 0.8),
):
    for _equal in (False, True):

        @case(f"whole comb jumps by {_pitches} pitches" + (", equal brightness" if _equal else ""))
        def _(pitches: tuple[float, ...] = _pitches, equal: bool = _equal) -> Case:
            x = comb(FRAMES, slip=0.4, axis_px=620) + jumps(*pitches)
            return Case(x, strip(ridges(x, width=1300, contrast=1.0 if equal else brightness())))


@case("jump of two pitches and slip of 0.85 at once, faint sheets")
def _() -> Case:
    x = comb(FRAMES, slip=0.85, axis_px=620, period=30) + jumps(2, -2)
    level = brightness()
    level[[0, 5, 20, 49]] *= 0.2
    return Case(x, strip(ridges(x, width=1300, contrast=level)))


@case("sheets come in and go out at the edges")
def _() -> Case:
    x = comb(FRAMES, slip=0.4, axis_px=480) + np.linspace(-30, 30, FRAMES)[:, None]
    return Case(x, strip(ridges(x, width=960, contrast=brightness())), least_found=0.98)


@case("drift of two pitches")
def _() -> Case:
    x = comb(FRAMES, slip=0.6) + np.linspace(-20, 20, FRAMES)[:, None]
    return Case(x, strip(ridges(x)))


@case("comb comes in from outside the picture")
def _() -> Case:
    x = comb(200, per_side=12, axis_px=290, slip=0.4) + np.maximum(0, 500 - 4.0 * np.arange(200))[:, None]
    return Case(x, strip(ridges(x, width=580, contrast=brightness(24)), snr=80), least_found=0.97)


@case("sheets leave the picture and come back")
def _() -> Case:
    x = comb(FRAMES, per_side=14, axis_px=300, slip=0.4)
    x += 70 * np.sin(np.linspace(0, 2 * np.pi, FRAMES))[:, None]
    return Case(x, strip(ridges(x, width=600, contrast=brightness(28))), least_found=0.99)


@case("pitch grows twofold along the comb")
def _() -> Case:
    u = np.linspace(-1, 1, 31)
    x = 330 + np.cumsum(13 + 7 * (u + 1)) - 310
    x = x - 8 * np.sign(u) * np.abs(u) ** 2.3 * ((np.arange(FRAMES) / 25) % 1 - 0.5)[:, None]
    return Case(x, strip(ridges(x, width=700, fwhm_px=6, contrast=brightness(31))), pitch_px=13)


@case("camera shakes by a pitch from frame to frame")
def _() -> Case:
    x = comb(FRAMES, per_side=12, axis_px=300, slip=0.4)
    x += np.random.default_rng(4).uniform(-20, 20, (FRAMES, 1))
    return Case(x, strip(ridges(x, width=600, contrast=brightness(24))), least_found=0.97)


for _back in (False, True):

    @case("four slips squeeze the comb to half its spacing" + (" and two open it" if _back else ""))
    def _(back: bool = _back) -> Case:
        step = np.zeros(FRAMES)
        step[40:200:40] = -0.125
        step[[210, 250]] = 0.2 * back
        x = 650 + (1 + np.cumsum(step)[:, None]) * (comb(FRAMES, axis_px=0, uneven=0.1, slip=0.2) * 1.2)
        return Case(x, strip(ridges(x, width=1300, fwhm_px=5, contrast=brightness())), pitch_px=12)


# light


@case("a light moves along the comb and the sheets' brightness changes")
def _() -> Case:
    x, t = comb(200, per_side=13, axis_px=310, slip=0.6), np.arange(200)[:, None] / 200
    height = brightness(26, 91) * (1 - t) + brightness(26, 92) * t
    height = height * (0.4 + np.exp(-(((x - 100 - 400 * t) / 150) ** 2)))
    return Case(x, strip(ridges(x, width=620, contrast=height), snr=80), least_found=0.85)


@case("two hands, one from either side")
def _() -> Case:
    x, t = comb(200, per_side=13, axis_px=300, slip=0.5), np.arange(200)[:, None]
    column, reach = np.arange(600), 140 * np.maximum(0, np.sin(np.stack([t / 11, t / 17 + 2])))
    left, right = 20 + reach[0], 580 - reach[1]
    light = np.where((column < left) | (column > right), -0.5, ridges(x, width=600, contrast=brightness(26)))
    seen = (x > left + 8) & (x < right - 8)
    return Case(x, strip(light, snr=80), seen=seen, least_found=0.95)


@case("flicker, vibration and drift at SNR 40")
def _() -> Case:
    rng, t = np.random.default_rng(2), np.arange(FRAMES)[:, None]
    x = comb(FRAMES, slip=0.6) + rng.normal(0, 0.05, (FRAMES, 1)) + t / FRAMES / 2
    light = (ridges(x, contrast=brightness()) + 0.7) * (1 + 0.03 * np.sin(2.1 * t)) - 0.7
    return Case(x, strip(light, snr=40))


@case("light falls off by 20 %")
def _() -> Case:
    x = comb(FRAMES, slip=0.6)
    fall = np.linspace(1.1, 0.9, 1200)
    return Case(x, strip((ridges(x, contrast=brightness()) + 0.7) * fall - 0.7))


for _snr in (10, 20):

    @case(f"SNR {_snr}")
    def _(snr: int = _snr) -> Case:
        x = comb(FRAMES, slip=0.6)
        return Case(x, strip(ridges(x, contrast=brightness()), snr=snr), least_found=0.98)


@case("dark ridges")
def _() -> Case:
    x = comb(FRAMES, slip=0.85)
    return Case(x, strip(ridges(x, contrast=brightness()), sign=-1))


# what disturbs


def _faint() -> Floats:
    level = brightness()
    level[[0, 5, 20, 21, 49]] = 0.2
    return level


@case("faint sheets")
def _() -> Case:
    x = comb(FRAMES, slip=0.6)
    return Case(x, strip(ridges(x, contrast=_faint())))


@case("sheets unseen for 40 frames")
def _() -> Case:
    x = comb(FRAMES, slip=0.85)
    seen = np.ones(x.shape, bool)
    rng = np.random.default_rng(6)
    for start, sheet in zip(rng.integers(0, FRAMES - 40, 20), rng.integers(0, 50, 20), strict=True):
        seen[start : start + 40, sheet] = False
    return Case(x, strip(ridges(np.where(seen, x, np.nan), contrast=_faint())), seen=seen)


def _dust(places: Floats, heights: Floats, *, width_px: float = 5.0) -> Floats:
    return ridges(places, fwhm_px=width_px, contrast=heights)


@case("dust on the sensor")
def _() -> Case:
    x = comb(FRAMES, slip=0.6)
    rng = np.random.default_rng(7)
    place = np.broadcast_to(rng.uniform(60, 1140, 10), (FRAMES, 10))
    light = ridges(x, contrast=brightness()) + _dust(place, rng.uniform(0.15, 0.7, 10))
    return Case(x, strip(light), least_found=0.97)


@case("dust on the sensor beside a faint sheet")
def _() -> Case:
    x = comb(FRAMES, slip=0.6)
    level = brightness()
    level[4] = 0.2
    grain = np.full((FRAMES, 1), float(np.median(x[:, 4])) + 10)
    light = ridges(x, contrast=level) + _dust(grain, np.array([0.4]))
    return Case(x, strip(light), least_found=0.98)


@case("dust that travels with the paper")
def _() -> Case:
    x = comb(FRAMES, slip=0.6)
    rng = np.random.default_rng(9)
    sheet = np.array([3, 12, 24, 33, 45])
    place = x[:, sheet] + 0.5 * 20
    light = ridges(x, contrast=brightness()) + _dust(place, rng.uniform(0.2, 0.5, 5))
    return Case(x, strip(light), least_found=0.97)


@case("dust that comes and goes")
def _() -> Case:
    x = comb(FRAMES, slip=0.6)
    rng = np.random.default_rng(10)
    place = np.where(rng.random((FRAMES, 30)) < 0.1, rng.uniform(60, 1140, 30), np.nan)
    light = ridges(x, contrast=brightness()) + _dust(place, rng.uniform(0.2, 1.0, 30))
    return Case(x, strip(light), least_found=0.97)


@case("frames without a picture")
def _() -> Case:
    x = comb(FRAMES, slip=0.85)
    status = np.full(FRAMES, "ok", "<U8")
    status[[0, 50, 51, 120]] = "blank"
    status[200:210] = "corrupt"
    light = ridges(x, contrast=brightness())
    light[status == "corrupt"] = np.nan
    light[status == "blank"] = 0
    seen = np.broadcast_to((status == "ok")[:, None], x.shape)
    return Case(x, strip(light, status=status), seen=seen)


@case("black frames nobody has marked")
def _() -> Case:
    x = comb(FRAMES, slip=0.85)
    light = ridges(x, contrast=brightness())
    seen = np.ones(x.shape, bool)
    for dark in (0, 77, 78, 79, 299):
        light[dark], seen[dark] = 0, False
    return Case(x, strip(light), seen=seen)


# combs of other kinds

for _count in (1, 2, 3, 7):

    @case(f"{_count} sheets")
    def _(count: int = _count) -> Case:
        x = comb(FRAMES, per_side=4, pitch_px=40, axis_px=300, slip=0.6)[:, 4 - count // 2 :][:, :count]
        return Case(x, strip(ridges(x, width=600, fwhm_px=10)), pitch_px=40)


@case("200 sheets")
def _() -> Case:
    x = comb(120, per_side=100, pitch_px=9, axis_px=960, slip=0.6)
    light = ridges(x, width=1920, fwhm_px=4, contrast=brightness(200))
    return Case(x, strip(light), pitch_px=9)


@case("30 px wide")
def _() -> Case:
    x = comb(FRAMES, per_side=8, pitch_px=60, slip=0.85)
    return Case(x, strip(ridges(x, flat_px=30, fwhm_px=8, contrast=brightness(16))), pitch_px=60)


@case("pitch 7 px")
def _() -> Case:
    x = comb(FRAMES, pitch_px=7, axis_px=250, slip=0.85)
    return Case(x, strip(ridges(x, width=500, fwhm_px=3.5, contrast=brightness())), pitch_px=7)


@case("one side in view")
def _() -> Case:
    x = comb(FRAMES, slip=0.85)[:, 25:]
    return Case(x, strip(ridges(x, contrast=brightness(25))))


@case("odd number of sheets")
def _() -> Case:
    x = comb(FRAMES, slip=0.6)[:, 3:]
    return Case(x, strip(ridges(x, contrast=brightness(47))))

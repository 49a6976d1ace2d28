"""How many sheets are stiff: every rising profile is weighed by how well it fits, then sheets are counted.

Each sheet's true ratio is taken to scatter about a rising profile, and its measurement about the true
ratio.  Where noise is small, the sheet's own measurement decides; where it is large, its neighbours do.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vision.numeric import Bools, Floats, Floats32, Ints
from vision.shells.profile import Side, isotonic

_SCATTERS = (0.03, 0.08, 0.15, 0.25)  # of sheets about the profile, relative; the likeliest is taken
_SMALL = 0.3  # thresholds; smaller ratios are taken to scatter as if they were this large
_UNLIKE = 0.2  # real profiles differ from those tried by so much of their distance from the threshold,
_FARTHER = 0.5  # and by more, the farther off they are: sheets near the threshold lead
_STRANGE = 4.0  # standard deviations from the profile beyond which a sheet is left to itself
_MOST_STRANGE = 4  # such sheets a side and event
_ASKED = 40  # events from which the scatter is found
_DRAWS = 256
_MISREAD = 5  # in one draw of so many, strange sheets were misread and follow the profile after all
_SOME_DRAWS = np.arange(_DRAWS) % _MISREAD == 0
_FOOT = np.geomspace(0.6, 30, 7)  # sheets from where the rise sets in to the boundary
_BEND = (0.6, 1.4, 4.0)  # exponent of the rise: concave, nearly straight, steeper and steeper
_FLOOR = (0.0, 0.3, 0.7)  # ratio of the innermost sheets, in thresholds
_CEILING = (1.5, 2.5, 5.0, 1e4)  # ratio at which the rise ends, in thresholds
_MOST = 30.0  # thresholds; the sheets do not move more than this
_INSIDE, _OUTSIDE = 3.0, 6.0  # sheets beyond the innermost and outermost where a boundary may lie
_THINNING = 5  # divides no number of feet, bends, floors or ceilings, so that all kinds remain
_MOST_PLACES = 120  # of the boundary; half a sheet apart where sheets are not very many
_BLOCK = 32  # events at a time, which keeps the tables of likelihoods small


@dataclass(frozen=True)
class _Profiles:
    """Curves that never fall with n, ratio (curve, sheet), ordered by how many sheets are below threshold.

    half_square: half the ratio's square.
    """

    ratio: Floats32
    half_square: Floats32

    @classmethod
    def crossing(cls, n: Floats, threshold: float) -> _Profiles:
        """Curves at n (sheet,), from the centre outwards, that cross the threshold t at a place b.

        t (c + (C - c) h/(1 + h)) with h ∝ max(1 + (n - b)/a, 0)^q: nothing moves up to b - a, then a power
        law, levelling off towards a ceiling.  Power laws through the centre (a = b, c = 0), flat cores with
        a straight rise (q = 1), steps (small a, low ceiling) and sigmoids are among them or near.  All b,
        from inside the innermost to beyond the outermost sheet, are equally frequent.
        """
        apart = max(0.5, (n[-1] - n[0]) / _MOST_PLACES)
        place = np.arange(n[0] - _INSIDE, n[-1] + _OUTSIDE, apart) + apart / 2
        every = np.meshgrid(place, _FOOT, _BEND, _FLOOR, _CEILING, indexing="ij")
        b, foot, bend, floor, ceiling = (part.reshape(-1, 1) for part in every)
        rise = (1 - floor) / (ceiling - 1) * np.maximum(1 + (n - b) / foot, 0) ** bend
        ratio = threshold * np.minimum(floor + (ceiling - floor) * rise / (1 + rise), _MOST)
        ratio = ratio[np.argsort((ratio < threshold).sum(axis=1), kind="stable")]
        return cls(ratio.astype(np.float32), (ratio**2 / 2).astype(np.float32))

    def thinned(self) -> _Profiles:
        """A fifth of the curves, of all kinds, for what needs no fine resolution."""
        return _Profiles(self.ratio[::_THINNING].copy(), self.half_square[::_THINNING].copy())


@dataclass(frozen=True)
class _Sheets:
    """What is known of the sheets of some events, (event, N): value 0 and variance inf where nothing is.

    usual: ratio from which the scatter is reckoned.  alone: sheets that do not follow the profile.
    """

    value: Floats
    variance: Floats
    usual: Floats
    alone: Bools
    threshold: float

    @classmethod
    def of(cls, side: Side, threshold: float) -> _Sheets:
        known = side.known
        return cls(
            np.where(known, side.value, 0.0),
            np.where(known, side.error**2, np.inf),
            np.maximum(np.nan_to_num(isotonic(side)[0]), 0.0),
            np.zeros_like(known),
            threshold,
        )

    def at(self, events: slice | Ints) -> _Sheets:
        return _Sheets(
            self.value[events],
            self.variance[events],
            self.usual[events],
            self.alone[events],
            self.threshold,
        )

    def about_profile(self, relative: float) -> Floats:
        """Variance of the measurements about the profile; inf for those that say nothing of it."""
        return np.where(self.alone, np.inf, self.variance + _scatter(self.usual, relative, self.threshold))


def _scatter(ratio: Floats, relative: float, threshold: float) -> Floats:
    """Variance of true ratios about profiles of this ratio, and of real profiles about those tried."""
    away = np.abs(ratio / threshold - 1)
    unlike = _UNLIKE * away * (1 + _FARTHER * away) * threshold
    return np.asarray((relative * np.maximum(ratio, _SMALL * threshold)) ** 2 + unlike**2)


def shell_sizes(side: Side, *, threshold: float, certainty: float) -> tuple[Ints, Ints, Ints]:
    """Stiff sheets of one side, (event,): the median, and the ends of the shortest interval at `certainty`.

    Sheets far off every rising profile are counted by their own measurement, though it is held possible
    that they were misread; so are all sheets of an event where the ratio falls with n beyond chance even
    when those are left out.  Stick lengths are varied by their error, for all sheets at once.
    """
    profiles = _Profiles.crossing(side.n, threshold)
    sheets = _Sheets.of(side, threshold)
    sheets = replace(sheets, alone=_strange(sheets, profiles.thinned()))
    relative = _likeliest_scatter(sheets, profiles.thinned())
    falls = ~isotonic(side.without(sheets.alone))[1]
    single = replace(sheets, alone=sheets.alone | (falls[:, None] & side.known))
    found = []
    for block in _blocks(len(falls)):
        share, _ = _weigh(profiles, sheets.at(block), relative)
        ratio = _draw_ratios(profiles, share, single.at(block), relative, misread=sheets.alone[block])
        found.append(_summary(_count(ratio, threshold, side.length_err[block]), certainty))
    size, low, high = np.concatenate(found, axis=1)
    return size, low, high


def _blocks(events: int) -> Iterator[slice]:
    return (slice(first, first + _BLOCK) for first in range(0, events, _BLOCK))


def _weigh(profiles: _Profiles, sheets: _Sheets, relative: float) -> tuple[Floats32, Floats]:
    """Share of each profile in each event, (event, curve), summing to 1, and the log evidence, (event,)."""
    weight = 1 / sheets.about_profile(relative)
    likely = (weight * sheets.value).astype(np.float32) @ profiles.ratio.T
    likely -= weight.astype(np.float32) @ profiles.half_square.T
    most = likely.max(axis=1, keepdims=True)
    share = np.exp(likely - most)
    total = share.sum(axis=1, keepdims=True)
    own = np.log(np.where(weight > 0, weight, 1.0)) - weight * sheets.value**2
    return share / total, (most + np.log(total))[:, 0] + own.sum(axis=1) / 2


def _strange(sheets: _Sheets, profiles: _Profiles) -> Bools:
    """Sheets off what the others say, (event, N), found one after the other, the farthest first."""
    alone = sheets.alone.copy()
    events = np.arange(len(alone))
    for _ in range(_MOST_STRANGE):
        rest = replace(sheets, alone=alone)
        off = np.concatenate([_off(profiles, rest.at(events[block])) for block in _blocks(events.size)])
        far = off.max(axis=1) > _STRANGE
        events, worst = events[far], off.argmax(axis=1)[far]
        alone[events, worst] = True
        if events.size == 0:
            break
    return alone


def _off(profiles: _Profiles, sheets: _Sheets) -> Floats:
    """Standard deviations by which each measurement is off the profile, 0 where none is compared."""
    share, _ = _weigh(profiles, sheets, _SCATTERS[-1])
    mean = share @ profiles.ratio
    spread = np.maximum(2 * share @ profiles.half_square - mean**2, 0)
    return np.asarray(np.abs(sheets.value - mean) / np.sqrt(sheets.about_profile(_SCATTERS[-1]) + spread))


def _likeliest_scatter(sheets: _Sheets, profiles: _Profiles) -> float:
    """The relative scatter of sheets about their profile under which all measurements are likeliest."""
    asked = sheets.at(slice(None, None, max(1, len(sheets.value) // _ASKED)))
    evidence = [_weigh(profiles, asked, relative)[1].sum() for relative in _SCATTERS]
    return _SCATTERS[int(np.argmax(evidence))]


def _draw_ratios(
    profiles: _Profiles, share: Floats32, sheets: _Sheets, relative: float, *, misread: Bools
) -> Floats:
    """True ratios that the data allow, (event, draw, N): profiles by their share, and sheets about them.

    The random numbers are always the same, so that a table comes out the same twice.
    """
    rng = np.random.default_rng(0)
    curve = profiles.ratio[_places(share)].astype(float)
    scatter = _scatter(curve, relative, sheets.threshold)
    # Between the profile and the measurement, either of which may say nothing (variance inf).
    certain = np.where(sheets.alone[:, None], 0.0, 1 / scatter) + 1 / sheets.variance[:, None]
    pull = 1 / sheets.variance[:, None] / certain
    ratio = curve + pull * (sheets.value[:, None] - curve)
    ratio += rng.standard_normal((_DRAWS, curve.shape[2])) / np.sqrt(certain)
    return np.asarray(np.where(misread[:, None] & _SOME_DRAWS[:, None], curve, ratio))


def _count(ratio: Floats, threshold: float, length_err: Floats) -> Ints:
    """Ratios below the threshold in each draw, (event, draw); stick lengths differ from draw to draw."""
    length = 1 + length_err[:, None] * np.random.default_rng(1).standard_normal(_DRAWS)
    return np.asarray((np.abs(ratio) < threshold * length[..., None]).sum(axis=2))


def _summary(sizes: Ints, certainty: float) -> Ints:
    """Median, and the ends of the shortest interval that holds `certainty` of the draws, (3, event)."""
    ordered = np.sort(sizes, axis=1)
    holding = int(np.ceil(certainty * _DRAWS))
    first = np.arange(_DRAWS - holding + 1)
    length = ordered[:, holding - 1 :] - ordered[:, first]
    # Of equally short ones, the most central.
    best = (length + np.abs(first - first.mean()) / _DRAWS).argmin(axis=1)
    event = np.arange(len(ordered))
    return np.stack([ordered[:, _DRAWS // 2], ordered[event, best], ordered[event, best + holding - 1]])


def _places(share: Floats32) -> Ints:
    """Curves drawn evenly by their share, (event, draw)."""
    events, curves = share.shape
    row = 2 * np.arange(events)[:, None]  # one search for all events: each has a stretch of its own
    reached = np.cumsum(share, axis=1, dtype=float)
    wanted = (np.arange(_DRAWS) + 0.5) / _DRAWS * reached[:, -1:]
    place = np.searchsorted((reached + row).ravel(), (wanted + row).ravel()) % curves
    return np.asarray(place.reshape(events, _DRAWS))

"""Which of all candidates are the sheets: the comb that the whole recording agrees on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from vision.errors import InputError
from vision.sheets.alignment import MISSING_COST, Candidates, Reference, align
from vision.sheets.choice import choose_sheets, sheet_worth
from vision.sheets.comb import Comb
from vision.sheets.medians import nan_median
from vision.sheets.segments import Segments

Doubles = NDArray[np.float64]
Ints = NDArray[np.int64]

ROUNDS = 4
SEGMENTS_ASKED = 384  # the longest, and others spread over the recording
PRESENT_INSIDE = 0.3  # share of the frames in which a candidate between sheets must be there to be a sheet
PRESENT_AT_EDGE = 0.04  # and one that may have come in or gone out at the edge of the comb
LEAST_COMB = 9  # ridges that make a comb to lie outside of
FAR_OUTSIDE = 2.6  # median spacings


@dataclass(frozen=True)
class Model:
    """The comb of sheets: resting positions, logarithms of contrast and width, share of frames found, all
    (N,).

    dropped: how many ridges were taken out of it.
    """

    x_px: Doubles
    log_contrast: Doubles
    log_width: Doubles
    found: Doubles
    dropped: int = 0

    @property
    def sheets(self) -> int:
        """Number of sheets."""
        return len(self.x_px)

    def only(self, kept: Ints) -> Model:
        """The comb of these entries."""
        fewer = self.dropped + self.sheets - len(kept)
        return Model(
            self.x_px[kept], self.log_contrast[kept], self.log_width[kept], self.found[kept], dropped=fewer
        )

    def reference(self, x_px: Doubles, comb: Comb, width_px: int, *, open_ended: bool = True) -> Reference:
        """This comb expected at x_px (lists, N)."""
        seldom = np.clip(-np.log(np.clip(1 - self.found, 1e-3, 1)), 1.0, MISSING_COST)
        half = comb.fwhm_px / 2
        inside = (half, width_px - 1 - half)
        return Reference(x_px, self.log_contrast, seldom, comb.pitch_px, inside, open_ended)


def build_model(segments: Segments, comb: Comb, *, width_px: int, sheets: int | None, source: str) -> Model:
    """The comb that most frames agree on, from the longest undisturbed segment outwards.

    All candidates of a seed segment are taken for sheets; segments from the whole recording are aligned
    with it; candidates that many frames show and the comb lacks are added, and those that few show are
    dropped; then what is too near to a brighter neighbour for the spacing of the comb, or lies far
    outside it, is dropped as dust. With `sheets` given, the most convincing such comb of that many.

    Raises: InputError where there is no candidate at all, or fewer ridges than `sheets`, not counting specks
    far outside the comb.
    """
    chosen = _representative(segments)
    candidates, weight = segments.candidates.take(chosen), segments.length[chosen].astype(np.float64)
    if not np.isfinite(candidates.x_px).any():
        raise InputError(
            source, "upright ridges", "none in any frame", "check --strip, --rotate and --ridges"
        )
    model = _seed(segments)
    for _ in range(ROUNDS):
        grown = _revise(model, candidates, weight, comb, width_px)
        settled = grown.sheets == model.sheets
        model = grown
        if settled:
            break
    if sheets is not None and model.sheets < sheets:
        raise InputError(
            source, f"{sheets} ridges (--sheets)", f"{model.sheets}", "give the number that is in view"
        )
    worth = sheet_worth(model.log_contrast, model.log_width, model.found)
    best = model.only(choose_sheets(model.x_px, worth, comb.pitch_px, sheets))
    if sheets is not None:
        _check_ends(best.x_px, sheets, source)
    return best


def _check_ends(x_px: Doubles, sheets: int, source: str) -> None:
    """A number of ridges that only specks far outside the comb make up is not believed."""
    if len(x_px) < LEAST_COMB:
        return
    spacing = np.diff(x_px)
    far = int((spacing[[0, -1]] > FAR_OUTSIDE * np.median(spacing)).sum())
    if far:
        raise InputError(
            source,
            f"{sheets} ridges (--sheets)",
            f"{sheets - far} and {far} far outside their comb",
            "give the number that is in view, or leave --sheets out",
        )


def _representative(segments: Segments) -> Ints:
    order = np.argsort(-segments.length, kind="stable")
    spread = np.linspace(0, len(order) - 1, SEGMENTS_ASKED // 2).astype(int)
    return np.asarray(np.unique(np.r_[order[: SEGMENTS_ASKED // 2], spread]), np.int64)


def _seed(segments: Segments) -> Model:
    """The longest segment of the commonest count (counted in frames)."""
    x = segments.candidates.x_px
    count = np.isfinite(x).sum(axis=1)
    frames = np.bincount(count, weights=segments.length)
    frames[0] = 0
    of_count = np.flatnonzero(count == np.argmax(frames))
    seed = of_count[np.argmax(segments.length[of_count])]
    real = np.isfinite(x[seed])
    own = segments.candidates
    return Model(x[seed][real], own.log_contrast[seed][real], own.log_width[seed][real], np.ones(real.sum()))


def _revise(model: Model, candidates: Candidates, weight: Doubles, comb: Comb, width_px: int) -> Model:
    """Add what many segments show and the comb lacks, drop what few show; positions and contrasts anew."""
    rest = np.broadcast_to(model.x_px, (len(weight), model.sheets))
    match = align(candidates, model.reference(rest, comb, width_px)).match
    tables = (candidates.x_px, candidates.log_contrast, candidates.log_width)
    x, log_contrast, log_width = (_of_match(values, match) for values in tables)
    moved = x - model.x_px
    found = np.where(np.isfinite(x), weight[:, None], 0).sum(axis=0) / weight.sum()
    rest_px = model.x_px + nan_median(moved - nan_median(moved, axis=1)[:, None])
    known = (rest_px, nan_median(log_contrast), nan_median(log_width), found)
    x_px, contrast, width, share = (
        np.concatenate(column)
        for column in zip(known, _strangers(model, candidates, match, weight), strict=True)
    )
    everything = Model(x_px, contrast, width, share)
    everything = everything.only(np.argsort(everything.x_px))
    share = everything.found
    keep = share >= np.where(_at_ends(share), PRESENT_AT_EDGE, PRESENT_INSIDE)
    return replace(everything.only(np.flatnonzero(keep)), dropped=0)


def _at_ends(share: Doubles) -> NDArray[np.bool_]:
    """Entries outside all those that are surely sheets."""
    sure = np.flatnonzero(share >= 0.5)
    number = np.arange(len(share))
    return (number < sure[0]) | (number > sure[-1]) if len(sure) else np.zeros(len(share), bool)


def _strangers(
    model: Model, candidates: Candidates, match: Ints, weight: Doubles
) -> tuple[Doubles, Doubles, Doubles, Doubles]:
    """Unpaired candidates by the place they have between the sheets: position, log contrast, log width,
    share.

    Place is the number of the next sheet to the left plus the fraction of the spacing; one stranger per
    interval and round is taken in, the one that most frames show.
    """
    x = candidates.x_px
    taken = np.zeros(x.shape, bool)
    rows, sheet = np.nonzero(match >= 0)
    taken[rows, match[rows, sheet]] = True
    list_, column = np.nonzero(np.isfinite(x) & ~taken)
    expected = _place(x[list_, column], _of_match(x, match)[list_], model.x_px)
    interval = np.searchsorted(model.x_px, expected)
    share = np.bincount(interval, weights=weight[list_], minlength=model.sheets + 1) / weight.sum()
    many = np.flatnonzero(share >= PRESENT_AT_EDGE)
    mine = [interval == i for i in many]
    position = np.array([np.median(expected[m]) for m in mine])
    contrast, width = (
        np.array([np.median(values[list_[m], column[m]]) for m in mine])
        for values in (candidates.log_contrast, candidates.log_width)
    )
    lists = np.array([weight[np.unique(list_[m])].sum() for m in mine]) / weight.sum()
    return position, contrast, width, lists


def _place(x: Doubles, sheet_x: Doubles, rest: Doubles) -> Doubles:
    """Positions x carried back to the rest frame with the displacement of the nearest sheet found,
    (points,)."""
    distance = np.where(np.isfinite(sheet_x), np.abs(sheet_x - x[:, None]), np.inf)
    nearest = np.argmin(distance, axis=1)
    shift = (sheet_x - rest)[np.arange(len(x)), nearest]
    return np.asarray(x - np.nan_to_num(shift), np.float64)


def _of_match(values: Doubles, match: Ints) -> Doubles:
    """Values of the candidates paired with each sheet, NaN where missing, (lists, N)."""
    return np.where(match >= 0, np.take_along_axis(values, np.maximum(match, 0), axis=1), np.nan)

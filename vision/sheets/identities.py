"""Identities: every sheet keeps its index through every slip, or its position is flagged as doubtful.

Frames are first joined to segments in which candidates can be followed without doubt. Then all segments are
aligned with one reference comb. No segment depends on the one before, so a mistake cannot spread. Last, where
the comb then seems to jump by whole pitches, the frames before and after must agree that it did.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from vision.memory import in_two_threads, row_parts, table_beside
from vision.numeric import (
    NORMAL_MEDIAN,
    Bools,
    Floats,
    Floats32,
    Ints,
    Ints32,
    common_change,
    median_step,
    nan_median,
    shifted,
    sigma_about_zero,
    typical_median,
    typical_rows,
    without_common_change,
)
from vision.sheets.alignment import Candidates, Pairing, align, values_of
from vision.sheets.reference import ReferenceComb, build_reference, faint_ends, motion_likeness, static_ridges
from vision.sheets.ridges import RidgeComb, Ridges
from vision.sheets.settings import LEAST_FRAMES, TrackingSettings
from vision.signals import running_median


class Doubt(IntEnum):
    """Why the identity of a ridge is doubtful; in one byte, as every sheet of every frame has one."""

    NONE, MARGIN, JUMP, PATTERN, EXCHANGE, NEIGHBOUR, HOP, ALONE, SPLIT = range(9)


WHYS = ("", *(doubt.name.lower() for doubt in Doubt if doubt))
"""Name of each `Doubt`."""
DOUBTS = {
    "margin": "another numbering fits nearly as well",
    "jump": "displaced by a jump that could be one of whole pitches",
    "pattern": "brightnesses and widths are those of other sheets",
    "exchange": "on the ridge that another sheet had in the frame before",
    "neighbour": "between a missing sheet and a ridge too many: numbered by a neighbour",
    "hop": "on another ridge, away from the position that the neighbours predict",
    "alone": "away from where the sheet was and will be, with no neighbour in view",
    "split": "narrower than before, beside a ridge too many: a half of a sheet that splits",
}
"""Meaning of each of `WHYS`."""
BLOCKS_AT_ONCE = 64  # of frames over which positions at rest are medians
SHIFTS = (-2, -1, 1, 2)  # alternative numberings, which must be excluded


@dataclass(frozen=True)
class Identities:
    """Which candidate is which sheet.

    match: candidate of each sheet in each frame, −1 where missing. margin: log-likelihood, nats, by which
    this identity exceeds the next best, NaN where missing. rest_px: rest position of each sheet around the
    time of the frame. usual_px: position of each sheet at the comb's usual spacing, NaN where missing; all
    (frame, N). reference: the reference comb.
    """

    match: Ints32
    margin: Floats
    rest_px: Floats
    usual_px: Floats32
    reference: ReferenceComb


def identify_sheets(
    ridges: Ridges, comb: RidgeComb, *, sheets: int | None = None, source: str = "the strip"
) -> Identities:
    """Pair the candidates of all frames with the sheets, of which there are `sheets` if that is known.

    Frames are joined to segments in which candidates cannot be confused, and a reference comb is found that
    most of the recording agrees on. All segments are aligned with that comb, and aligned again with each
    sheet expected where it was found around that time. All of this is done at the comb's usual spacing.

    Raises: InputError if there are no ridges, or fewer than `sheets`; the message names `source`.
    """
    scale, middle_px = comb_squeeze(ridges, comb.settings)
    if (scale != 1).any():
        usual = (middle_px + (ridges.x_px - middle_px) / scale).astype(np.float32)
        ridges = replace(ridges, x_px=usual)
    segments, displacement = split_segments(ridges, comb), comb_displacement(ridges, comb)
    reference = build_reference(
        segments.candidates,
        segments.length * np.isfinite(segments.candidates.x_px).any(axis=1),  # dark frames have no say
        displacement[segments.middle],
        comb,
        sheets=sheets,
        source=source,
    )

    def align_all(reference: ReferenceComb, rest: Floats, *, margins: bool = True) -> Pairing:
        expected = reference.expected(rest, comb, counted=sheets is not None)
        return align(segments.candidates, expected, margins=margins)

    rest = reference.x_px + displacement[segments.middle, None]
    match = segments.in_frames(align_all(reference, rest, margins=False).match, ridges.count)
    if sheets is None:
        moved = values_of(match, ridges.x_px).astype(np.float64)
        moved -= _rest_over_time(moved, reference, comb)
        real = ~static_ridges(moved, reference.x_px, settings=comb.settings)
        real &= ~faint_ends(reference, moved, settings=comb.settings)
        del moved
        reference, match = reference.only(np.flatnonzero(real)), match[:, real]
    for _ in range(2):  # with each sheet expected where it was found around that time
        rest = _rest_over_time(values_of(match, ridges.x_px), reference, comb)
        pairing = align_all(reference, rest[segments.middle])
        before, match = match, segments.in_frames(pairing.match, ridges.count)
        if np.array_equal(before, match):
            break
    margin = table_beside(ridges.x_px, match.shape)
    np.take(pairing.margin, segments.of_frames(), axis=0, out=margin, mode="clip")
    margin[match < 0] = np.nan
    match, margin = _undo_false_jumps(match, margin, values_of(match, ridges.x_px), ridges, comb)
    usual_px = values_of(match, ridges.x_px)
    if sheets is None:
        reference = replace(reference, beyond=_left_out_beyond(match, usual_px, ridges, comb))
    if (scale != 1).any():
        rest = middle_px + (rest - middle_px) * scale
    return Identities(match, margin, rest, usual_px, reference)


def _left_out_beyond(match: Ints32, x: Floats32, ridges: Ridges, comb: RidgeComb) -> int:
    """Return at how many ends of the comb a ridge is left out that may be a further sheet: it is often as
    near as the next sheet would be, and moves along with the last one, or this one moves too little to tell.
    One as bright as a sheet, away from the picture's edge, counts if it is seldom there: where a part of the
    comb slipped onto the place of the next sheets, it is one only before. x: positions of the sheets, px,
    (frame, N)."""
    settings, frame = comb.settings, np.arange(len(x))
    common, found, reach = common_change(x, typical_median(x)), 0, settings.edge_pitches * comb.pitch_px
    for end, step in ((0, -1), (-1, 1)):
        beside = match[:, end] + step
        known = (match[:, end] >= 0) & (beside >= 0) & (beside < ridges.count)
        other = np.where(known, ridges.x_px[frame, np.where(known, beside, 0)], np.nan)
        apart = np.abs(other - x[:, end]) / comb.pitch_px
        near = (apart > settings.nearest_beyond) & (apart < settings.wide_pitches)
        if not near.any():
            continue
        contrast = np.median(ridges.contrast[frame, np.where(known, beside, 0)][near])
        in_view = reach < np.median(other[near]) < comb.width_px - 1 - reach
        clear = in_view and contrast > settings.clear_beyond * comb.contrast
        if near.mean() < (settings.seldom_beyond if clear else settings.present_inside):
            continue
        other, last = (at[near] - common[near] for at in (other, x[:, end]))
        other, last = other - np.median(other), last - np.median(last)
        still = np.sqrt((last**2).mean()) < settings.moving_px / 2
        bright = contrast > settings.faint_contrast * comb.contrast
        found += bool(bright if still else motion_likeness(other, last) > settings.along_beyond)
    return found


def _rest_over_time(x_px: NDArray[np.floating], reference: ReferenceComb, comb: RidgeComb) -> Floats:
    """Return the median position of each sheet over about thirty frames, at every frame, (frame, N). Gaps are
    filled from neighbouring sheets, then from other times. Frames in which neighbours moved far apart, which
    no slip does, are left out."""
    frames = len(x_px)
    blocks = max(1, round(frames / comb.settings.frames_per_rest))
    edges = np.linspace(0, frames, blocks + 1).astype(int)
    size = int(np.diff(edges).max())
    index = np.minimum(edges[:-1, None] + np.arange(size), edges[1:, None] - 1)
    rest = np.empty((blocks, x_px.shape[1]))

    def find(part: slice) -> None:
        first, stop = edges[part.start], edges[part.stop]
        moved = x_px[first:stop] - reference.x_px
        moved[torn(moved, comb).any(axis=1)] = np.nan
        moved = moved[index[part] - first]
        rare = np.isfinite(moved).mean(axis=1) < 0.25
        rest[part] = np.where(rare, np.nan, nan_median(moved, axis=1))

    in_two_threads(find, row_parts(blocks, BLOCKS_AT_ONCE))
    rest = fill_rows(fill_rows(rest, reference.x_px).T, np.arange(blocks, dtype=np.float64)).T
    rest = reference.x_px + np.nan_to_num(rest)
    at = np.searchsorted(edges[1:], np.arange(frames), side="right")
    over_time = table_beside(x_px, x_px.shape)
    return np.take(rest, at, axis=0, out=over_time, mode="clip")


def torn(moved: Floats, comb: RidgeComb, spacing_px: Floats | float | None = None) -> Bools:
    """Return which sheets are displaced very differently from their neighbours in a frame, (frame, N).

    A slip moves neighbours alike, however far. Where the displacements `moved` of neighbours differ by more
    than `tear_fraction` pitches (or of `spacing_px`), one of the identities is wrong. Such tears divide the
    sheets of a frame into groups; this names all groups but the largest.
    """
    frames, sheets = moved.shape
    seen = np.isfinite(moved)
    before = np.hstack([np.full((frames, 1), np.nan), last_seen(moved)[:, :-1]])
    least = comb.settings.tear_fraction * (comb.pitch_px if spacing_px is None else spacing_px)
    part = np.abs(moved - before) > least
    found = np.zeros(moved.shape, bool)
    if len(rows := np.flatnonzero(part.any(axis=1))):  # most frames have no tear
        seen, group = seen[rows], np.cumsum(part[rows], axis=1)
        key = (group + sheets * np.arange(len(rows))[:, None])[seen]
        size = np.bincount(key, minlength=len(rows) * sheets).reshape(group.shape)
        own_size = np.take_along_axis(size, group, axis=1)
        found[rows] = seen & (own_size < size.max(axis=1, keepdims=True))
    return found


def exchanged(
    x_px: NDArray[np.floating], contrast: NDArray[np.floating], margin: Floats, comb: RidgeComb
) -> Bools:
    r"""Return where a sheet may be on the ridge of the next sheet, (frame, N).

    Where sheets draw together, a ridge that vanishes can shift the identities of those beyond it, although
    their ridges stay. These sheets then part from the others by a spacing, to where other sheets were. Let u
    be a sheet's step beyond that of the nearest sheets that do not part, and b the change of its log
    brightness. Averaged over adjacent sheets that part,

    .. math:: \ln\Big(1 + \frac{u^2}{2 \sigma_u^2}\Big) + \ln\Big(1 + \frac{b^2}{2 \sigma_b^2}\Big)

    then exceeds by half of `anchor_nats` the same sum for u and b from the last position and brightness of
    another sheet. Of the positions of a sheet before and after, those that `_weaker_side` names are doubtful.
    A ridge that comes, as two sheets part that formed one, is found in the film played backwards.
    x_px, contrast and margin are (frame, N), NaN where missing, and the first two where too doubtful to be
    compared.
    """
    forwards = _exchanged_forwards(x_px, contrast, margin, comb)
    return forwards | _exchanged_forwards(x_px[::-1], contrast[::-1], margin[::-1], comb)[::-1]


def _exchanged_forwards(
    x_px: NDArray[np.floating], contrast: NDArray[np.floating], margin: Floats, comb: RidgeComb
) -> Bools:
    """Return where a ridge that vanishes may have shifted the identities beyond it, (frame, N)."""
    sheets = x_px.shape[1]
    moved = without_common_change(x_px)
    last = np.empty((len(moved) - 1, sheets))
    for before, one in zip(last.T, moved.T, strict=True):
        before[:] = last_seen(one[None, :-1])[0]
    off = np.empty(last.shape, bool)
    for some in row_parts(len(last)):
        gap = np.diff(np.pad(last[some], ((0, 0), (1, 1)), constant_values=np.nan), axis=1)
        spacing = np.fmin(np.fmin(gap[:, :-1], gap[:, 1:]), comb.pitch_px)
        off[some] = torn(moved[1:][some] - last[some], comb, spacing)
    rows = np.flatnonzero(off.any(axis=1))
    if not len(rows):
        return np.zeros(x_px.shape, bool)
    off, here, last_x = off[rows], moved[1 + rows], last[rows]
    np.subtract(moved[1:], last, out=last)
    typical = typical_rows(len(last))
    usual_step = float(nan_median(np.abs(last[typical]).ravel()))
    step = here - last_x
    del moved, last
    level = without_common_change(np.log(contrast.astype(np.float64)))
    brightened = np.empty((len(x_px) - 1, sheets))
    last_level = np.empty(off.shape)
    for n, one in enumerate(level.T):
        before = last_seen(one[None, :-1])[0]
        brightened[:, n], last_level[:, n] = np.abs(one[1:] - before), before[rows]
    usual = [  # whole pixels
        0.5 + usual_step / NORMAL_MEDIAN,
        0.02 + float(nan_median(brightened[typical].ravel())) / NORMAL_MEDIAN,
    ]
    others = fill_rows(np.where(off, np.nan, step), np.arange(sheets, dtype=np.float64))
    at, height = here - others, level[1 + rows]
    del level, brightened

    def cost(by: int) -> Floats:
        """Return the cost of a step from where the sheet `by` further was."""
        u, b = at - shifted(last_x, by), height - shifted(last_level, by)
        return np.asarray(np.log1p((u / usual[0]) ** 2 / 2) + np.log1p((b / usual[1]) ** 2 / 2))

    gain = cost(0) - np.fmin.reduce([cost(by) for by in SHIFTS])
    part = np.cumsum(np.diff(off, axis=1, prepend=False), axis=1)
    part += (sheets + 1) * np.arange(len(rows))[:, None]
    least = comb.settings.anchor_nats / 2
    known = off & np.isfinite(gain)
    known[:, [0, -1]] &= gain[:, [0, -1]] > least  # these may be on a ridge beyond the comb
    count = np.bincount(part[known], minlength=part.max() + 1)
    mean = np.bincount(part[known], gain[known], minlength=len(count)) / np.maximum(count, 1)
    exchange = np.zeros(x_px.shape, np.int64)
    exchange[1 + rows] = off & (mean > least)[part]
    return _weaker_side(exchange, np.isfinite(x_px), margin)


def _weaker_side(exchange: Ints, seen: Bools, margin: Floats) -> Bools:
    """Return the positions before or after each exchange that are the less certain ones, (frame, N). An
    exchange needs a ridge that comes or goes: frames with more missing sheets are the weaker side, as far as
    sheets stay missing. If as many are missing, it is the side with the smaller sum of margins."""
    sheets = exchange.shape[1]
    run, lacking = np.cumsum(exchange, axis=0), np.isnan(margin).sum(axis=1)
    most = int(run.max()) + 1
    in_row = run + most * np.arange(sheets)
    each = np.nan_to_num(margin[seen], posinf=1e3)
    nats = np.bincount(in_row[seen], each, minlength=sheets * most).reshape(sheets, most)
    frame, sheet = np.nonzero(exchange)
    after = run[frame, sheet]
    more = lacking[frame] - lacking[frame - 1]
    later = np.where(more == 0, nats[sheet, after] <= nats[sheet, after - 1], more > 0)
    exceeded = np.where(more == 0, -1, np.minimum(lacking[frame], lacking[frame - 1]))
    limit = np.full(nats.shape, sheets)
    np.minimum.at(limit, (sheet, after - ~later), exceeded)
    return np.asarray(seen & (lacking[:, None] > limit.ravel()[in_row]), bool)


def last_seen(values: Floats) -> Floats:
    """Replace each NaN by the last value before it in its row."""
    known = np.isfinite(values)
    if known.all():
        return values
    number = np.where(known, np.arange(values.shape[1]), 0)
    return np.asarray(np.take_along_axis(values, np.maximum.accumulate(number, axis=1), axis=1), np.float64)


def fill_rows(values: Floats, at: Floats) -> Floats:
    """Replace NaN in values (rows, columns) by linear interpolation along each row.

    Beyond the first and last known value these are repeated; rows of NaN stay NaN. `at` is the ascending
    abscissa of the columns.
    """
    filled, known = values.copy(), np.isfinite(values)
    for row in np.flatnonzero(known.any(axis=1) & ~known.all(axis=1)):
        here = known[row]
        filled[row, ~here] = np.interp(at[~here], at[here], values[row, here])
    return filled


# --- jumps --------------------------------------------------------------------------------------------------

RENUMBERED = np.arange(-2, 3)  # sheets by which the frames between two jumps may be numbered otherwise
CHANGES = np.arange(2 * RENUMBERED[0], 2 * RENUMBERED[-1] + 1)  # by which the numbering may change at a jump


def _undo_false_jumps(
    match: Ints32, margin: Floats, x_px: Floats32, ridges: Ridges, comb: RidgeComb
) -> tuple[Ints32, Floats]:
    r"""Renumber the frames between two jumps of the comb if it did not jump; return match and margin.

    A comb that contracts, or whose ends fade, may fit the reference best with every sheet taken for the next
    one. It then seems to jump by a pitch and back, although each ridge hardly moves and keeps its brightness.

    Notes
    -----
    Jumps divide the film into runs of frames. The numbering of each run is shifted by up to two sheets so
    that the sum of all costs is lowest (Viterbi 1967). A shifted run costs its mean margin. A jump costs

    .. math:: \ln\Big(1 + \frac{\tilde u^2}{2 \sigma^2}\Big) + \sum_n \Big[
              \ln\Big(1 + \frac{(u_n - \tilde u)^2}{2 \sigma_u^2}\Big)
              + \ln\Big(1 + \frac{b_n^2}{2 \sigma_b^2}\Big)\Big]

    with the changes of position u and of log brightness b of each sheet from the frame before to the frame
    after, the median :math:`\tilde u`, and the usual changes in the film. The logarithms allow for slips,
    which blur ridges. A run is renumbered only if its own numbering costs `anchor_nats` more.

    A jump may remain although the sum of another numbering is smaller. If the difference is at least
    `anchor_nats` and `sheet_nats` for each sheet, it is subtracted from the margins of the run that has the
    smaller ones. The first term does not enter, since margins include the cost of a displacement.
    x_px: positions of the sheets, (frame, N).
    """
    settings = comb.settings
    seen = np.flatnonzero((match >= 0).any(axis=1))
    jump = np.abs(median_step(x_px[seen])) > settings.tear_fraction * comb.pitch_px
    if not jump.any():
        return match, margin
    run, x = np.r_[0, np.cumsum(jump)], x_px[seen].astype(np.float64)
    level = np.log(values_of(match, ridges.contrast)[seen].astype(np.float64))
    level -= nan_median(level, axis=1)[:, None]
    slip, sheets = _jump_costs(x, level, 1 + np.flatnonzero(jump))
    each = np.nan_to_num(nan_median(margin[seen], axis=1), posinf=1e3)
    run_margin = np.bincount(run, each) / np.bincount(run)
    total = _lowest_sums(np.where(RENUMBERED == 0, 0.0, run_margin[:, None]), slip + sheets)
    lowest, second = np.sort(total, axis=1)[:, :2].T
    wrong = total[:, RENUMBERED == 0][:, 0] >= lowest + settings.anchor_nats
    shift = np.where(wrong, RENUMBERED[total.argmin(axis=1)], 0)
    shift -= int(np.median(shift[run]))
    match, margin = match.copy(), margin.copy()
    for number in np.unique(shift[shift != 0]).tolist():
        rows = seen[shift[run] == number]
        match[rows] = np.nan_to_num(shifted(match[rows].astype(np.float64), number), nan=-1.0)
        margin[rows] = np.where(match[rows] >= 0, (second - lowest)[run[shift[run] == number], None], np.nan)
    chosen = sheets[np.diff(shift) - CHANGES[0], np.arange(jump.sum())]
    excess = chosen - sheets.min(axis=0)
    known = np.isfinite(x[:-1][jump]).sum(axis=1)
    excess[excess < np.fmax(settings.anchor_nats, settings.sheet_nats * known)] = 0.0
    weaker = np.arange(len(excess)) + (run_margin[:-1] >= run_margin[1:])
    margin[seen] -= np.bincount(weaker, excess, minlength=len(shift))[run][:, None]
    return match, margin


def _jump_costs(x: Floats, level: Floats, after: Ints) -> tuple[Floats, Floats]:
    """Return the costs of jumps if the numbering changes at them by each of `CHANGES`, (changes, jumps).

    The first are those of the common displacement, the second those of the single sheets' changes; see
    `_undo_false_jumps`. x, level: positions and log brightnesses of the sheets (frame, N). after: first frame
    after each jump.
    """
    step = np.diff(x, axis=0)
    common = nan_median(step, axis=1)[:, None]
    least_change = ((common, 1.0), (step - common, 0.5), (np.diff(level, axis=0), 0.02))  # whole pixels
    usual = [least + float(sigma_about_zero(change.ravel())) for change, least in least_change]
    known = np.isfinite(x[after - 1]).sum(axis=1)
    slip, sheets = np.empty((2, len(CHANGES), len(after)))
    for i, by in enumerate(CHANGES.tolist()):
        step = shifted(x[after], by) - x[after - 1]
        brightened = shifted(level[after], by) - level[after - 1]
        common = nan_median(step, axis=1)
        each = np.log1p((step - common[:, None]) ** 2 / (2 * usual[1] ** 2))
        each += np.log1p(brightened**2 / (2 * usual[2] ** 2))
        paired = np.isfinite(each).sum(axis=1)
        cost = np.nansum(each, axis=1) * known / np.maximum(paired, 1)
        sheets[i] = np.where(paired >= np.minimum(3, known), cost, 1e3)
        slip[i] = np.nan_to_num(np.log1p(common**2 / (2 * usual[0] ** 2)))
    return slip, sheets


def _lowest_sums(own: Floats, change: Floats) -> Floats:
    """Return the lowest sum of all costs if a run has each numbering, (runs, numberings).
    own: cost of each run in each numbering. change: cost of each jump for each of `CHANGES`."""
    cost = change[RENUMBERED - RENUMBERED[:, None] - CHANGES[0]]  # (number before, number after, jump)

    def before(own: Floats, cost: Floats) -> Floats:
        """Return the lowest cost of all runs before each, and of the jumps up to it."""
        lowest = np.zeros_like(own)
        for run in range(1, len(own)):
            lowest[run] = (lowest[run - 1] + own[run - 1] + cost[..., run - 1].T).min(axis=1)
        return lowest

    return own + before(own, cost) + before(own[::-1], cost.swapaxes(0, 1)[..., ::-1])[::-1]


# --- how the whole comb moves -------------------------------------------------------------------------------


def comb_squeeze(ridges: Ridges, settings: TrackingSettings) -> tuple[Floats, float]:
    """Return the mean spacing in each frame over that of the film, (frame, 1), and the comb's middle, px.

    The ratio is 1 in all frames of a film in which it hardly changes.
    The quantiles of the spacings are compared with their usual values, since spacings may be of several
    kinds; those of a missing sheet or a false detection are beyond the quantiles. A squeeze changes all of
    them alike: `squeeze_share` of the variance of their logarithms must be common. Where fewer ridges than
    usual are twice as far apart, every second sheet is gone, and half of the spacing counts.
    """
    some = ridges.x_px[typical_rows(len(ridges.x_px))]
    middle_px, still = float(nan_median(some.ravel())), np.ones((len(ridges.x_px), 1))
    sheets = np.maximum(ridges.count, 1)
    usual = np.median(sheets)
    # Without frames in which many are covered, or in which two frames share an image and many are seen twice.
    rows = np.flatnonzero((2 * sheets >= usual) & (4 * sheets <= 5 * usual) & (sheets > 1))
    if not len(rows):
        return still, middle_px
    parts = in_two_threads(lambda part: _log_spacings(ridges.x_px[rows[part]]), row_parts(len(rows)))
    change = np.concatenate(parts)
    change -= np.median(change, axis=0)
    # Every second sheet gone, as when the blocks part, is no squeeze to twice the spacing.
    fewer = np.where(5 * sheets[rows] < 4 * usual, np.rint(np.exp(change.mean(axis=1))), 1.0)
    change -= np.log(np.maximum(fewer, 1.0))[:, None]
    common = change.mean(axis=1)
    scale = running_median(np.exp(np.interp(np.arange(len(still)), rows, common)), 3)
    least, most = np.quantile(scale, (0.02, 0.98))
    squeezed = (most / least - 1) * usual / 2 >= settings.least_squeeze
    squeezed &= common.var() >= settings.squeeze_share * change.var()
    # Sheets two spacings apart tell less how far they moved: a smaller squeeze would exchange them.
    squeezed |= (fewer > 1).sum() >= LEAST_FRAMES
    return scale[:, None] if squeezed else still, middle_px


def _log_spacings(x_px: Floats32) -> Floats:
    """Return the logarithms of quantiles of the spacings in each frame, (frame, 17)."""
    gap = np.diff(x_px.astype(np.float64), axis=1)
    last = np.isfinite(gap).sum(axis=1)[:, None] - 1
    gap.sort(axis=1)  # NaN last; nanquantile takes forty times as long
    at = np.linspace(0.1, 0.9, 17) * last
    lower = at.astype(np.int64)
    low, high = (np.take_along_axis(gap, k, axis=1) for k in (lower, np.minimum(lower + 1, last)))
    return np.asarray(np.log(low + (at - lower) * (high - low)), np.float64)


def comb_displacement(ridges: Ridges, comb: RidgeComb) -> Floats:
    """Return the displacement of the whole comb since the first frame, px, (frame,).

    It is the sum of mean steps from each ridge to the nearest ridge of the next frame. Only steps within a
    pixel of their median enter (positions are whole pixels). Where most steps are too large to identify the
    same ridge, the step is 0.
    """
    frames = len(ridges.x_px)
    apart = 4.0 * (float(np.nanmax(ridges.x_px, initial=0.0)) + comb.pitch_px)
    if not ridges.count.any():
        return np.zeros(frames)
    moved, followed = np.zeros(frames - 1), np.zeros(frames - 1, bool)

    def follow(rows: slice) -> None:
        near = np.arange(rows.start, rows.stop + 1)
        moved[rows], followed[rows] = _mean_steps(ridges.x_px[near] + apart * near[:, None], apart, comb)

    in_two_threads(follow, row_parts(frames - 1))
    return np.concatenate([[0.0], np.cumsum(np.where(followed, moved, 0.0))])


def _mean_steps(in_one_row: Floats, apart: float, comb: RidgeComb) -> tuple[Floats, Bools]:
    """Return the mean step of the ridges from each frame to the next, and whether most were followed.
    in_one_row: positions in frames that lie `apart` in one row, px, (frame, K)."""
    row = in_one_row[np.isfinite(in_one_row)]
    if not len(row):
        return np.zeros(len(in_one_row) - 1), np.zeros(len(in_one_row) - 1, bool)
    same = in_one_row[:-1] + apart  # positions in the next frame if nothing moves
    after = np.searchsorted(row, np.nan_to_num(same))
    near = np.stack([row[np.clip(after - 1, 0, len(row) - 1)], row[np.clip(after, 0, len(row) - 1)]]) - same
    step = np.where(np.abs(near[0]) < np.abs(near[1]), near[0], near[1])
    small = np.abs(step) < comb.settings.step_fraction * comb.pitch_px
    followed = small.sum(axis=1) > 0.5 * np.isfinite(same).sum(axis=1)
    small &= np.abs(step - nan_median(np.where(small, step, np.nan), axis=1)[:, None]) <= 1.0
    return np.where(small, step, 0.0).sum(axis=1) / np.maximum(small.sum(axis=1), 1), followed


# --- segments -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Segments:
    """Runs of frames in which candidates move little between frames, and come and go only at the picture's
    edges.

    start, length: first frame and number of frames, (segments,). place: index in the segment's list of
    candidates at which the list of each frame begins, (frame,). candidates: mean position (moved to the
    middle frame), log contrast and log width of each, (segments, K).
    """

    start: Ints
    length: Ints
    place: Ints
    candidates: Candidates

    @property
    def middle(self) -> Ints:
        """Middle frame of each segment."""
        return self.start + self.length // 2

    def of_frames(self) -> Ints:
        """Return the segment of each frame, (frame,)."""
        return np.repeat(np.arange(len(self.start)), self.length)

    def in_frames(self, match: Ints, count: Ints) -> Ints32:
        """Return the candidate of each sheet in each frame, −1 where none, (frame, N).

        match: candidate of each sheet in each segment, (segments, N). count: candidates in each frame.
        """
        of_frames, found = self.of_frames(), np.empty((len(self.place), match.shape[1]), np.int32)

        def number(rows: slice) -> None:
            in_segment = match[of_frames[rows]]
            candidate = in_segment - self.place[rows, None]
            known = (in_segment >= 0) & (candidate >= 0) & (candidate < count[rows, None])
            found[rows] = np.where(known, candidate, -1)

        in_two_threads(number, row_parts(len(found)))
        return found


def split_segments(ridges: Ridges, comb: RidgeComb) -> Segments:
    """Cut the recording where a candidate comes, goes or jumps, except where sheets cross the picture's edge.

    Within a segment every candidate of a frame is also in the next, or crosses the edge there, and every step
    is small against the spacing to the nearer neighbour (or the pitch, if smaller). A comb that jumps by a
    whole pitch, so that one sheet leaves the picture as another enters, seems not to move; but its
    brightnesses change, and so the recording is cut there.
    """
    frames = len(ridges.x_px)
    continues, moved, change = _compared(ridges, np.arange(frames - 1), 0, comb)
    most = max(comb.settings.least_change, 5.0 * float(np.median(change)) if frames > 1 else 0.0)
    continues &= change <= most
    usual = float(np.quantile(change, 0.1)) if frames > 1 else 0.0
    changed = np.flatnonzero(continues & (change > 3.0 * usual))
    for number in (1, -1):
        _, _, other = _compared(ridges, changed, number, comb)
        continues[changed[other < change[changed] / comb.settings.pattern_ratio]] = False
    came = np.zeros(frames - 1, np.int64)
    for number in (1, -1):  # a sheet enters on the left, or leaves there
        rows = np.flatnonzero(~continues)
        follows, step, change = _compared(ridges, rows, number, comb)
        good = follows & (change <= most)
        continues[rows[good]], came[rows[good]], moved[rows[good]] = True, number, step[good]
    start = np.r_[0, 1 + np.flatnonzero(~continues)].astype(np.int64)
    length = np.diff(np.r_[start, frames])
    of_frame = np.repeat(np.arange(len(start)), length)
    place = np.r_[0, -np.cumsum(came)]
    place -= np.minimum.reduceat(place, start)[of_frame]
    drift = np.r_[0.0, np.cumsum(np.where(continues, moved, 0.0))]
    drift -= drift[start + length // 2][of_frame]
    return Segments(start, length, place, Candidates(*_means(ridges, drift, of_frame, place)))


def _compared(ridges: Ridges, rows: Ints, came: int, comb: RidgeComb) -> tuple[Bools, Floats, Floats]:
    """Return whether the next frames continue frames `rows`, the mean steps of the candidates, px, and the
    rms changes of their log brightness. It is assumed that `came` candidates entered on the left, or left
    there, if negative."""
    continues, (step, change) = np.empty(len(rows), bool), np.empty((2, len(rows)))

    def compare(part: slice) -> None:
        continues[part], step[part], change[part] = _compared_part(ridges, rows[part], came, comb)

    in_two_threads(compare, row_parts(len(rows)))
    return continues, step, change


def _compared_part(ridges: Ridges, rows: Ints, came: int, comb: RidgeComb) -> tuple[Bools, Floats, Floats]:
    """Compare some frames with the next ones, as in `_compared`: what is compared fits into memory."""
    before, after = ridges.x_px[rows], shifted(ridges.x_px[rows + 1], came)
    paired = np.isfinite(before) & np.isfinite(after)
    step = np.where(paired, after - before, 0.0)
    spacing = np.fmin(np.fmin(_spacing(before), _spacing(after)), comb.pitch_px)
    small = (np.abs(step) < comb.settings.step_fraction * spacing) | ~paired
    edge = comb.fwhm_px + comb.settings.step_fraction * comb.pitch_px
    entered = ridges.x_px[rows + 1, : max(came, 0)]
    single = [np.where(paired, np.nan, before), np.where(paired, np.nan, after), entered]
    crossing = [np.isnan(x) | (x < edge) | (x > comb.width_px - 1 - edge) for x in single]
    count = paired.sum(axis=1)
    unpaired = ridges.count[rows] + ridges.count[rows + 1] - 2 * count
    continues = small.all(axis=1) & np.hstack(crossing).all(axis=1) & (unpaired <= count)
    bright_before, bright_after = np.log(ridges.contrast[rows]), np.log(ridges.contrast[rows + 1])
    change = np.where(paired, shifted(bright_after, came) - bright_before, 0.0)
    total = np.maximum(count, 1)
    return continues, step.sum(axis=1) / total, np.sqrt((change**2).sum(axis=1) / total)


def _spacing(x: Floats32) -> Floats32:
    """Return the distance to the nearer neighbour, inf where there is none."""
    gap = np.nan_to_num(np.diff(x, axis=1), nan=np.inf)
    end = np.full((len(x), 1), np.inf, x.dtype)
    return np.minimum(np.hstack([end, gap]), np.hstack([gap, end]))


def _means(ridges: Ridges, drift_px: Floats, of_frame: Ints, place: Ints) -> Floats:
    """Return means of position less drift, log contrast and log width over the frames of each segment,
    (3, segments, places), NaN where there is no candidate."""
    places = int((place + ridges.count).max(initial=1, where=ridges.count > 0))
    segments = int(of_frame[-1]) + 1
    count, totals = np.zeros((segments, places)), np.zeros((3, segments, places))
    for rows in row_parts(len(of_frame)):
        known = np.isfinite(ridges.x_px[rows])
        frame, k = np.nonzero(known)
        first, stop = int(of_frame[rows.start]), int(of_frame[rows.stop - 1]) + 1
        index = (of_frame[rows][frame] - first) * places + place[rows][frame] + k
        shape, cells = (stop - first, places), (stop - first) * places
        count[first:stop] += np.bincount(index, minlength=cells).reshape(shape)
        x = ridges.x_px[rows] - drift_px[rows, None]
        for total, values in zip(
            totals, (x, np.log(ridges.contrast[rows]), np.log(ridges.fwhm_px[rows])), strict=True
        ):
            total[first:stop] += np.bincount(index, values[known], minlength=cells).reshape(shape)
    return np.where(count > 0, totals / np.maximum(count, 1), np.nan)

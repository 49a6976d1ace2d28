"""The reference comb: which candidates are sheets, as most of the recording agrees.

`build_reference` collects the ridges that persist and chooses those that together form a comb, without dust,
labels and marks. `static_ridges` finds marks that are stationary while the sheets beside them move, and
`wide_spacings` finds gaps in which a sheet may have been overlooked.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vision.errors import NoRidgesError
from vision.memory import in_two_threads
from vision.numeric import (
    Bools,
    Floats,
    Ints,
    common_change,
    mad_sigma,
    nan_median,
    nearest,
    sigma_about_zero,
    spread_indices,
    typical_median,
    typical_medians,
    typical_size,
)
from vision.sheets.alignment import Candidates, ExpectedSheets, align, values_of
from vision.sheets.ridges import FEWEST, RidgeComb
from vision.sheets.settings import DEFAULT, TrackingSettings
from vision.signals import running_median

LEAST_IN_VIEW = 0.13  # fraction of the frames in which a sheet must be in view to be judged


@dataclass(frozen=True)
class ReferenceComb:
    """The sheets, from left to right; all (N,).

    x_px: rest positions. log_contrast, log_width: logarithms of contrast and width. found: fraction of the
    frames in which each is found. dropped_px: rest positions of persistent ridges that are not part of the
    comb. beyond: number of these that continue the comb or that it skips, if the number of sheets was given;
    otherwise the number of ends at which one may be a further sheet.
    """

    x_px: Floats
    log_contrast: Floats
    log_width: Floats
    found: Floats
    dropped_px: Floats = field(default_factory=lambda: np.zeros(0))
    beyond: int = 0

    @property
    def sheets(self) -> int:
        """Number of sheets."""
        return len(self.x_px)

    def only(self, kept: Ints) -> ReferenceComb:
        """Return the comb of these entries."""
        dropped = np.r_[self.dropped_px, np.delete(self.x_px, kept)]
        return ReferenceComb(
            self.x_px[kept], self.log_contrast[kept], self.log_width[kept], self.found[kept], dropped
        )

    def expected(self, x_px: Floats, comb: RidgeComb, *, counted: bool = False) -> ExpectedSheets:
        """Return this comb with its sheets expected at x_px (lists, N).

        Unless the number of sheets was `counted`, more sheets may lie beyond an end near the picture's edge.
        """
        unseen = -np.log(np.clip(1 - self.found, 1e-3, 1))
        missing = np.clip(unseen, 1.0, comb.settings.missing_cost)
        half = comb.fwhm_px / 2
        view = (half, comb.width_px - 1 - half)
        near = comb.settings.edge_pitches * comb.pitch_px
        ends = x_px[:, 0].min() < view[0] + near, x_px[:, -1].max() > view[1] - near
        open_ends = (False, False) if counted else (bool(ends[0]), bool(ends[1]))
        return ExpectedSheets(x_px, self.log_contrast, missing, comb.pitch_px, view, open_ends, comb.settings)


def build_reference(
    candidates: Candidates,
    frames: Ints,
    displacement_px: Floats,
    comb: RidgeComb,
    *,
    sheets: int | None,
    source: str,
) -> ReferenceComb:
    """Return the comb that most frames agree on.

    All candidates of one long list are first taken for sheets, and lists from the whole recording are aligned
    with them. Candidates that many frames show and the comb lacks are added; sheets that few frames show are
    removed. Of the result, the entries that together form the most even comb are the sheets: exactly `sheets`
    entries, if that number is given.

    There is one list of candidates for each segment of frames; `frames` is its number of frames and
    `displacement_px` the displacement of the whole comb at that time, (lists,).

    Raises: InputError for fewer ridges than `sheets`, not counting specks far outside the comb, or if no
    ridge is in most frames; the message names `source`.
    """
    settings = comb.settings
    spread = spread_indices(len(frames), 192)
    longest = np.argsort(-frames, kind="stable")[:192]
    chosen = np.unique(np.r_[longest, spread])
    some, weight, moved = candidates.take(chosen), frames[chosen].astype(np.float64), displacement_px[chosen]
    reference = _seed(candidates, frames, displacement_px, comb.pitch_px)
    for _ in range(4):  # two revisions usually suffice
        filled = _fill_gaps(reference, comb.pitch_px)
        revised = _revise(filled, some, weight, moved, comb)
        if not revised.sheets:
            advice = "check `rows` and `rotate`; one picture may be a title among few frames"
            raise NoRidgesError(source, "ridges that most frames show", "none that lasts", advice)
        unchanged = revised.sheets == reference.sheets
        reference = revised
        if unchanged:
            break
    if sheets is not None and reference.sheets < sheets:
        raise _too_few(reference.x_px, sheets, source, settings)
    best = reference.only(_choose_sheets(reference, comb, sheets))
    if sheets is None:
        return best
    if _far_outside(best.x_px, settings):
        raise _too_few(best.x_px, sheets, source, settings)
    return replace(best, beyond=_left_out_of(reference, best))


def _left_out_of(everything: ReferenceComb, best: ReferenceComb) -> int:
    """Return how many ridges outside the comb continue it, and how many are skipped where its most even
    sheets are every second or third ridge. Ridges outside count at the spacing of all that are similar to its
    sheets, up to the last such ridge."""
    like = _alike(everything, best)
    often, x = everything.found >= 0.5, everything.x_px
    spacing = float(np.median(np.diff(x[like & often], append=np.inf)))
    count = 0
    for side, end in ((-1, best.x_px[0]), (1, best.x_px[-1])):
        away = side * (x - end)
        out = np.flatnonzero(often & (away > 0))
        out = out[np.argsort(away[out])]
        in_turn = np.abs(np.diff(away[out], prepend=0.0) - spacing) < 0.4 * spacing
        last = np.flatnonzero(np.logical_and.accumulate(in_turn) & like[out])
        count += int(last[-1]) + 1 if last.size else 0
    if best.sheets > 1 and spacing < 0.75 * np.median(np.diff(best.x_px)):
        inside = (x > best.x_px[0]) & (x < best.x_px[-1])
        count += int(np.sum(like & often & inside & ~np.isin(x, best.x_px)))
    return count


def _alike(entries: ReferenceComb, comb: ReferenceComb) -> Bools:
    """Return which entries have the comb's usual contrast, within a factor of 2, and width, of 1.5, (N,)."""
    like = np.abs(entries.log_contrast - np.median(comb.log_contrast)) < np.log(2.0)
    return np.asarray(like & (np.abs(entries.log_width - np.median(comb.log_width)) < np.log(1.5)), bool)


def _far_outside(x_px: Floats, settings: TrackingSettings) -> int:
    """Return how many of nine or more ridges are specks far outside the comb; 0 of fewer."""
    if len(x_px) < 9:
        return 0
    spacing = np.diff(x_px)
    return int((spacing[[0, -1]] > settings.far_outside * np.median(spacing)).sum())


def _too_few(x_px: Floats, sheets: int, source: str, settings: TrackingSettings) -> NoRidgesError:
    """Return the error for fewer ridges than `sheets`, without those far outside the comb, with a number that
    can be tracked."""
    far = _far_outside(x_px, settings)
    gaps = ", ".join(f"{x:.0f} px" for x in wide_spacings(x_px, settings=settings)[0])
    found = f"{len(x_px) - far}"
    found += f" and {far} far outside their comb" if far else ""
    found += f", and none that stands out in the gaps at {gaps}" if gaps else ""
    advice = f"give `sheets` as {len(x_px) - far} or leave it out"
    advice += ", and give the axis (`axis_px`), or count sheets by [[add]] in `corrections`" if gaps else ""
    return NoRidgesError(source, f"{sheets} ridges (`sheets`)", found, advice)


def _seed(candidates: Candidates, frames: Ints, displacement_px: Floats, pitch_px: float) -> ReferenceComb:
    """Return the list of the longest segment among those with the commonest number of candidates. The number
    includes the sheets that fit into gaps; how common it is, is counted in frames."""
    x = candidates.x_px
    count = np.isfinite(x).sum(axis=1)
    gap = np.diff(x, axis=1)
    count += np.nan_to_num(np.maximum(np.rint(gap / pitch_px) - 1, 0)).sum(axis=1).astype(np.int64)
    total = np.bincount(count, weights=frames)
    total[0] = 0
    of_count = np.flatnonzero(count == np.argmax(total))
    seed = of_count[np.argmax(frames[of_count])]
    real = np.isfinite(x[seed])
    return ReferenceComb(
        x[seed][real] - displacement_px[seed],
        candidates.log_contrast[seed][real],
        candidates.log_width[seed][real],
        np.ones(real.sum()),
    )


def _fill_gaps(known: ReferenceComb, pitch_px: float) -> ReferenceComb:
    """Return the comb with sheets added wherever a spacing is wide enough for them. If some sheets are
    covered in every frame, no list has all sheets. Added sheets that the other lists do not show are removed
    in the revision; until then they may be missing at little cost."""
    x = known.x_px
    room = np.maximum(np.rint(np.diff(x) / pitch_px).astype(np.int64), 1)
    after = np.repeat(np.arange(len(room)), room - 1)
    step = np.concatenate([np.arange(1, size) for size in room]) if len(after) else np.zeros(0)
    added = x[after] + step * (np.diff(x) / room)[after]
    order = np.argsort(np.r_[x, added])
    columns = (
        np.r_[x, added],
        np.r_[known.log_contrast, known.log_contrast[after]],
        np.r_[known.log_width, known.log_width[after]],
        np.r_[known.found, np.full(len(after), 0.5)],
    )
    return ReferenceComb(*(values[order] for values in columns))


def _revise(
    reference: ReferenceComb, candidates: Candidates, weight: Floats, displacement_px: Floats, comb: RidgeComb
) -> ReferenceComb:
    """Add ridges that many lists show, remove those that few show, and measure all again.
    weight: number of frames of each list."""
    rest = reference.x_px + displacement_px[:, None]
    match = align(candidates, reference.expected(rest, comb), margins=False).match
    tables = (candidates.x_px, candidates.log_contrast, candidates.log_width)
    x, log_contrast, log_width = (values_of(match, values) for values in tables)
    moved = x - rest
    found = np.where(np.isfinite(x), weight[:, None], 0).sum(axis=0) / weight.sum()
    common = nan_median(moved, axis=1)
    rest_px = reference.x_px + nan_median(moved - common[:, None])
    known = (rest_px, nan_median(log_contrast), nan_median(log_width), found)
    more = _unmatched(reference, candidates, match, weight, comb.pitch_px)
    columns = [np.concatenate(pair) for pair in zip(known, more, strict=True)]
    everything = ReferenceComb(columns[0], columns[1], columns[2], columns[3]).only(np.argsort(columns[0]))
    position = everything.x_px + (displacement_px + np.nan_to_num(common))[:, None]
    margin = 0.5 * comb.pitch_px  # a sheet near the picture's edge is seen half of the time
    in_view = weight @ ((position > margin) & (position < comb.width_px - 1 - margin))
    share = everything.found * weight.sum() / np.maximum(in_view, LEAST_IN_VIEW * weight.sum())
    kept = everything.only(np.flatnonzero(share >= comb.settings.present_inside))
    return replace(kept, dropped_px=np.zeros(0))


def _unmatched(
    reference: ReferenceComb, candidates: Candidates, match: Ints, weight: Floats, pitch_px: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return unpaired candidates that persist: rest position, log contrast, log width, share of the frames. A
    revision adds at most one per spacing between the sheets, and one per pitch outside them."""
    x = candidates.x_px
    taken = np.zeros(x.shape, bool)
    rows, sheet = np.nonzero(match >= 0)
    taken[rows, match[rows, sheet]] = True
    list_, column = np.nonzero(np.isfinite(x) & ~taken)
    paired, at = values_of(match, x), x[list_, column]
    moved = (paired - reference.x_px)[list_, nearest(paired[list_], at)[0]]  # of the nearest sheet found
    rest = at - np.nan_to_num(moved)
    interval = np.searchsorted(reference.x_px, rest)
    outside = np.rint((reference.x_px[0] - rest) / pitch_px), np.rint((rest - reference.x_px[-1]) / pitch_px)
    interval -= np.maximum(outside[0] - 1, 0).astype(np.int64)
    interval += np.maximum(outside[1] - 1, 0).astype(np.int64)
    intervals, which = np.unique(interval, return_inverse=True)
    share = np.bincount(which, weights=weight[list_], minlength=len(intervals)) / weight.sum()
    groups = [which == i for i in np.flatnonzero(share >= 0.3 * LEAST_IN_VIEW)]
    found = np.array([weight[np.unique(list_[group])].sum() for group in groups]) / weight.sum()
    features = rest, candidates.log_contrast[list_, column], candidates.log_width[list_, column]
    medians = [np.array([np.median(values[group]) for group in groups]) for values in features]
    return medians[0], medians[1], medians[2], found


# --- which persistent ridges form a comb --------------------------------------------------------------------


def _choose_sheets(reference: ReferenceComb, comb: RidgeComb, sheets: int | None) -> Ints:
    """Return the indices of the entries that form the best comb, of exactly `sheets` entries if given.

    Each entry adds a score from its presence, contrast and width, and each spacing costs its departure from
    the local pitch, less in an uneven comb. A faint sheet at its position is retained, since without it the
    spacing is double; dust between two sheets is not.
    """
    settings, x_px = comb.settings, reference.x_px
    width, contrast = reference.log_width, reference.log_contrast
    odd = np.maximum(np.abs(width - np.median(width)) - 0.35, 0)
    faint = np.maximum(contrast - np.median(contrast), -2.5)
    score = 1 + 1.5 * reference.found + settings.contrast_score * faint - settings.odd_width_cost * odd
    # The pitch was measured on the main ridges: on as many as given, or without what lies between them.
    even = sheets is not None or _even_but_for_others(reference, comb)
    local = np.full(len(x_px), comb.pitch_px) if even else _local_pitch(x_px, comb)
    gap = x_px[None, :] - x_px[:, None]
    off = np.abs(np.log(np.where(gap > 0, gap, 1.0) / ((local[None, :] + local[:, None]) / 2)))
    cost = np.where(gap > 0, settings.uneven_cost * off, np.inf)  # of entry j following entry i
    if not even and len(x_px) >= 6:
        scatter = sigma_about_zero(np.log(np.maximum(np.diff(x_px), 1e-3) / local[:-1]))
        cost /= max(1.0, float(scatter) / settings.even_spread)
    return _best_chain(np.maximum(score, 0.3), cost, sheets)


def _even_but_for_others(reference: ReferenceComb, comb: RidgeComb) -> bool:
    """Return whether the entries that are alike are spaced by the pitch, but those between them are not. The
    others are then parts of what holds the sheets, which move along. Others that are even themselves may be
    every second sheet, and those outside tell nothing of the comb."""
    alike = _alike(reference, reference)
    if alike.sum() < 6:
        return False
    first, last = np.flatnonzero(alike)[[0, -1]]
    x_px, alike = reference.x_px[first : last + 1], alike[first : last + 1]

    def uneven(x_px: Floats, pitch_px: float) -> bool:
        spread = sigma_about_zero(np.log(np.maximum(np.diff(x_px), 1e-3) / pitch_px))
        return not spread < comb.settings.even_spread  # NaN of less than two

    mixed = uneven(x_px, float(np.median(np.diff(x_px)))) and uneven(x_px[~alike], comb.pitch_px)
    return mixed and not uneven(x_px[alike], comb.pitch_px)


def _local_pitch(x_px: Floats, comb: RidgeComb) -> Floats:
    """Return the median of the nine spacings around each entry. It is limited to within a quarter of the
    pitch, because dust changes it abruptly, unless it changes gradually along the comb, as it does in films
    at an angle."""
    if len(x_px) < 6:
        return np.full(len(x_px), comb.pitch_px)
    smooth = running_median(np.diff(x_px), 9)
    smooth = np.r_[smooth, smooth[-1]]
    near = np.clip(smooth, 0.75 * comb.pitch_px, 1.25 * comb.pitch_px)
    gradual = np.abs(np.diff(np.log(smooth))).max() < comb.settings.even_spread
    at_an_angle = gradual and np.median(smooth) == np.median(near)
    return np.asarray(smooth if at_an_angle else near, np.float64)


def _best_chain(score: Floats, cost: Floats, sheets: int | None) -> Ints:
    """Return the chain with the largest score less cost, of exactly `sheets` entries if given."""
    best, origin = [score], []  # of the chains of each length that end with each entry
    for _ in range((sheets or len(score)) - 1):
        total = best[-1][:, None] - cost
        origin.append(total.argmax(axis=0))
        best.append(total.max(axis=0) + score)
    length = len(best) if sheets else 1 + int(np.argmax([ends.max() for ends in best]))
    chain = [int(best[length - 1].argmax())]
    for step in reversed(origin[: length - 1]):
        chain.append(int(step[chain[-1]]))
    return np.array(chain[::-1], np.int64)


# --- marks and gaps -----------------------------------------------------------------------------------------


def rest_positions(x_px: NDArray[np.floating]) -> Floats:
    """Return each sheet's median position after removing the comb's common motion, (N,).

    This is also right for sheets that are in view only while the comb is displaced.
    """
    rest = typical_median(x_px)

    def still(rows: Ints | slice) -> Floats:
        return np.asarray(x_px[rows] - common_change(x_px[rows], rest)[:, None], np.float64)

    for _ in range(3):
        before, rest = rest, typical_medians(still, len(x_px))
        if np.array_equal(before, rest, equal_nan=True):  # the usual case for whole pixels
            break
    return rest


def static_ridges(moved_px: Floats, rest_px: Floats, *, settings: TrackingSettings = DEFAULT) -> Bools:
    """Return which entries are stationary while the sheets beside them move, (N,): dust on the optics, marks.

    Motion grows outwards, so that a sheet moves at least as much as its neighbours on one side. Each entry is
    therefore compared with the smaller of the motions to its left and right (each the mean of two
    neighbours), if these have the same direction and are large enough. Nothing is decided at the centre of
    the comb, which hardly moves. Its ends are compared with the nearest entry, and only where their spacing
    is not the comb's. A row of marks beside the comb, whose marks have stationary neighbours, is found by its
    position and spacing.

    moved_px: displacement from the rest positions rest_px (N,), (frame, N), NaN where missing.
    """
    sheets = len(rest_px)
    gap = np.diff(rest_px)
    odd = np.abs(np.log(gap / np.median(gap))) > settings.odd_spacing if len(gap) > 1 else np.zeros(2, bool)

    def compare(n: int) -> tuple[float, float, int]:
        """Return the power of the motion beside an entry, that of its own, and the frames that show both."""
        left, right = _beside(moved_px, n, -1), _beside(moved_px, n, 1)
        if n == 0 and odd[0]:
            left = right = moved_px[:, 1]
        if n == sheets - 1 and odd[-1]:
            left = right = moved_px[:, -2]
        both = np.isfinite(left) & np.isfinite(right) & np.isfinite(moved_px[:, n])
        left, right = left[both], right[both]
        common = np.where(left * right > 0, np.minimum(np.abs(left), np.abs(right)), 0.0)
        return (common**2).sum(), (moved_px[both, n] ** 2).sum(), both.sum()

    power, own, frames = np.array(in_two_threads(compare, range(sheets))).reshape(-1, 3).T
    certain = (frames >= 50) & (power > frames * settings.moving_px**2)
    stationary = certain & (own < settings.static_fraction**2 * power)
    return np.asarray(stationary | _ruler_beside_comb(moved_px, rest_px, settings), bool)


def _ruler_beside_comb(moved_px: Floats, rest_px: Floats, settings: TrackingSettings) -> Bools:
    """Return which entries belong to a ruler, a stationary row of marks beside the comb, (N,). These are the
    smaller part on one side of a wide spacing, if its pitch differs from the rest and it is stationary while
    sheets near it move. `vision.video.strip_find` says how rulers elsewhere are avoided."""
    gap, ruler = np.diff(rest_px), np.zeros(len(rest_px), bool)
    if not len(gap):
        return ruler
    for wide in np.flatnonzero(gap > settings.wide_pitches * np.median(gap)):
        left, right = np.split(np.arange(len(rest_px)), [wide + 1])
        row, rest, near = (left, right, right[:4]) if len(left) < len(right) else (right, left, left[-4:])
        if len(row) < 2 or len(rest) < 2:
            continue
        row_pitch, pitch = (np.median(np.diff(rest_px[part])) for part in (row, rest))
        if abs(np.log(row_pitch / pitch)) > settings.odd_spacing:
            row_motion, comb_motion = (_mean_motion(moved_px[:, part]) for part in (row, near))
            moving = comb_motion > 0.5 * settings.moving_px  # half, since it is the mean of four
            ruler[row] |= moving and row_motion < settings.static_fraction * comb_motion
    return ruler


def _mean_motion(moved_px: Floats) -> float:
    """Return the root mean square of the mean motion of some entries (frame, entries)."""
    known = np.isfinite(moved_px)
    mean = np.where(known, moved_px, 0.0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    return float(np.sqrt((mean**2).mean()))


def faint_ends(reference: ReferenceComb, moved_px: Floats, *, settings: TrackingSettings = DEFAULT) -> Bools:
    """Return which of the first and last entries are faint and show a second sign of not being sheets, (N,).

    The signs are presence in few frames, an unusual width, and less or another motion than that of the entry
    beside it, although motion grows outwards. Specks on the lens leave such bumps of the background beside a
    comb. One sign is not enough: sheets may be faint, and if one side of the comb is in view, one end is
    stationary. An entry that moves along with the next is a sheet: the ridge of one close to its neighbour is
    low and narrow. An entry of unusual width and with another motion need only be dim (`dim_end`). Several
    faint entries at an end, or one beside a few sheets, are all no sheets if they are `_stationary_beside` a
    bright one. moved_px: displacement from the rest positions (frame, N), NaN where missing.
    """
    none = np.zeros(reference.sheets, bool)
    contrast, width = (values - np.median(values) for values in (reference.log_contrast, reference.log_width))
    faint_end, dim_end = np.log(settings.faint_end), np.log(settings.dim_end)
    power = np.array([(moved[np.isfinite(moved)] ** 2).sum() for moved in moved_px.T]) / len(moved_px)
    in_comb = moved_px - nan_median(moved_px, axis=1)[:, None]  # a shaken camera moves all alike
    ends = ((0, 1, contrast[1:6]), (-1, -2, contrast[-6:-1])) if reference.sheets >= FEWEST else ()
    for end, inner, beside in ends:
        seen, own = np.isfinite(moved_px[:, end]).mean(), contrast[end]
        if seen > 0.5:  # and the light may fall off towards this end
            own -= min(0.0, float(np.median(beside)))
        moves = power[inner] > settings.moving_px**2 / 4
        slow = moves and power[end] < settings.slow_end**2 * power[inner]
        along = motion_likeness(in_comb[:, end], in_comb[:, inner]) > settings.along_end
        odd = abs(width[end]) > np.log(settings.odd_width)
        none[end] = own < faint_end and bool(slow or (not along and (moves or seen < 0.5 or odd)))
        none[end] |= own < dim_end and bool(moves and odd and not along)
    for inwards in (slice(None), slice(None, None, -1)):
        found = _stationary_beside(contrast[inwards], moved_px[:, inwards], settings)
        none[inwards][:found] = True
    return none


def _stationary_beside(contrast: Floats, moved_px: Floats, settings: TrackingSettings) -> int:
    """Return the number of entries from the first on that are a stationary pattern beside a moving comb.

    A reflection or a fabric behind the comb leaves rows of ridges. All of these are faint, the brightest is
    far fainter than the sheet beside them, and that sheet moves while none of them does. A comb that darkens
    gradually towards its stationary middle differs in this step. 0 where there is none.

    contrast: logarithm, over the median, (N,). moved_px: (frame, N).
    """
    row = int(np.argmin(contrast < np.log(settings.faint_end)))
    if not row or contrast[:row].max() > contrast[row] + np.log(settings.faint_end):
        return 0
    moved = moved_px[:, : row + 1]
    motion = np.sqrt(np.nansum(moved**2, axis=0) / np.maximum(np.isfinite(moved).sum(axis=0), 1))
    moves = motion[row] > settings.moving_px / 2
    return row if moves and motion[:row].max() < settings.static_fraction * motion[row] else 0


def motion_likeness(one: Floats, other: Floats) -> float:
    """Return the correlation of two motions about 0 where both are known, 0 where neither moves."""
    both = np.isfinite(one) & np.isfinite(other)
    size = np.sqrt((one[both] ** 2).sum() * (other[both] ** 2).sum())
    return float((one[both] * other[both]).sum() / size) if size > 0 else 0.0


def marks(x_px: Floats, rest_px: Floats, err_px: Floats, usual_px: Floats, comb: RidgeComb) -> Bools:
    """Return which sheets are marks or lie under one, (N,): the measured position is not the sheet's.

    A mark belongs to a ruler beside the comb, or it is usually distorted and shows a second sign. The sign is
    that it moves far less than the sheets on both sides, or that it does not move and breaks the comb's even
    spacing. One sign is not enough: dirt distorts sheets, combs are uneven, and sheets of the stiff centre
    hardly move.

    x_px, err_px: positions and their errors from noise (frame, N), NaN where missing. rest_px,
    usual_px: rest position and usual distortion of each sheet, px, (N,).
    """
    settings = comb.settings
    least = 5.0 * float(nan_median(err_px.ravel()))
    sensitive = replace(settings, moving_px=least, static_fraction=settings.mark_motion)
    moved = x_px - rest_px
    unmoved = typical_size(moved) < least
    with np.errstate(divide="ignore", invalid="ignore"):  # sheets swapped manually, or never seen
        stationary = static_ridges(moved, rest_px, settings=sensitive)
        ruler = _ruler_beside_comb(moved, rest_px, replace(settings, moving_px=least))
        uneven = np.abs(np.log(np.diff(rest_px) / comb.pitch_px)) > settings.odd_spacing
    misplaced = np.append(uneven, False) | np.insert(uneven, 0, False)
    distorted = usual_px > settings.mark_distorted * comb.fwhm_px
    return np.asarray(ruler | distorted & (stationary | (misplaced & unmoved)), bool)


def _beside(moved_px: Floats, n: int, step: int) -> Floats:
    """Return the mean motion of the two entries on one side of one, (frame,); NaN where neither is seen."""
    total, count = np.zeros((2, len(moved_px)))
    for k in (n + 2 * step, n + step):
        if 0 <= k < moved_px.shape[1]:
            seen = np.isfinite(moved_px[:, k])
            total += np.where(seen, moved_px[:, k], 0.0)
            count += seen
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def wide_spacings(
    x_px: Floats, others_px: Floats | None = None, *, settings: TrackingSettings = DEFAULT
) -> tuple[Floats, Floats]:
    """Find spacings in which a sheet seems to be missing.

    Parameters
    ----------
    x_px
        Rest positions of the sheets, ascending (N,).
    others_px
        Those of ridges that were not taken for sheets, (M,): a spacing with one in it need not be as wide.
    settings
        Width from which a spacing is too wide.

    Returns
    -------
    middle_px, size
        Middles of these spacings, and their sizes in local pitches (the median of the nine spacings around).
        Empty for fewer than nine sheets, for which there is no local pitch.
    """
    size, wide = spacing_sizes(x_px, settings=settings)
    if others_px is not None and len(others_px):
        shared = np.isin(np.arange(len(size)), np.searchsorted(x_px, others_px) - 1)
        wide |= shared & (size > settings.wide_with_ridge)
    return (x_px[:-1] + 0.5 * np.diff(x_px))[wide], size[wide]


def spacing_sizes(x_px: Floats, *, settings: TrackingSettings) -> tuple[Floats, Bools]:
    """Return the sizes of the spacings of sheets (N,) in local pitches, and which are too wide, (N − 1,).

    None is too wide, and all sizes are NaN, for fewer than nine sheets.
    """
    spacing = np.diff(x_px)
    if spacing.size < 8:
        return np.full(spacing.shape, np.nan), np.zeros(spacing.shape, bool)
    size = spacing / running_median(spacing, 9, ends="inside")
    log = np.log(size)
    scatter = float(mad_sigma(log))
    # an uneven comb has wide spacings anyway
    return size, log > max(np.log(settings.wide_pitches), 3.0 * scatter)

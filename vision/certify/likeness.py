"""The recording taken apart into what it shows, how that moves, and everything else; and put together again.

A frame is g(t) M(ξ(x, t)) + R(x, t): the mean picture M in the coordinate ξ of the sheets at rest, which
moves with them and holds each ridge's own shape, the gaps and the light; the brightness g of the frame; and
the residual R, which holds noise, unequal pixels, and what the codec added or took away.  Motion is smooth
between slips; the noise of positions is therefore in R and not in the motion.  A film with another motion, or
with the residuals of other frames, has exactly known positions.

What happened to the recording happens to its films: brightness steps, frames that repeat the one before or
are not there, and places where something else pulls ridges aside (dirt, a highlight, a hand) show what was
recorded, while the true motion there is that of the sheets around.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy
import xarray as xr

from vision.certify.encoder import Encoder
from vision.certify.settings import CertifySettings
from vision.data import StripMetadata
from vision.errors import InputError
from vision.numeric import Bools, Floats, Floats32, Ints, Strings, mad_sigma, nan_median
from vision.sheets.neighbours import predicted_by_neighbours
from vision.sheets.subpixel import position_noise
from vision.sheets.tracks import BETWEEN_FRAMES

LEAST_FRAMES = 30
LEAST_SHARING = 5  # sheets from which what all do together is told from what each does


@dataclass(frozen=True)
class Likeness:
    """What is needed to make films like a recording.

    Parameters
    ----------
    picture
        M on the grid `first_px`, `first_px` + 1/`per_px` …, grey levels, as spline coefficients.
    first_px, per_px
        Of the grid, in columns of the strip.
    rest_px
        Positions of the sheets in M, (sheet,).
    rigid_px
        Half width of the part of M that moves with each sheet, (sheet,).
    start_px
        Their positions in the run's first frame, (sheet,).
    motion_px
        Smooth positions, (frame, sheet), columns of the strip; the truth of films.
    smooth
        Where that is so, (frame, sheet): elsewhere they are as measured.
    common_px
        What all sheets do together in single frames, a part of it, (frame,).
    gain
        Brightness of each frame, (frame,).
    residual, slow
        R of the usable frames, (usable frame, x), without its slow part, (frame, x).  Paper that is pulled
        along the strip shows other grains, and with them ridges of another height: in another frame, where
        the sheet stands elsewhere, that would be an error of its position, so it stays where it was.
    reach
        Frames within which residuals change places.
    chained
        Whether the codec carries content, and with it errors, from frame to frame.
    slips
        Frames before which the sheets jump.
    strip
        The part of the recording that is imitated.
    usable
        Frames that the residuals are of.
    part
        Number of the part with the same brightness to which each frame belongs, (frame,).
    frozen
        Frames that repeat the one before, (frame,).
    disturbed
        Pixels around ridges that something else pulls aside or hides, (frame, x).
    ceiling
        Brightest pixel, where the camera may have clipped.
    encoder
        What films go through in place of getting residuals; None where those are put in.
    """

    picture: Floats
    first_px: float
    per_px: int
    rest_px: Floats
    rigid_px: Floats
    start_px: Floats
    motion_px: Floats
    smooth: Bools
    common_px: Floats
    gain: Floats
    residual: Floats32
    slow: Floats32
    reach: int
    chained: bool
    slips: Ints
    strip: xr.DataArray
    usable: Ints
    part: Ints
    frozen: Bools
    disturbed: Bools
    ceiling: float
    encoder: Encoder | None = None

    def film(self, motion_px: Floats, *, number: int | None) -> xr.DataArray:
        """A strip with these true positions (frame, sheet) and the residuals of other frames.

        They come in random order, another for each `number`, where frames are independent, from not too far
        away since light may change; where a codec carries content from frame to frame they keep their order
        and begin elsewhere. With an encoder the film is encoded anew instead, with another noise of pixels
        for each number. None: neither. With the recording's own motion its frozen and lost frames and its
        disturbed pixels are there, too.
        """
        frames, own = len(motion_px), motion_px is self.motion_px and number is not None
        columns = np.arange(self.strip.sizes["x"], dtype=float)
        recorded = np.asarray(self.strip.values, np.float32)
        gain = np.resize(self.gain, frames)
        values = np.empty((frames, columns.size), np.float32)
        for t in range(frames):
            values[t] = np.minimum(gain[t] * self._shown(columns, motion_px[t]), self.ceiling)
        noisy = number is not None and self.encoder is None
        if noisy and number is not None:
            values += self.residual[np.resize(self._sources(number), frames)]
        if own and noisy:
            values += self.slow
        values = np.minimum(values, self.ceiling)
        if own:
            values[self.disturbed] = recorded[self.disturbed]
            for t in np.flatnonzero(self.frozen).tolist():
                values[t] = values[max(t - 1, 0)]
        if number is not None and self.encoder is not None:
            width = self.encoder.width
            shown = self.shown_px(motion_px)[:, :width]
            values[:, :width] = self.encoder.again(values[:, :width], shown, seed=number)
        part = self.strip.isel(frame=np.arange(frames) % self.strip.sizes["frame"])
        status = np.full(frames, "ok", "<U8")
        if own:
            lost = ~np.isfinite(recorded).all(axis=1)
            values[lost] = np.nan
            status[lost] = part["status"].values[lost] if "status" in part.coords else "blank"
        film = part.copy(data=values)
        film["status"] = "frame", status
        return film.assign_coords(frame=np.arange(frames), time_s=("frame", self._times_s(frames)))

    def shown_px(self, motion_px: Floats) -> Floats:
        """Columns of the run's first frame that show what each column does when the sheets are at
        these positions (frame, sheet): (frame, x)."""
        columns = np.arange(self.strip.sizes["x"], dtype=float)
        return np.array([_material(columns, at, self.start_px, self.rigid_px) for at in motion_px])

    def _sources(self, number: int) -> Ints:
        """Which row of the residuals each frame gets, (frame,): one of the same brightness."""
        kept = len(self.usable)
        if self.chained:
            golden = 0.382  # so that any number of films begin at different places
            rolled = np.roll(np.arange(kept), -round(kept * ((1 + number) * golden % 1)))
            return np.resize(rolled, len(self.part))
        later = np.arange(kept) + np.random.default_rng(number).uniform(0, self.reach, kept)
        sources = np.zeros(len(self.part), np.int64)
        for part in np.unique(self.part):
            here = np.flatnonzero(self.part == part)
            rows = np.flatnonzero(self.part[self.usable] == part)
            rows = rows if rows.size else np.arange(kept)
            rows = rows[np.argsort(later[rows])]
            sources[here] = rows[np.arange(here.size) * rows.size // here.size]
        return sources

    def _times_s(self, frames: int) -> Floats:
        times = np.asarray(self.strip["time_s"].values, float)
        if frames <= times.size:
            return times[:frames]
        return np.asarray(times[0] + np.arange(frames) * float(np.median(np.diff(times))))

    def _shown(self, columns: Floats, at_px: Floats) -> Floats:
        """M as it is seen at these columns when the sheets are there."""
        material = _material(columns, at_px, self.rest_px, self.rigid_px)
        place = (material - self.first_px) * self.per_px
        return np.asarray(
            scipy.ndimage.map_coordinates(self.picture, place[None], order=3, mode="nearest", prefilter=False)
        )


def _material(columns: Floats, at_px: Floats, rest_px: Floats, rigid_px: Floats) -> Floats:
    """ξ of pixel columns: x − x_n + ξ_n near each sheet, stretched in between; beyond the last sheets the
    picture stands still."""
    here = np.column_stack([at_px - rigid_px, at_px + rigid_px]).ravel()
    rest = np.column_stack([rest_px - rigid_px, rest_px + rigid_px]).ravel()
    # Nothing moves with the outermost ridges further out than 3.5 times the part that is rigid.
    left, right = rest_px[0] - 3.5 * rigid_px[0], rest_px[-1] + 3.5 * rigid_px[-1]
    still = np.array([left - 1e4, left]), np.array([right, right + 1e4])
    here = np.maximum.accumulate(np.concatenate([still[0], here, still[1]]))
    rest = np.concatenate([still[0], rest, still[1]])
    return np.asarray(np.interp(columns, here, rest))


def learn(strip: xr.DataArray, tracks: xr.Dataset, settings: CertifySettings) -> Likeness:
    """Take a recording apart.

    Parameters
    ----------
    strip, tracks
        I(x, t) and x(n, t) of a run, frame by frame.
    settings
        Tunable constants.

    Raises
    ------
    InputError
        For fewer than 30 frames that show all but a few sheets.
    """
    part, start = _middle(tracks.sizes["frame"], settings.most_frames), np.asarray(tracks["x_px"].values[0])
    strip, tracks = strip.isel(frame=part), tracks.isel(frame=part)
    order = np.argsort(nan_median(tracks["x_px"].values))
    x_px = np.asarray(tracks["x_px"].values, float)[:, order] - float(strip["x"].values[0])
    values = np.asarray(strip.values, np.float32)
    seen = np.isfinite(x_px).mean(axis=1)
    least = min(settings.least_ok, float(np.median(seen)))
    whole = (seen >= least) & (seen > 0) & np.isfinite(values).all(axis=1)
    if whole.sum() < LEAST_FRAMES:
        raise InputError(
            "the run",
            f"{LEAST_FRAMES} frames that show the sheets",
            f"{int(whole.sum())}",
            "take a longer part",
        )
    flag, err = tracks["flag"].values[:, order], np.asarray(tracks["x_err_px"].values, float)[:, order]
    often = np.isfinite(x_px[whole]).mean(axis=0) > 0.5
    x_px, err, frozen = x_px[:, often], err[:, often], (flag == "frozen").all(axis=1)
    start = start[order][often] - float(strip["x"].values[0])
    slips = find_slips(x_px, settings)
    pulled = _pulled(err, flag[:, often], _beside(slips, len(x_px)), settings)
    chained = StripMetadata.of(strip).codec in BETWEEN_FRAMES
    motion, common, left = smooth_motion(x_px, slips, settings, chained=chained, pulled=pulled)
    usable = whole & ~_beside(slips, len(x_px))
    if usable.sum() < LEAST_FRAMES:
        usable = whole
    rest = nan_median(motion)
    there = float(
        np.nan_to_num(nan_median(start - rest))
    )  # where sheets are that the first frame does not show
    spacing = np.diff(rest)
    near = np.minimum(np.append(spacing, np.inf), np.insert(spacing, 0, np.inf))
    rigid = settings.rigid_share * np.where(np.isfinite(near), near, 20.0)
    width, per_px = values.shape[1], settings.grid_per_px
    margin = float(np.ceil(np.abs(motion - rest).max())) + 4
    grid = -margin + np.arange(int((width + 2 * margin) * per_px)) / per_px
    disturbed = _around(pulled | (~np.isfinite(x_px) & ~frozen[:, None]), motion, width)
    disturbed[~np.isfinite(values).all(axis=1)] = False
    ceiling = float(np.nanmax(values))
    clipped = values > ceiling - 0.5
    aside = disturbed | clipped if clipped.mean() > 1e-3 else disturbed
    gain = _gain(values, aside, usable)
    picture = _mean_picture(values, aside, gain, motion, np.flatnonzero(usable), grid, rest, rigid)
    likeness = Likeness(
        picture=np.asarray(scipy.ndimage.spline_filter1d(picture, order=3, mode="nearest")),
        first_px=float(grid[0]),
        per_px=per_px,
        rest_px=rest,
        rigid_px=rigid,
        start_px=np.where(np.isfinite(start), start, rest + there),
        motion_px=motion,
        smooth=left > 0,
        common_px=common,
        gain=gain,
        residual=np.zeros((1, width), np.float32),
        slow=np.zeros(values.shape, np.float32),
        reach=settings.longest_piece,
        chained=chained,
        slips=slips,
        strip=strip,
        usable=np.flatnonzero(usable),
        part=_parts(gain, settings),
        frozen=frozen,
        disturbed=disturbed,
        ceiling=ceiling,
    )
    columns = np.arange(width, dtype=float)
    frame = likeness.usable
    residual = np.array(
        [values[t] - np.minimum(gain[t] * likeness._shown(columns, motion[t]), ceiling) for t in frame],
        np.float32,
    )
    edges = np.union1d(slips, 1 + np.flatnonzero(np.diff(likeness.part)))
    slow = _slow_part(residual, frame, edges, len(motion), settings.slow_frames)
    as_measured = _around(left == 0, motion, width)  # the noise of positions is in the motion there
    residual = _undisturbed(residual - slow[frame], (disturbed | as_measured)[frame])
    # The smooth motion and the mean picture have taken up a part of the noise.
    smooth = left[usable][left[usable] > 0]
    share = float(smooth.mean()) * (1 - 1 / int(usable.sum())) if smooth.size else 0.2
    return replace(likeness, residual=residual / np.float32(np.sqrt(share)), slow=slow)


def _pulled(err_px: Floats, flag: Strings, beside: Bools, settings: CertifySettings) -> Bools:
    """Positions, (frame, sheet), of which the run itself says that something other than noise is in them."""
    usual = nan_median(err_px)
    usual = np.fmin(usual, nan_median(usual))
    with np.errstate(invalid="ignore"):
        large = (err_px > settings.pulled_errors * usual) & (flag == "ok")
    return np.asarray(large | ((flag == "blurred") & ~beside[:, None]))


def _around(which: Bools, motion: Floats, width: int) -> Bools:
    """Pixels, (frame, x), nearer to one of these sheets, (frame, sheet), than to any other."""
    columns, out = np.arange(width), np.zeros((len(motion), width), bool)
    for t in np.flatnonzero(which.any(axis=1)):
        middles = (motion[t, 1:] + motion[t, :-1]) / 2
        out[t] = which[t, np.searchsorted(middles, columns)]
    return out


def _gain(values: Floats32, disturbed: Bools, usable: Bools) -> Floats:
    """Brightness of each frame where nothing disturbs it, over the usual, (frame,)."""
    clear = np.where(disturbed, np.nan, values)
    typical = nan_median(clear[usable])
    known = np.isfinite(clear) & np.isfinite(typical)
    light = np.where(known, clear, 0.0).sum(axis=1, dtype=float)
    usual = np.where(known, typical, 0.0).sum(axis=1)
    gain = np.where((light > 0) & (usual > 0), light / np.maximum(usual, 1e-12), 1.0)  # 1 for blank frames
    return np.asarray(gain / np.median(gain[usable]))


def _parts(gain: Floats, settings: CertifySettings) -> Ints:
    """Numbers of the parts between steps of the brightness, (frame,)."""
    step = np.abs(np.diff(np.log(gain)))
    least = max(settings.gain_step, settings.step_errors * float(np.median(step)))
    return np.asarray(np.concatenate([[0], np.cumsum(step > least)]), np.int64)


def _undisturbed(residual: Floats32, disturbed: Bools) -> Floats32:
    """What belongs to a disturbance replaced by what the same column shows in the next frame without."""
    out, row = residual.copy(), np.arange(len(residual))
    for x in np.flatnonzero(disturbed.any(axis=0)):
        clear = row[~disturbed[:, x]]
        if clear.size:
            out[:, x] = residual[clear[np.searchsorted(clear, row) % clear.size], x]
    return out


def _slow_part(residual: Floats32, frame: Ints, slips: Ints, frames: int, window: int) -> Floats32:
    """The residual averaged over neighbouring frames between slips, (frame, x); zero where none is usable."""
    slow = np.zeros((frames, residual.shape[1]), np.float32)
    edges = np.unique(np.concatenate([[0, frames], slips]))
    for start, stop in pairwise(edges):
        inside = (frame >= start) & (frame < stop)
        if inside.sum() >= window:
            slow[frame[inside]] = scipy.ndimage.uniform_filter1d(
                residual[inside], window, axis=0, mode="nearest"
            )
    return slow


def _middle(frames: int, most: int) -> slice:
    first = max(0, (frames - most) // 2)
    return slice(first, min(frames, first + most))


def _beside(slips: Ints, frames: int) -> Bools:
    """Frames that a slip may have blurred: the last before and the first after it."""
    beside = np.zeros(frames, bool)
    for step in (-1, 0):
        beside[np.clip(slips + step, 0, frames - 1)] = True
    return beside


def find_slips(x_px: Floats, settings: CertifySettings) -> Ints:
    """Frames before which sheets jump, from how much their steps differ from sheet to sheet.

    Steps that all sheets share are the camera's.
    """
    step = np.diff(x_px, axis=0)
    step = step - nan_median(step, axis=1)[:, None]
    with np.errstate(invalid="ignore"):
        noise = nan_median(np.abs(step - nan_median(step)))
    size = np.nan_to_num(nan_median(np.abs(step) / np.maximum(noise, 1e-6), axis=1))
    limit = np.median(size) + settings.step_errors * max(
        float(mad_sigma(size)), 0.05 * float(np.median(size))
    )
    return np.flatnonzero(size > limit) + 1


def smooth_motion(
    x_px: Floats,
    slips: Ints,
    settings: CertifySettings,
    *,
    chained: bool = False,
    pulled: Bools | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Positions without noise, (frame, sheet), what all sheets share of them in single frames, (frame,), and
    the share of the noise's variance not in them, (frame, sheet): 0 where positions are as measured.

    Between slips a cubic (a parabola in short pieces) through as many frames as it fits each sheet, plus what
    all sheets do together in each frame; where none fits, as measured. It is a cubic in the sheets' own time,
    see `own_time`. Codecs that chain frames make steps that are no motion: fits are kept. Positions that are
    `pulled` aside are no motion either: there a sheet moves as those around it.
    """
    frames, sheets = x_px.shape
    x_px, raw = (x_px, x_px) if pulled is None else (np.where(pulled, np.nan, x_px), x_px)
    filled, left = _filled(x_px, raw), np.zeros(x_px.shape)
    motion, blurred = filled.copy(), _beside(slips, frames)
    noise = np.nan_to_num(position_noise(x_px), nan=np.inf)
    time = own_time(x_px, slips, settings)
    edges = np.unique(np.concatenate([[0, frames], slips]))
    waiting = []
    for start, stop in pairwise(edges):
        parts = max(1, round((stop - start) / settings.longest_piece))
        waiting += [(piece, np.arange(sheets)) for piece in np.array_split(np.arange(start, stop), parts)]
    while waiting:
        piece, which = waiting.pop()
        sharp = piece[~blurred[piece]]
        if piece.size < settings.least_piece or not which.size:
            continue
        degree = 3 if piece.size >= 2 * settings.least_piece else 2
        span = max(time[piece[-1]] - time[piece[0]], 1.0)
        basis = np.polynomial.legendre.legvander(2 * (time[piece] - time[piece[0]]) / span - 1, degree)
        inner = basis[~blurred[piece]]
        measured = filled[np.ix_(piece, which)]
        fitted = basis @ np.linalg.lstsq(inner, measured[~blurred[piece]], rcond=None)[0]
        off = (measured - fitted)[~blurred[piece]]
        if which.size >= LEAST_SHARING:
            off = off - np.median(off, axis=1)[:, None]
        fits = chained | (np.sqrt((off**2).mean(axis=0)) < settings.misfit * noise[which])
        motion[np.ix_(piece, which[fits])] = fitted[:, fits]
        left[np.ix_(sharp, which[fits])] = 1 - (np.linalg.qr(inner)[0] ** 2).sum(axis=1)[:, None]
        waiting += [(half, which[~fits]) for half in np.array_split(piece, 2)]
    common = np.nan_to_num(nan_median(x_px - motion, axis=1)) if sheets >= LEAST_SHARING else np.zeros(frames)
    shared = 1 - 1.57 / sheets if sheets >= LEAST_SHARING else 1.0  # a median's variance is π/2 of a mean's
    motion += np.where(left > 0, common[:, None], 0.0)
    return motion, common, left * shared


def own_time(x_px: Floats, slips: Ints, settings: CertifySettings) -> Floats:
    """Time that went by for the sheets, in frames, (frame,): more where frames were dropped, none where one
    was written twice.

    Each step of all sheets is compared with their usual steps around it; the number of frames that it took is
    rounded, and is that of the film where steps are too small against the noise to tell it.
    """
    frames = len(x_px)
    new = np.flatnonzero(np.isfinite(x_px).mean(axis=1) > 0.5)
    taken = np.diff(new).astype(float)
    if new.size < 2 * settings.least_piece or x_px.shape[1] < LEAST_SHARING:
        return np.arange(frames, dtype=float)
    step = np.diff(x_px[new], axis=0)
    step = step - nan_median(step, axis=1)[:, None]
    noise = float(np.nan_to_num(nan_median(position_noise(x_px)), nan=np.inf))
    slipped = np.diff(np.searchsorted(slips, new, side="right")) > 0
    per_frame = np.where(slipped[:, None], np.nan, step)
    for k in np.flatnonzero(~slipped):
        around = slice(max(0, k - settings.least_piece), k + settings.least_piece + 1)
        usual = np.nan_to_num(nan_median(per_frame[around]))
        weight = float((usual**2).sum())
        error = np.sqrt(2) * noise / np.sqrt(max(weight, 1e-24))
        ratio = float(np.nan_to_num(step[k]) @ usual) / max(weight, 1e-24)
        if error < settings.own_time_error:
            taken[k] = np.clip(np.rint(ratio), 0, 2 * settings.least_piece)
    total = np.concatenate([[0.0], np.cumsum(taken)])
    return np.asarray(np.interp(np.arange(frames), new, total), float)


def _filled(x_px: Floats, raw_px: Floats) -> Floats:
    """Gaps filled with what the sheets around do; where none is seen by straight lines in time, ends held."""
    place = nan_median(raw_px)
    filled = np.where(np.isfinite(x_px), x_px, predicted_by_neighbours(x_px))
    moved, sheet = filled - place, np.arange(x_px.shape[1])
    known = np.isfinite(moved)
    for t in np.flatnonzero(~known.all(axis=1) & known.any(axis=1)):
        there = sheet[known[t]]
        here = moved[t, there]
        moved[t] = np.interp(sheet, there, here)
        for outer, inner in ((0, 3), (-1, -4)) if there.size > 3 else ():  # on beyond the last sheets seen
            slope = (here[inner] - here[outer]) / (there[inner] - there[outer])
            beyond = (sheet < there[0]) if outer == 0 else (sheet > there[-1])
            moved[t, beyond] = here[outer] + slope * (sheet[beyond] - there[outer])
    filled, frame = place + moved, np.arange(len(x_px))
    for column in filled.T:
        there = np.isfinite(column)
        column[~there] = np.interp(frame[~there], frame[there], column[there])
    return np.asarray(filled)


def _mean_picture(
    values: Floats32,
    disturbed: Bools,
    gain: Floats,
    motion: Floats,
    usable: Ints,
    grid: Floats,
    rest: Floats,
    rigid: Floats,
) -> Floats:
    """M on the grid, from what is not disturbed where there is such."""
    total, weights = np.zeros((2, grid.size)), np.zeros((2, grid.size))
    column = np.arange(values.shape[1])
    for t in usable:
        seen = _material(grid, rest, motion[t], rigid)  # the column at which each point of M is seen
        coefficients = scipy.ndimage.spline_filter1d(values[t].astype(float), order=3, mode="nearest")
        shown = (
            scipy.ndimage.map_coordinates(coefficients, seen[None], order=3, mode="nearest", prefilter=False)
            / gain[t]
        )
        clear = 1.0 - np.interp(seen, column, disturbed[t].astype(float))
        for k, weight in enumerate((clear, np.ones_like(clear))):
            total[k] += weight * shown
            weights[k] += weight
    mean = np.where(weights[0] > 1, total[0] / np.maximum(weights[0], 1e-9), total[1] / weights[1])
    return np.asarray(mean, np.float64)

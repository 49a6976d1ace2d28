"""Separate a recording into mean picture, motion and residuals, and make films with known truth of them.

A frame is g(t) M(ξ(x, t)) + R(x, t). M is the mean picture in the coordinate ξ of the sheets at rest, which
moves with them; it holds the shape of each ridge, the gaps and the light. g is the brightness of the frame.
The residual R holds noise, unequal pixels, and errors of the codec.  Motion is smooth between slips, so that
the noise of positions is in R and not in the motion.  A film with another motion, or with the residuals of
other frames, has exactly known positions.

Films have the defects of the recording: steps of the brightness, and repeated or missing frames. Where
something distorts ridges (dirt, a highlight, a hand), they show the recorded pixels, and the true motion is
that of the neighbouring sheets.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy
import xarray as xr

from vision.certify.encoder import Encoder
from vision.certify.settings import CertifySettings
from vision.data import StripMetadata
from vision.errors import InputError
from vision.numeric import Bools, Floats, Floats32, Ints, Strings, mad_sigma, nan_median, weighted_median
from vision.sheets.doubts import predicted_by_neighbours
from vision.sheets.subpixel import position_noise
from vision.video.reader import BETWEEN_FRAMES


@dataclass(frozen=True)
class MeanPicture:
    """M(ξ), the mean picture in the coordinate of the sheets at rest."""

    # spline coefficients of M, grey levels, on the grid `first_px`, `first_px` + 1/`per_px` …
    coefficients: Floats
    # first_px, per_px: first point of the grid, in columns of the strip, and points per pixel
    first_px: float
    per_px: int
    rest_px: Floats  # positions of the sheets in M, (sheet,)
    rigid_px: Floats  # half width of the part of M that moves with each sheet, (sheet,)

    def shown(self, columns: Floats, at_px: Floats) -> Floats:
        """Return M at these columns when the sheets are at `at_px` (sheet,)."""
        material = _material(columns, at_px, self.rest_px, self.rigid_px)
        index = (material - self.first_px) * self.per_px
        return _spline(self.coefficients, index)


@dataclass(frozen=True)
class Residuals:
    """R(x, t), what the mean picture does not explain."""

    # values, slow: R of the usable frames, (usable frame, x), without its slow part, (frame, x). The slow
    # part is not exchanged between frames: it contains the grain of paper that moves along the strip, which
    # changes the height of ridges, and would be an error of the position in another frame.
    values: Floats32
    slow: Floats32
    usable: Ints  # frames with residuals
    part: Ints  # number of the part of constant brightness to which each frame belongs, (frame,)
    reach: int  # number of frames within which residuals are exchanged
    # whether the codec predicts frames from others, and so carries errors from frame to frame
    between_frames: bool

    def exchanged(self, number: int) -> Floats32:
        """Return for each frame the residual of another one, (frame, x), of the same brightness if possible.

        The order is random, differs with `number`, and stays within `reach`, as the light may change. With a
        codec that predicts frames, residuals keep their order and begin at another frame.
        """
        count = len(self.usable)
        if self.between_frames:
            golden = 0.382  # makes any number of films begin at different frames
            rolled = np.roll(np.arange(count), -round(count * ((1 + number) * golden % 1)))
            return self.values[np.resize(rolled, len(self.part))]
        later = np.arange(count) + np.random.default_rng(number).uniform(0, self.reach, count)
        sources = np.zeros(len(self.part), np.int64)
        for part in np.unique(self.part):
            frames = np.flatnonzero(self.part == part)
            rows = np.flatnonzero(self.part[self.usable] == part)
            rows = rows if rows.size else np.arange(count)
            rows = rows[np.argsort(later[rows])]
            sources[frames] = rows[np.arange(frames.size) * rows.size // frames.size]
        return self.values[sources]


@dataclass(frozen=True)
class Likeness:
    """Everything that is needed to make films like a recording."""

    # strip, frames: the part of the recording that is imitated, and its frames in the run
    strip: xr.DataArray
    frames: slice
    # picture, gain, residuals: M, brightness g of each frame, (frame,), and R
    picture: MeanPicture
    gain: Floats
    residuals: Residuals
    motion_px: Floats  # smooth positions, (frame, sheet), columns of the strip; the truth of films
    smooth: Bools  # whether they are smooth, (frame, sheet), and not as measured
    common_px: Floats  # common motion of all sheets in single frames, which is part of `motion_px`, (frame,)
    start_px: Floats  # positions of the sheets in the run's first frame, (sheet,)
    slips: Ints  # frames before which the sheets jump
    frozen: Bools  # frames that repeat the one before, (frame,)
    disturbed: Bools  # pixels around ridges that are distorted or hidden, (frame, x)
    ceiling: float  # brightest pixel, at which the camera may have clipped
    # encoder that films pass through instead of getting residuals; None to use residuals
    encoder: Encoder | None = None

    def film(self, motion_px: Floats, *, number: int | None) -> xr.DataArray:
        """Return a strip with these true positions (frame, sheet) and the residuals of other frames.

        `number` chooses the residuals, see `Residuals.exchanged`. With an encoder the film is encoded
        instead, with pixel noise that differs with `number`. Without a number the film has neither. With the
        recording's own motion, it also has the recording's frozen and lost frames and disturbed pixels.
        """
        frames, own = len(motion_px), motion_px is self.motion_px and number is not None
        columns = np.arange(self.strip.sizes["x"], dtype=float)
        recorded = np.asarray(self.strip.values, np.float32)
        gain = np.resize(self.gain, frames)
        values = np.empty((frames, columns.size), np.float32)
        for t in range(frames):
            values[t] = np.minimum(gain[t] * self.picture.shown(columns, motion_px[t]), self.ceiling)
        if number is not None and self.encoder is None:
            values += np.resize(self.residuals.exchanged(number), values.shape)
            if own:
                values += self.residuals.slow
        values = np.minimum(values, self.ceiling)
        if own:
            values[self.disturbed] = recorded[self.disturbed]
            for t in np.flatnonzero(self.frozen).tolist():
                values[t] = values[max(t - 1, 0)]
        if number is not None and self.encoder is not None:
            width = self.encoder.width
            shown = self.shown_px(motion_px)[:, :width]
            values[:, :width], _ = self.encoder.encode(values[:, :width], shown, seed=number)
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
        """Return the column of the run's first frame that each column shows, for positions (frame, sheet)."""
        columns, rigid = np.arange(self.strip.sizes["x"], dtype=float), self.picture.rigid_px
        return np.array([_material(columns, at, self.start_px, rigid) for at in motion_px])

    def _times_s(self, frames: int) -> Floats:
        times = np.asarray(self.strip["time_s"].values, float)
        if frames <= times.size:
            return times[:frames]
        return np.asarray(times[0] + np.arange(frames) * float(np.median(np.diff(times))))


def _spline(coefficients: Floats, index: Floats) -> Floats:
    """Return the cubic spline with these coefficients at fractional indices, its end values beyond."""
    return np.asarray(
        scipy.ndimage.map_coordinates(coefficients, index[None], order=3, mode="nearest", prefilter=False)
    )


def _coefficients(values: Floats) -> Floats:
    """Return the coefficients of the cubic spline through these values."""
    return np.asarray(scipy.ndimage.spline_filter1d(values.astype(float), order=3, mode="nearest"))


def _material(columns: Floats, at_px: Floats, rest_px: Floats, rigid_px: Floats) -> Floats:
    """Return ξ of pixel columns: x − x_n + ξ_n near each sheet n, and stretched in between. The picture is
    stationary beyond 3.5 times `rigid_px` outside the outermost sheets."""
    moved = np.column_stack([at_px - rigid_px, at_px + rigid_px]).ravel()
    rest = np.column_stack([rest_px - rigid_px, rest_px + rigid_px]).ravel()
    left, right = rest_px[0] - 3.5 * rigid_px[0], rest_px[-1] + 3.5 * rigid_px[-1]
    before, after = np.array([left - 1e4, left]), np.array([right, right + 1e4])
    moved = np.maximum.accumulate(np.concatenate([before, moved, after]))
    rest = np.concatenate([before, rest, after])
    return np.asarray(np.interp(columns, moved, rest))


def learn(strip: xr.DataArray, tracks: xr.Dataset, settings: CertifySettings) -> Likeness:
    """Separate a recording into mean picture, motion and residuals.

    strip, tracks: I(x, t) and x(n, t) of a run, with the same frames.  settings: tunable constants.
    Raises: InputError for fewer than `settings.least_frames` that show all but a few sheets.
    """
    start, frames = np.asarray(tracks["x_px"].values[0]), tracks.sizes["frame"]
    first = max(0, (frames - settings.most_frames) // 2)
    part = slice(first, min(frames, first + settings.most_frames))  # the middle of the run
    strip, tracks = strip.isel(frame=part), tracks.isel(frame=part)
    values, first_px = np.asarray(strip.values, np.float32), float(strip["x"].values[0])
    width = values.shape[1]

    # Positions, from left to right, of the sheets that most of the usable frames show.
    order = np.argsort(nan_median(tracks["x_px"].values))
    x_px, err_px, flag = (tracks[name].values[:, order] for name in ("x_px", "x_err_px", "flag"))
    x_px = np.asarray(x_px, float) - first_px
    whole = _whole(x_px, values, settings)
    often = np.isfinite(x_px[whole]).mean(axis=0) > 0.5
    frozen = (flag == "frozen").all(axis=1)
    x_px, err_px, flag = x_px[:, often], err_px[:, often], flag[:, often]

    # Their smooth motion.
    slips = find_jumps(x_px, settings)
    beside = _beside(slips, len(x_px))
    distorted = _distorted(x_px, err_px, flag, beside, settings)
    between_frames = StripMetadata.of(strip).codec in BETWEEN_FRAMES
    motion, common, left = smooth_motion(
        x_px, slips, settings, between_frames=between_frames, distorted=distorted
    )

    # The mean picture, from pixels that nothing disturbs or clips.
    usable = whole & ~beside
    if usable.sum() < settings.least_frames:
        usable = whole
    disturbed = _around(distorted | (~np.isfinite(x_px) & ~frozen[:, None]), motion, width)
    disturbed[~np.isfinite(values).all(axis=1)] = False
    ceiling = float(np.nanmax(values))
    clipped = values > ceiling - 0.5
    excluded = disturbed | clipped if clipped.mean() > 1e-3 else disturbed
    gain = _gain(values, excluded, usable)
    kept = np.flatnonzero(usable)
    picture = _mean_picture(values, excluded, gain, motion, kept, settings)

    # What it does not explain; where positions are as measured, their noise is in the motion.
    columns = np.arange(width, dtype=float)
    shown = np.array([gain[t] * picture.shown(columns, motion[t]) for t in kept])
    residual = np.asarray(values[kept] - np.minimum(shown, ceiling), np.float32)
    without = disturbed | _around(left == 0, motion, width)
    parts = _parts(gain, settings)
    residuals = _residuals(residual, kept, parts, slips, without, left, between_frames, settings)

    # Sheets that have no position in the run's first frame are displaced as the others are.
    start = start[order][often] - first_px
    offset = float(np.nan_to_num(nan_median(start - picture.rest_px)))
    return Likeness(
        strip=strip,
        frames=part,
        picture=picture,
        gain=gain,
        residuals=residuals,
        motion_px=motion,
        smooth=left > 0,
        common_px=common,
        start_px=np.where(np.isfinite(start), start, picture.rest_px + offset),
        slips=slips,
        frozen=frozen,
        disturbed=disturbed,
        ceiling=ceiling,
    )


def _whole(x_px: Floats, values: Floats32, settings: CertifySettings) -> Bools:
    """Return which frames show all but a few sheets, (frame,).  Raises: InputError for too few."""
    seen = np.isfinite(x_px).mean(axis=1)
    least = min(settings.least_ok, float(np.median(seen)))
    whole = np.asarray((seen >= least) & (seen > 0) & np.isfinite(values).all(axis=1))
    if whole.sum() < settings.least_frames:
        expected, found = f"{settings.least_frames} frames that show the sheets", f"{int(whole.sum())}"
        raise InputError("the run", expected, found, "take a longer part")
    return whole


def _residuals(
    residual: Floats32,
    usable: Ints,
    part: Ints,
    slips: Ints,
    excluded: Bools,
    left: Floats,
    between_frames: bool,
    settings: CertifySettings,
) -> Residuals:
    """Return residuals that may be exchanged, from those of the usable frames, (usable frame, x).
    excluded: pixels that have none, (frame, x). left: share of the noise's variance that is not in the
    motion, (frame, sheet)."""
    edges = np.union1d(slips, 1 + np.flatnonzero(np.diff(part)))
    slow = _slow_part(residual, usable, edges, len(part), settings.slow_frames)
    residual = _undisturbed(residual - slow[usable], excluded[usable])
    # The smooth motion and the mean picture contain the rest of the noise.
    smooth = left[usable][left[usable] > 0]
    share = float(smooth.mean()) * (1 - 1 / len(usable)) if smooth.size else 0.2
    return Residuals(
        values=residual / np.float32(np.sqrt(share)),
        slow=slow,
        usable=usable,
        part=part,
        reach=settings.longest_piece,
        between_frames=between_frames,
    )


def _distorted(
    x_px: Floats, err_px: Floats, flag: Strings, beside: Bools, settings: CertifySettings
) -> Bools:
    """Return which positions, (frame, sheet), are distorted: of large error, or blurred without a slip. The
    error is large compared with the sheet's own in frames before and after, or with that of most sheets; and
    it is larger than the error with which neighbours predict a position, which replaces it."""
    own = nan_median(err_px)
    with np.errstate(invalid="ignore"):
        large = err_px > settings.distorted_errors * own
        lasting = err_px > settings.distorted_errors * nan_median(own)
        usual = np.where(large | lasting, np.nan, x_px)
        off = usual - predicted_by_neighbours(usual)
        known = off[np.isfinite(off)]
        seen = err_px > settings.neighbour_errors * (mad_sigma(known) if known.size else 0.0)
    clear = ~large & np.isfinite(x_px)
    before, after = np.logical_or.accumulate(clear), np.logical_or.accumulate(clear[::-1])[::-1]
    distorted = seen & ((large & before & after) | lasting)
    return np.asarray((distorted & (flag == "ok")) | ((flag == "blurred") & ~beside[:, None]))


def _around(which: Bools, motion: Floats, width: int) -> Bools:
    """Return which pixels, (frame, x), are nearest to one of these sheets, (frame, sheet)."""
    columns, pixels = np.arange(width), np.zeros((len(motion), width), bool)
    for t in np.flatnonzero(which.any(axis=1)):
        middles = (motion[t, 1:] + motion[t, :-1]) / 2
        pixels[t] = which[t, np.searchsorted(middles, columns)]
    return pixels


def _gain(values: Floats32, disturbed: Bools, usable: Bools) -> Floats:
    """Return the brightness of each frame relative to the typical one, from undisturbed pixels, (frame,)."""
    clear = np.where(disturbed, np.nan, values)
    typical = nan_median(clear[usable])
    known = np.isfinite(clear) & np.isfinite(typical)
    light = np.where(known, clear, 0.0).sum(axis=1, dtype=float)
    usual = np.where(known, typical, 0.0).sum(axis=1)
    gain = np.where((light > 0) & (usual > 0), light / np.maximum(usual, 1e-12), 1.0)  # 1 for blank frames
    return np.asarray(gain / np.median(gain[usable]))


def _parts(gain: Floats, settings: CertifySettings) -> Ints:
    """Return the number of the part between steps of the brightness for each frame, (frame,)."""
    step = np.abs(np.diff(np.log(gain)))
    least = max(settings.gain_step, settings.step_errors * float(np.median(step)))
    return np.asarray(np.concatenate([[0], np.cumsum(step > least)]), np.int64)


def _undisturbed(residual: Floats32, disturbed: Bools) -> Floats32:
    """Replace disturbed pixels by those of the same column in the next frame in which it is undisturbed."""
    replaced, row = residual.copy(), np.arange(len(residual))
    for x in np.flatnonzero(disturbed.any(axis=0)):
        clear = row[~disturbed[:, x]]
        if clear.size:
            replaced[:, x] = residual[clear[np.searchsorted(clear, row) % clear.size], x]
    return replaced


def _slow_part(residual: Floats32, frame: Ints, slips: Ints, frames: int, window: int) -> Floats32:
    """Return the residual averaged over neighbouring frames between slips, (frame, x); zero if unusable."""
    slow = np.zeros((frames, residual.shape[1]), np.float32)
    edges = np.unique(np.concatenate([[0, frames], slips]))
    for start, stop in pairwise(edges):
        inside = (frame >= start) & (frame < stop)
        if inside.sum() >= window:
            slow[frame[inside]] = scipy.ndimage.uniform_filter1d(
                residual[inside], window, axis=0, mode="nearest"
            )
    return slow


def _beside(slips: Ints, frames: int) -> Bools:
    """Return which frames a slip may have blurred: the last before and the first after it, (frame,)."""
    beside = np.zeros(frames, bool)
    for step in (-1, 0):
        beside[np.clip(slips + step, 0, frames - 1)] = True
    return beside


def find_jumps(x_px: Floats, settings: CertifySettings) -> Ints:
    """Return the frames before which sheets jump relative to each other; common steps are the camera's."""
    step = np.diff(x_px, axis=0)
    step = step - nan_median(step, axis=1)[:, None]
    with np.errstate(invalid="ignore"):
        noise = nan_median(np.abs(step - nan_median(step)))
    size = np.nan_to_num(nan_median(np.abs(step) / np.maximum(noise, 1e-6), axis=1))
    usual = float(np.median(size))
    spread = max(float(mad_sigma(size)), 0.05 * usual)
    return np.flatnonzero(size > usual + settings.step_errors * spread) + 1


def smooth_motion(
    x_px: Floats,
    slips: Ints,
    settings: CertifySettings,
    *,
    between_frames: bool = False,
    distorted: Bools | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Fit smooth positions between slips.

    The motion of each sheet is a parabola over as many frames as it fits, plus the common motion of all
    sheets in each frame. The parabola is one in the sheets' own time (`own_time`). If none
    fits, the motion is as measured. With codecs that predict frames from others (`between_frames`), all fits
    are used, as steps about them are no motion. At positions that are `distorted`, a sheet moves like its
    neighbours.

    Returns: positions without noise, (frame, sheet); the common motion in single frames, (frame,); and the
    share of the noise's variance that is not in them, (frame, sheet), which is 0 where positions are as
    measured.
    """
    frames, sheets = x_px.shape
    x_px, raw = (x_px, x_px) if distorted is None else (np.where(distorted, np.nan, x_px), x_px)
    filled, left = _filled(x_px, raw), np.zeros(x_px.shape)
    motion, blurred = filled.copy(), _beside(slips, frames)
    noise = np.nan_to_num(position_noise(x_px), nan=np.inf)
    time = own_time(x_px, slips, settings)
    edges = np.unique(np.concatenate([[0, frames], slips]))
    waiting = []
    for start, stop in pairwise(edges):
        parts = max(1, round((stop - start) / settings.longest_piece))
        waiting += [(piece, np.arange(sheets)) for piece in np.array_split(np.arange(start, stop), parts)]
    common, shared = np.zeros(frames), sheets >= settings.least_sharing
    for piece, which in waiting if shared else ():
        inner = piece[~blurred[piece]]
        if piece.size >= settings.least_piece:
            off = filled[inner] - _smoothed(time, piece, inner, filled, which)[0][~blurred[piece]]
            common[inner] = np.median(off, axis=1)
    steady = filled - common[:, None]
    while waiting:
        piece, which = waiting.pop()
        inner = piece[~blurred[piece]]
        if piece.size < settings.least_piece or not which.size:
            continue
        fitted, leverage = _smoothed(time, piece, inner, steady, which)
        off = (steady[np.ix_(piece, which)] - fitted)[~blurred[piece]]
        fits = between_frames | (np.sqrt((off**2).mean(axis=0)) < settings.misfit * noise[which])
        motion[np.ix_(piece, which[fits])] = fitted[:, fits]
        left[np.ix_(inner, which[fits])] = 1 - leverage[:, None]
        waiting += [(half, which[~fits]) for half in np.array_split(piece, 2)]
    # Of N sheets, each less their median, 1 - 2/N + (π/2)/N of the noise's variance is left.
    share = 1 - (2 - np.pi / 2) / sheets if shared else 1.0
    motion += np.where(left > 0, common[:, None], 0.0)
    return motion, common, left * share


def _smoothed(time: Floats, piece: Ints, inner: Ints, x_px: Floats, which: Ints) -> tuple[Floats, Floats]:
    """Return parabolas through the frames `inner` of a piece at all its frames, (frame, which), and their
    leverage at `inner`."""
    span = max(time[piece[-1]] - time[piece[0]], 1.0)
    basis = np.polynomial.legendre.legvander(2 * (time[piece] - time[piece[0]]) / span - 1, 2)
    at_inner = basis[np.isin(piece, inner)]
    coefficients = np.linalg.lstsq(at_inner, x_px[np.ix_(inner, which)], rcond=None)[0]
    return basis @ coefficients, np.asarray((np.linalg.qr(at_inner)[0] ** 2).sum(axis=1))


def own_time(x_px: Floats, slips: Ints, settings: CertifySettings) -> Floats:
    """Return the time of the sheets' motion at each frame, in frames, (frame,).

    It advances by more than one where frames were dropped, and by none where one was written twice. Each step
    of all sheets is compared with their typical steps around it, and the number of frames that it took is
    rounded. It is one if steps are too small relative to the noise.
    """
    frames = len(x_px)
    new = np.flatnonzero(np.isfinite(x_px).mean(axis=1) > 0.5)
    taken = np.diff(new).astype(float)
    if new.size < 2 * settings.least_piece or x_px.shape[1] < settings.least_sharing:
        return np.arange(frames, dtype=float)
    step = np.diff(x_px[new], axis=0)
    step = step - nan_median(step, axis=1)[:, None]
    noise = float(np.nan_to_num(nan_median(position_noise(x_px)), nan=np.inf))
    slipped = np.diff(np.searchsorted(slips, new, side="right")) > 0
    per_frame = np.where(slipped[:, None], np.nan, step)
    for k in np.flatnonzero(~slipped):
        around = slice(max(0, k - settings.least_piece), k + settings.least_piece + 1)
        typical = np.nan_to_num(nan_median(per_frame[around]))
        weight = float((typical**2).sum())
        error = np.sqrt(2) * noise / np.sqrt(max(weight, 1e-24))
        known = np.isfinite(step[k]) & (typical != 0)
        if error < settings.own_time_error and known.any():
            ratios, weights = step[k, known] / typical[known], typical[known] ** 2
            # A median, so that a sheet that slips by itself does not count.
            taken[k] = np.clip(np.rint(weighted_median(ratios, weights)), 0, 2 * settings.least_piece)
    total = np.concatenate([[0.0], np.cumsum(taken)])
    return np.asarray(np.interp(np.arange(frames), new, total), float)


def _filled(x_px: Floats, raw_px: Floats) -> Floats:
    """Fill gaps by the displacement of neighbours, and frames without any sheet by linear interpolation."""
    rest, frame = nan_median(raw_px), np.arange(len(x_px))
    predicted = predicted_by_neighbours(x_px)
    for n, off in enumerate((x_px - predicted).T):  # how far each sheet was from its neighbours' prediction
        seen = np.isfinite(off)
        if seen.any():
            predicted[:, n] += np.interp(frame, frame[seen], off[seen])
    filled = np.where(np.isfinite(x_px), x_px, predicted)
    moved, sheet = filled - rest, np.arange(x_px.shape[1])
    known = np.isfinite(moved)
    for t in np.flatnonzero(~known.all(axis=1) & known.any(axis=1)):
        moved[t] = np.interp(sheet, sheet[known[t]], moved[t, known[t]])
    filled = rest + moved
    for column in filled.T:
        finite = np.isfinite(column)
        column[~finite] = np.interp(frame[~finite], frame[finite], column[finite])
    return np.asarray(filled)


def _mean_picture(
    values: Floats32, excluded: Bools, gain: Floats, motion: Floats, usable: Ints, settings: CertifySettings
) -> MeanPicture:
    """Return M from the usable frames, from pixels that are not excluded if a point has any."""
    rest, per_px = nan_median(motion), settings.grid_per_px
    spacing = np.diff(rest)
    near = np.minimum(np.append(spacing, np.inf), np.insert(spacing, 0, np.inf))
    rigid = settings.rigid_share * np.where(np.isfinite(near), near, 20.0)
    margin = float(np.ceil(np.abs(motion - rest).max())) + 4
    column = np.arange(values.shape[1])
    grid = -margin + np.arange(int((column.size + 2 * margin) * per_px)) / per_px
    total, weights = np.zeros((2, grid.size)), np.zeros((2, grid.size))
    for t in usable:
        column_of = _material(grid, rest, motion[t], rigid)  # column that shows each point of M
        shown = _spline(_coefficients(values[t]), column_of) / gain[t]
        clear = 1.0 - np.interp(column_of, column, excluded[t].astype(float))
        for k, weight in enumerate((clear, np.ones_like(clear))):
            total[k] += weight * shown
            weights[k] += weight
    mean = np.where(weights[0] > 1, total[0] / np.maximum(weights[0], 1e-9), total[1] / weights[1])
    return MeanPicture(_coefficients(mean), float(grid[0]), per_px, rest, rigid)

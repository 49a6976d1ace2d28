"""The recording taken apart into what it shows, how that moves, and everything else; and put together again.

A frame is g(t) M(ξ(x, t)) + R(x, t): the mean picture M in the coordinate ξ of the sheets at rest, which
moves with them and holds each ridge's own shape, the gaps and the light; the brightness g of the frame; and
the residual R, which holds noise, unequal pixels, and what the codec added or took away.  Motion is smooth
between slips; the noise of positions is therefore in R and not in the motion.  A film with another motion, or
with the residuals of other frames, has exactly known positions.
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
from vision.numeric import Bools, Floats, Floats32, Ints, mad_sigma, nan_median
from vision.sheets.subpixel import position_noise
from vision.sheets.tracks import BETWEEN_FRAMES

LEAST_FRAMES = 30
BEYOND = 3.5  # half widths of the outermost ridge from its middle, beyond which nothing moves with it
FAR_PX = 1e4
LEAST_SHARING = 5  # sheets from which what all do together is told from what each does

LEAST_LEFT = 0.2  # of the noise, where pieces are too short for the smooth motion to leave any


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
    motion_px
        Smooth positions, (frame, sheet), columns of the strip; frames in which they are truth.
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
    encoder
        What films go through in place of getting residuals; None where those are put in.
    """

    picture: Floats
    first_px: float
    per_px: int
    rest_px: Floats
    rigid_px: Floats
    motion_px: Floats
    gain: Floats
    residual: Floats32
    slow: Floats32
    reach: int
    chained: bool
    slips: Ints
    strip: xr.DataArray
    encoder: Encoder | None = None

    def film(self, motion_px: Floats, *, number: int | None) -> xr.DataArray:
        """A strip with these true positions (frame, sheet) and the residuals of other frames.

        They come in random order, another for each `number`, where frames are independent, from not too far
        away since light may change; where a codec carries content from frame to frame they keep their order
        and begin elsewhere. With an encoder the film is encoded anew instead, with another noise of pixels
        for each number. None: neither.
        """
        frames = len(motion_px)
        columns = np.arange(self.strip.sizes["x"], dtype=float)
        gain = np.resize(self.gain, frames)
        values = np.empty((frames, columns.size), np.float32)
        for t in range(frames):
            values[t] = gain[t] * self._shown(columns, motion_px[t])
        if number is not None and self.encoder is not None:
            values[:, : self.encoder.width] = self.encoder.again(values[:, : self.encoder.width], seed=number)
        elif number is not None:
            values += self.residual[np.resize(self._order(number), frames)]
            if motion_px is self.motion_px:
                values += self.slow
        part = self.strip.isel(frame=np.arange(frames) % self.strip.sizes["frame"])
        film = part.copy(data=values)
        film["status"] = "frame", np.full(frames, "ok")
        return film.assign_coords(frame=np.arange(frames), time_s=("frame", self._times_s(frames)))

    def _order(self, number: int) -> Ints:
        """Which frame's residual goes where."""
        kept = len(self.residual)
        if not self.chained:
            later = np.random.default_rng(number).uniform(0, self.reach, kept)
            return np.argsort(np.arange(kept) + later)
        golden = 0.382  # so that any number of films begin at different places
        return np.roll(np.arange(kept), -round(kept * ((1 + number) * golden % 1)))

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
    left, right = rest_px[0] - BEYOND * rigid_px[0], rest_px[-1] + BEYOND * rigid_px[-1]
    still = np.array([left - FAR_PX, left]), np.array([right, right + FAR_PX])
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
    part = _middle(tracks.sizes["frame"], settings.most_frames)
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
    x_px = x_px[:, np.isfinite(x_px[whole]).mean(axis=0) > 0.5]
    slips = find_slips(x_px, settings)
    chained = StripMetadata.of(strip).codec in BETWEEN_FRAMES
    motion, left = smooth_motion(x_px, slips, settings, chained=chained)
    usable = whole & ~_beside(slips, len(x_px))
    if usable.sum() < LEAST_FRAMES:
        usable = whole
    rest = nan_median(motion)
    spacing = np.diff(rest)
    near = np.minimum(np.append(spacing, np.inf), np.insert(spacing, 0, np.inf))
    rigid = settings.rigid_share * np.where(np.isfinite(near), near, 20.0)
    width, per_px = values.shape[1], settings.grid_per_px
    margin = float(np.ceil(np.abs(motion - rest).max())) + 4
    grid = -margin + np.arange(int((width + 2 * margin) * per_px)) / per_px
    picture, gain = _mean_picture(values, motion, np.flatnonzero(usable), grid, rest, rigid)
    likeness = Likeness(
        picture=np.asarray(scipy.ndimage.spline_filter1d(picture, order=3, mode="nearest")),
        first_px=float(grid[0]),
        per_px=per_px,
        rest_px=rest,
        rigid_px=rigid,
        motion_px=motion,
        gain=gain,
        residual=np.zeros((1, width), np.float32),
        slow=np.zeros(values.shape, np.float32),
        reach=settings.longest_piece,
        chained=chained,
        slips=slips,
        strip=strip,
    )
    columns = np.arange(width, dtype=float)
    frame = np.flatnonzero(usable)
    residual = np.array(
        [values[t] - gain[t] * likeness._shown(columns, motion[t]) for t in frame], np.float32
    )
    slow = _slow_part(residual, frame, slips, len(motion), settings.slow_frames)
    residual -= slow[frame]
    # The smooth motion and the mean picture have taken up a part of the noise.
    share = max(float(left[usable].mean()) * (1 - 1 / int(usable.sum())), LEAST_LEFT)
    return replace(likeness, residual=residual / np.float32(np.sqrt(share)), slow=slow)


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
    size = nan_median(((step / np.maximum(noise, 1e-6)) ** 2), axis=1) ** 0.5
    size = np.nan_to_num(size)
    limit = np.median(size) + settings.step_errors * max(
        float(mad_sigma(size)), 0.05 * float(np.median(size))
    )
    return np.flatnonzero(size > limit) + 1


def smooth_motion(
    x_px: Floats, slips: Ints, settings: CertifySettings, *, chained: bool = False
) -> tuple[Floats, Floats]:
    """Positions without noise, (frame, sheet), and the share of the noise's variance not in them, (frame,).

    Between slips a cubic (a parabola in short pieces) through as many frames as it fits, plus what all sheets
    do together in each frame. Codecs that chain frames make steps that are no motion: fits are kept.
    """
    frames, sheets = x_px.shape
    filled, left = _filled(x_px), np.zeros(frames)
    motion, blurred = filled.copy(), _beside(slips, frames)
    noise = np.nan_to_num(position_noise(x_px), nan=np.inf)
    edges = np.unique(np.concatenate([[0, frames], slips]))
    waiting = []
    for start, stop in pairwise(edges):
        waiting += np.array_split(
            np.arange(start, stop), max(1, round((stop - start) / settings.longest_piece))
        )
    while waiting:
        piece = waiting.pop()
        sharp = piece[~blurred[piece]]
        if piece.size < settings.least_piece:
            continue
        degree = 3 if piece.size >= 2 * settings.least_piece else 2
        basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, piece.size), degree)
        inner = basis[~blurred[piece]]
        fitted = basis @ np.linalg.lstsq(inner, filled[sharp], rcond=None)[0]
        off = (filled[piece] - fitted)[~blurred[piece]]
        if sheets >= LEAST_SHARING:
            off = off - np.median(off, axis=1)[:, None]
        if not chained and np.median(np.sqrt((off**2).mean(axis=0)) / noise) > settings.misfit:
            waiting += np.array_split(piece, 2)
            continue
        motion[piece] = fitted
        left[sharp] = 1 - (np.linalg.qr(inner)[0] ** 2).sum(axis=1)
    common = np.nan_to_num(nan_median(x_px - motion, axis=1)) if sheets >= LEAST_SHARING else np.zeros(frames)
    shared = 1 - 1.57 / sheets if sheets >= LEAST_SHARING else 1.0  # a median's variance is π/2 of a mean's
    return motion + common[:, None], left * shared


def _filled(x_px: Floats) -> Floats:
    """Gaps bridged by straight lines, ends held."""
    filled, frame = x_px.copy(), np.arange(len(x_px))
    for column in filled.T:
        known = np.isfinite(column)
        column[~known] = np.interp(frame[~known], frame[known], column[known])
    return filled


def _mean_picture(
    values: Floats32, motion: Floats, usable: Ints, grid: Floats, rest: Floats, rigid: Floats
) -> tuple[Floats, Floats]:
    """M on the grid, and the brightness of every frame; two rounds, since each needs the other."""
    gain = values.mean(axis=1, dtype=float)
    gain /= np.median(gain[usable]) or 1.0
    gain[~(gain > 0)] = 1.0  # blank frames
    total = np.zeros(grid.size)
    for t in usable:
        seen = _material(grid, rest, motion[t], rigid)  # the column at which each point of M is seen
        coefficients = scipy.ndimage.spline_filter1d(values[t].astype(float), order=3, mode="nearest")
        total += (
            scipy.ndimage.map_coordinates(coefficients, seen[None], order=3, mode="nearest", prefilter=False)
            / gain[t]
        )
    return total / len(usable), gain

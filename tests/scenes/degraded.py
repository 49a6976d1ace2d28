"""Small films with known positions, degraded as real recordings are, written through real codecs.

A film is rendered by `vision.experiment`; what happens to it here happens to its pixels (and, where frames
are lost, repeated or mixed, to its truth). Truth is where a sheet was while the frame was exposed, not what
the picture shows: a frozen frame that shows an old position is wrong unless the program says so.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter1d

from tests.scenes.films import write_encoded
from vision.experiment import preset, with_settings
from vision.experiment.scene import make_scene
from vision.experiment.simulate import frame_blocks
from vision.numeric import Floats, Pixels
from vision.sheets import track_sheets
from vision.video import open_video, strip_profile

FPS, FRAMES, WIDTH, ROWS, SHEETS = 25, 120, 600, 30, 26
SCENE = {
    "camera.width": WIDTH,
    "camera.height": ROWS,
    "camera.strip_rows": ROWS,
    "camera.fps": FPS,
    "camera.duration_s": FRAMES / FPS,
    "sheets.count": SHEETS,
    "sheets.per_side": SHEETS // 2,
    # Truth does not depend on the rows that the program takes: nothing leans, nothing is bowed.
    "sheets.bow_px": 0,
    "optics.tilt_deg": 0,
}


@dataclass(frozen=True)
class Film:
    """Frames (frame, row, column) of 8 bits, and where the sheets truly were (frame, sheet), px."""

    pixels: Pixels
    truth_px: Floats


@cache
def clean(seed: int = 1, times: int = 1, vibration_px: float = 0.05) -> Film:
    """The film before anything happens to it; `times` as many frames per second, for what mixes moments."""
    changes = {
        **SCENE,
        "camera.fps": FPS * times,
        "camera.exposure_s": 0.004 / times,
        "optics.vibration_px": vibration_px,
    }
    scene = make_scene(with_settings(preset("paper", seed=seed), changes))
    pixels = np.concatenate(list(frame_blocks(scene)))
    return Film(pixels, scene.seen_px(slice(0, len(pixels))))


# --- what happens to frames ---------------------------------------------------------------------------------


def frozen(seed: int) -> Film:
    """The picture stands still for 2 to 6 frames, four times, while the sheets move on."""
    film, rng = clean(seed), np.random.default_rng(seed)
    shown = np.arange(FRAMES)
    for start in rng.choice(np.arange(5, FRAMES - 10, 12), 4, replace=False):
        shown[start : start + rng.integers(3, 8)] = start
    return Film(film.pixels[shown], film.truth_px)


def dropped(seed: int) -> Film:
    """One frame in twelve is missing and nothing says so."""
    film = clean(seed)
    kept = np.random.default_rng(seed).uniform(size=FRAMES) > 1 / 12
    return Film(film.pixels[kept], film.truth_px[kept])


def duplicated(seed: int) -> Film:
    """One frame in twelve is written twice."""
    film = clean(seed)
    twice = 1 + (np.random.default_rng(seed).uniform(size=FRAMES) < 1 / 12)
    return Film(np.repeat(film.pixels, twice, axis=0), np.repeat(film.truth_px, twice, axis=0))


def rolling_shutter(seed: int) -> Film:
    """Rows are exposed one after the other over four fifths of the frame interval."""
    parts = 5
    film = clean(seed, parts)
    moment = np.arange(ROWS) * (parts - 1) // ROWS
    frame = np.arange(FRAMES) * parts
    pixels = film.pixels[frame[:, None] + moment, np.arange(ROWS)]
    return Film(pixels, np.mean([film.truth_px[frame + k] for k in moment], axis=0))


def interlaced(seed: int) -> Film:
    """Odd rows are half a frame later than even ones."""
    film = clean(seed, 2)
    moment = np.arange(ROWS) % 2
    frame = np.arange(FRAMES) * 2
    pixels = film.pixels[frame[:, None] + moment, np.arange(ROWS)]
    return Film(pixels, (film.truth_px[frame] + film.truth_px[frame + 1]) / 2)


# --- what happens to pixels ---------------------------------------------------------------------------------


def _grey(values: Floats) -> Pixels:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def _each(film: Film, work: Callable[[Floats, int], Floats]) -> Film:
    """`work(frame, number)` of each frame."""
    pixels = [_grey(work(frame.astype(np.float32), k)) for k, frame in enumerate(film.pixels)]
    return Film(np.stack(pixels), film.truth_px)


def _disc(radius_px: float) -> Floats:
    reach = int(np.ceil(radius_px))
    z, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    soft = np.clip(radius_px + 0.5 - np.hypot(z, x), 0, 1)
    return np.asarray(soft / soft.sum(), np.float32)


def blurred(seed: int) -> Film:
    """A soft lens: Gaussian of 2 px, before the noise of another exposure."""
    rng = np.random.default_rng(seed)
    return _each(
        clean(seed), lambda frame, k: cv2.GaussianBlur(frame, (0, 0), 2) + rng.normal(0, 1.5, frame.shape)
    )


def defocused(seed: int) -> Film:
    """A circle of confusion of 4 px radius."""
    rng, disc = np.random.default_rng(seed), _disc(4)
    return _each(
        clean(seed), lambda frame, k: cv2.filter2D(frame, -1, disc) + rng.normal(0, 1.5, frame.shape)
    )


def autofocus(seed: int) -> Film:
    """The lens hunts: out of focus by up to 3 px within ten frames, and back."""
    rng = np.random.default_rng(seed)

    def refocused(frame: Floats, k: int) -> Floats:
        off = 3 * np.clip(1 - abs(k - 60) / 10, 0, 1)
        soft = cv2.filter2D(frame, -1, _disc(off)) if off > 0 else frame
        return np.asarray(soft + rng.normal(0, 1.0, frame.shape))

    return _each(clean(seed), refocused)


def auto_exposure(seed: int) -> Film:
    """Brightness steps by −35 %, +50 % and back."""
    gain = np.repeat([1.0, 0.65, 1.5, 1.0], FRAMES // 4)
    return _each(clean(seed), lambda frame, k: frame * gain[k])


def dirty(seed: int) -> Film:
    """Twelve dark specks of 2 to 8 px on the lens."""
    rng = np.random.default_rng(seed)
    z, x = np.mgrid[:ROWS, :WIDTH]
    light = np.ones((ROWS, WIDTH))
    for _ in range(12):
        size = rng.uniform(1, 4)
        away = np.hypot(z - rng.uniform(0, ROWS), x - rng.uniform(0, WIDTH))
        light *= 1 - 0.6 * np.exp(-((away / size) ** 2) / 2)
    return _each(clean(seed), lambda frame, k: frame * light)


def glare(seed: int) -> Film:
    """A highlight of 40 px, saturated in its middle, that wanders by 30 px."""
    x = np.arange(WIDTH)
    return _each(clean(seed), lambda frame, k: frame + 200 * np.exp(-(((x - 200 - k / 4) / 20) ** 2) / 2))


def passing_hand(seed: int) -> Film:
    """Something dark, 150 px wide with soft edges, crosses the picture within 30 frames."""
    x = np.arange(WIDTH)

    def covered(frame: Floats, k: int) -> Floats:
        share = gaussian_filter1d((np.abs(x - (k - 45) * 25) < 75).astype(float), 6)
        return np.asarray(frame * (1 - share) + 45 * share)

    return _each(clean(seed), covered)


def slow_hand(seed: int) -> Film:
    """Something dark, 140 px wide, moves over the comb all the time: no frame shows all sheets."""
    x = np.arange(WIDTH)

    def covered(frame: Floats, k: int) -> Floats:
        share = gaussian_filter1d((np.abs(x - 5.3 * k) < 70).astype(float), 3)
        return np.asarray(frame * (1 - share) + 10 * share)

    return _each(clean(seed), covered)


def shadow(seed: int) -> Film:
    """A soft shadow, 60 px wide, that takes two thirds of the light, crosses the comb slowly."""
    x = np.arange(WIDTH)

    def shaded(frame: Floats, k: int) -> Floats:
        away = np.abs(x - 5.0 * k) < 30
        return np.asarray(frame * (1 - 0.67 * gaussian_filter1d(away.astype(float), 10)))

    return _each(clean(seed), shaded)


def scale_bar(seed: int) -> Film:
    """A white bar of 60 by 3 px that the recorder burned in."""
    bar = np.zeros((ROWS, WIDTH), bool)
    bar[20:23, 183:243] = True
    return _each(clean(seed), lambda frame, k: np.where(bar, 255.0, frame))


def clipped(seed: int) -> Film:
    """Overexposed: the tops of the ridges are cut off at 255."""
    return _each(clean(seed), lambda frame, k: frame * 1.6)


def gamma(seed: int) -> Film:
    """Grey levels are the light to the power 0.45."""
    return _each(clean(seed), lambda frame, k: 255 * (frame / 255) ** 0.45)


def vibrating(seed: int) -> Film:
    """The camera shakes by a quarter of a pixel, and no two frames alike."""
    return clean(seed, vibration_px=0.25)


# --- files --------------------------------------------------------------------------------------------------


def write_jpegs(path: Path, pixels: Pixels, quality: int) -> Path:
    """An AVI of JPEG pictures of a given quality, as industrial cameras write them."""
    with av.open(str(path), "w") as out:
        stream = out.add_stream("mjpeg", rate=FPS)
        stream.height, stream.width, stream.pix_fmt = *pixels.shape[1:], "yuvj420p"
        stream.codec_context.time_base = Fraction(1, FPS)
        for n, frame in enumerate(pixels):
            colour = cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR)
            packet = av.Packet(cv2.imencode(".jpg", colour, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes())
            packet.stream, packet.pts, packet.dts, packet.time_base = stream, n, n, Fraction(1, FPS)
            packet.is_keyframe = True
            out.mux(packet)
    return path


def write_h264(path: Path, pixels: Pixels, crf: int) -> Path:
    """An MP4 at a constant rate factor; the same bytes each time."""
    # x264's fast routines look beyond the last row where heights are no multiple of 16, into used memory.
    options = {"crf": str(crf), "preset": "medium", "threads": "1", "x264-params": "asm=0"}
    return write_encoded(
        path, pixels, codec="libx264", pix_fmt="yuv420p", source="gray", fps=FPS, options=options
    )


def write_ffv1(path: Path, pixels: Pixels) -> Path:
    """A Matroska file without loss."""
    return write_encoded(path, pixels, codec="ffv1", pix_fmt="gray", source="gray", fps=FPS)


def write_chained(path: Path, pixels: Pixels, encoder: str, options: Mapping[str, str]) -> Path:
    """A film by another encoder that carries content from frame to frame."""
    return write_encoded(
        path, pixels, codec=encoder, pix_fmt="yuv420p", source="gray", fps=FPS, options=dict(options)
    )


CHAINED: Mapping[str, tuple[str, str, Mapping[str, str]]] = {
    "H.264 crf 12, ultrafast": ("film.mp4", "libx264", {"crf": "12", "preset": "ultrafast", "threads": "1"}),
    "H.264 crf 12, veryfast": ("film.mp4", "libx264", {"crf": "12", "preset": "veryfast", "threads": "1"}),
    "H.264 crf 12, GOP 12": ("film.mp4", "libx264", {"crf": "12", "g": "12", "threads": "1"}),
    "H.264 crf 18, no B": ("film.mp4", "libx264", {"crf": "18", "bf": "0", "threads": "1"}),
    "HEVC crf 18": (
        "film.mp4",
        "libx265",
        {"crf": "18", "x265-params": "log-level=none:pools=1:frame-threads=1"},
    ),
    "MPEG-4 q 3": ("film.avi", "mpeg4", {"qmin": "3", "qmax": "3"}),
    "MPEG-2 q 3": ("film.avi", "mpeg2video", {"qmin": "3", "qmax": "3"}),
    "VP9 crf 20": ("film.mkv", "libvpx-vp9", {"crf": "20", "b": "0", "cpu-used": "4"}),
}
CODECS: Mapping[str, Callable[[Path, Pixels], Path]] = {
    "FFV1": lambda folder, pixels: write_ffv1(folder / "film.mkv", pixels),
    **{
        f"MJPEG {quality}": lambda folder, pixels, quality=quality: write_jpegs(
            folder / "film.avi", pixels, quality
        )
        for quality in (98, 90, 75, 60)
    },
    **{
        f"H.264 crf {crf}": lambda folder, pixels, crf=crf: write_h264(folder / "film.mp4", pixels, crf)
        for crf in (12, 18, 23, 28)
    },
    **{
        name: lambda folder, pixels, name=name: write_chained(
            folder / CHAINED[name][0], pixels, *CHAINED[name][1:]
        )
        for name in CHAINED
    },
}
DEGRADATIONS: Mapping[str, Callable[[int], Film]] = {
    "none": clean,
    "frozen frames": frozen,
    "dropped frames": dropped,
    "duplicated frames": duplicated,
    "soft lens": blurred,
    "defocus": defocused,
    "autofocus hunting": autofocus,
    "auto-exposure steps": auto_exposure,
    "dirt": dirty,
    "glare": glare,
    "passing hand": passing_hand,
    "slow hand": slow_hand,
    "shadow": shadow,
    "scale bar": scale_bar,
    "rolling shutter": rolling_shutter,
    "interlaced": interlaced,
    "8-bit clipping": clipped,
    "gamma 0.45": gamma,
    "vibration": vibrating,
}

# --- what the program makes of them -------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """How a film was measured.

    Parameters
    ----------
    sheets
        Sheets reported; there are `SHEETS`.
    positions
        Of the truth: frames times sheets.
    found
        Share of them that have a position that is called ok.
    wrong
        Positions called ok that are more than half a pitch from their sheet.
    gross
        Share of those called ok whose displacement is off by more than 0.2 px and 5 stated errors.
    coverage, coverage_moved
        Share of the positions within one stated error, to which that of all frames (`constant_error_px`)
        belongs; and of the displacements (without each sheet's median error) within `x_err_px`.
    rms_px, stated_px
        RMS error and RMS `x_err_px`, wrong ones aside.
    bias_px, constant_px
        RMS over the sheets of their median error, and of the stated one.
    """

    sheets: int
    positions: int
    found: float
    wrong: int
    gross: float
    coverage: float
    coverage_moved: float
    rms_px: float
    stated_px: float
    bias_px: float
    constant_px: float


def measured(film: Film, folder: Path, codec: str = "FFV1") -> Outcome:
    """The film written, opened, tracked as a user would without any option, and held against its truth."""
    video = open_video(CODECS[codec](folder, film.pixels))
    return compare(track_sheets(strip_profile(video)), film.truth_px)


def compare(tracks: xr.Dataset, truth_px: Floats) -> Outcome:
    """Positions against the truth; each reported sheet is the true one it is nearest to most of the time."""
    x, err, ok = tracks.x_px.values, tracks.x_err_px.values, tracks.flag.values == "ok"
    shared = min(len(x), len(truth_px))
    x, err, ok, truth = x[:shared], err[:shared], ok[:shared], truth_px[:shared]
    away = np.nanmedian(np.abs(x[:, :, None] - truth[:, None, :]), axis=0)
    sheet = np.argmin(np.nan_to_num(away, nan=np.inf), axis=1)
    error = np.where(ok, x - truth[:, sheet], np.nan)
    half = 0.5 * float(np.median(np.diff(truth[0])))
    wrong = int((np.abs(error) > half).sum())
    # A second report of one sheet is no sheet: all its positions are wrong.
    for k in range(1, len(sheet)):
        wrong += int(ok[:, k].sum()) if sheet[k] in sheet[:k] else 0
    error = np.where(np.abs(error) > half, np.nan, error)
    known = np.isfinite(error)
    # the median: a few positions with large errors, which they state, do not shift the others
    middle, total = np.nanmedian(error, axis=0), np.hypot(err, tracks.constant_error_px.values)
    return Outcome(
        sheets=x.shape[1],
        positions=truth_px.size,
        found=float(known.sum() / truth_px.size),
        wrong=wrong,
        gross=float((np.abs(error - middle) > np.maximum(0.2, 5 * err)).sum() / known.sum()),
        coverage=float((np.abs(error) <= total).sum() / known.sum()),
        coverage_moved=float((np.abs(error - middle) <= err).sum() / known.sum()),
        rms_px=float(np.sqrt(np.nanmean(error**2))),
        stated_px=float(np.sqrt(np.mean(err[known] ** 2))),
        bias_px=float(np.sqrt(np.nanmean(middle**2))),
        constant_px=float(np.sqrt(np.nanmean(tracks.constant_error_px.values**2))),
    )

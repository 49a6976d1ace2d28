"""`track preview VIDEO`: in seconds, what would be measured, as a picture and ten lines."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from vision.command.console import conclude
from vision.command.options import Flag, VideoOptions, merged, settings_of
from vision.command.track import run_name

if TYPE_CHECKING:
    import xarray as xr

    from vision.numeric import Ints, Pixels
    from vision.pipeline import Settings
    from vision.video import Video

CONSECUTIVE = 24
"""Frames at the beginning that are tracked: the scatter of one position is known to a seventh."""
SPREAD = 12
"""Frames over the whole film in which ridges are counted."""


@dataclass(frozen=True)
class Preview:
    """What a few frames show.

    Parameters
    ----------
    video
        The whole film.
    frame
        The first frame of those tracked that shows something.
    strip, tracks
        Of the consecutive frames.
    counts
        Ridges in each of the frames spread over the film.
    """

    video: Video
    frame: Pixels
    strip: xr.DataArray
    tracks: xr.Dataset
    counts: Ints


def preview(
    video: Path,
    /,
    reading: VideoOptions | None = None,
    *,
    config: Path | None = None,
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """In seconds: the frame, the strip, the ridges and their noise, as a picture and ten lines.

    Looks at some tens of frames: the first ones, which are tracked, and others spread over the film.

    Examples:

        track preview test.avi

        track preview beam.cine --rotate 90 --strip 14:630

    Parameters
    ----------
    video
        A video as for track.
    reading
        How the video is read and its sheets are found.
    config
        TOML file with any of these options; the command line wins.
    out
        The picture (.png, .pdf or .svg); NAME_preview.png in the working directory by default.
    overwrite
        Replace a picture that is not this command's default.
    quiet
        No summary.
    """
    from vision.figures import preview_figure
    from vision.run import check_new, whole_file
    from vision.sheets import pixel_size_from_pitch

    settings = settings_of(merged(reading or VideoOptions(), config=config))
    target = out or Path(f"{run_name(video)}_preview.png")
    if out is not None:
        check_new(target, overwrite=overwrite)
    found = look(video, settings)
    size = settings.pixel_size_um
    if settings.pitch_um is not None:
        size = pixel_size_from_pitch(found.tracks, settings.pitch_um)
    with whole_file(target) as path:
        preview_figure(found.frame, found.strip, found.tracks, pixel_size_um=size).save(path)
    warnings = _warnings(found)
    return conclude([*lines(found, size), f"picture    {target}"], warnings, quiet=quiet)


def look(path: Path, settings: Settings) -> Preview:
    """Read, track and count a few frames.

    Raises
    ------
    InputError
        As `track` does.
    """
    import numpy as np

    from vision.pipeline import open_recording, track_strip
    from vision.sheets.ridges import describe_ridges, find_ridges
    from vision.video import reference_frame, strip_profile
    from vision.video.strip import row_means
    from vision.video.strip_find import choose_strip

    film = open_recording(path, settings)
    strip_settings = settings.tuning.video
    rows = choose_strip(film, settings.rows, columns=settings.columns, settings=strip_settings).rows
    stop = (
        film.first + CONSECUTIVE if film.estimated is None else film.first + min(CONSECUTIVE, film.estimated)
    )
    few = open_recording(path, replace(settings, frames=slice(film.first, stop)))
    strip = strip_profile(few, rows, columns=settings.columns, settings=strip_settings)
    # Decisions by hand are about frames that are not looked at here.
    tracks = track_strip(strip, replace(settings, corrections=()))
    columns = slice(int(strip["x"].values[0]), int(strip["x"].values[-1]) + 1)
    spread = [frame[rows, columns] for frame in film.sample(SPREAD)]
    spread = spread or [frame[rows, columns] for frame in itertools.islice(film.frames(), SPREAD)]
    profile = row_means(np.stack(spread))
    comb = describe_ridges(profile, polarity=tracks.attrs["ridges"], settings=settings.tuning.tracking)
    ridges = find_ridges(profile, comb, settings=settings.tuning.tracking)
    return Preview(film, reference_frame(few), strip, tracks, ridges.count)


def lines(found: Preview, pixel_size_um: float | None) -> list[str]:
    """What was found, in nine lines."""
    from vision.data import StripMetadata, TrackMetadata
    from vision.sheets.tracks import LOSSY
    from vision.summary import flag_counts, frame_times, noise_figures

    strip, comb, film = StripMetadata.of(found.strip), TrackMetadata.of(found.tracks), found.video
    rows, columns = film.shape
    count = "an unknown number of" if film.estimated is None else f"{film.estimated}"
    about = "" if film.expected is not None else "about " * (film.estimated is not None)
    noise = noise_figures(found.tracks, pixel_size_um)
    length = "" if pixel_size_um is None else f" = {noise['stated_um']:.3f} µm"
    lean = "no lean measured" if math.isnan(strip.tilt_deg) else f"lean {strip.tilt_deg:+.2f}°"
    flags = flag_counts(found.tracks)
    other = ", ".join(f"{n} {name}" for name, n in flags.items() if name != "ok") or "none missing"
    low, high = int(found.counts.min()), int(found.counts.max())
    counted = f"{low}" if low == high else f"{low} to {high}"
    scale = "px: give `pixel_size_um` for µm" if pixel_size_um is None else f"{pixel_size_um:g} µm per px"
    frames = found.tracks.sizes["frame"]
    side = found.tracks["side"].values
    hidden = f" (not independent: {strip.codec} hides the noise of the pixels)" * (strip.codec in LOSSY)
    return [
        f"film       {about}{count} frames of {columns} x {rows} px, {film.depth_bits} bit, {strip.codec}",
        f"clock      {frame_times(strip)}",
        f"strip      rows {strip.strip_z0}:{strip.strip_z1}, clarity {strip.strip_clarity:.2f}, {lean}, "
        f"{strip.strip_err_px:.3f} px from the choice of rows",
        f"sheets     {comb.sheets} {comb.ridges} ridges ({(side < 0).sum()} left, {(side > 0).sum()} right); "
        f"{counted} in {found.counts.size} frames over the film, others than sheets included",
        f"ridges     {comb.ridge_fwhm_px:.1f} px wide, {comb.pitch_px:.1f} px apart; {comb.fit} fit over "
        f"{comb.window_px} px",
        f"light      ridges {comb.contrast:.3g} grey levels high, profile noise {comb.profile_noise:.2g}",
        f"positions  {flags.get('ok', 0)} in the first {frames} frames; {other}",
        f"noise      {noise['stated_px']:.4f} px{length} stated; {noise['measured_px']:.4f} px scatter "
        f"between {frames} frames{hidden}",
        f"scale      {scale}",
    ]


def _warnings(found: Preview) -> list[str]:
    """Those of the frames looked at, without what can only be known from all frames."""
    from vision.data import warnings_of
    from vision.summary import tracking_warnings

    kept = [line for line in warnings_of(found.tracks) if "missing" not in line]
    return list(dict.fromkeys([*found.video.warnings, *kept, *tracking_warnings(found.tracks)]))

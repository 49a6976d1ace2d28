"""Every command: its options and its help.

Each function here imports the module that does the work when it is called, so that `--help` is quick; those
modules import at their top what they need.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter as Option

from vision.command.options import (
    Flag,
    ForceOptions,
    OutputOptions,
    Report,
    RunOptions,
    SampleOptions,
    TestOptions,
    VideoOptions,
)


def track(
    *videos: Path,
    reading: VideoOptions = VideoOptions(),
    test: TestOptions = TestOptions(),
    machine: ForceOptions = ForceOptions(),
    sample: SampleOptions = SampleOptions(),
    run: RunOptions = RunOptions(),
    config: Path | None = None,
) -> int:
    """Track every sheet of a video: positions x(n,t), their errors, pictures and tables in a new folder.

    Several videos are tracked one after the other, each into its own folder; one that cannot be used does not
    keep the others from being done. --out is then the folder that holds their folders.

    Parameters
    ----------
    videos
        A video file, a TIFF stack, a folder or a quoted glob of numbered images; or several.
    config
        TOML file with any of these options; the command line wins.
    """
    from vision.command import track

    return track.track(videos, (reading, test, machine, sample), run, config)


def preview(
    video: Path,
    /,
    reading: VideoOptions = VideoOptions(),
    *,
    config: Path | None = None,
    output: OutputOptions = OutputOptions(),
) -> int:
    """In seconds: the frame, the strip, the ridges and their noise, as a picture and ten lines.

    Looks at some tens of frames: the first ones, which are tracked, and others spread over the film. Writes
    NAME_preview.png, or a .pdf or .svg with --out.

    Examples:

        track preview test.avi

        track preview beam.cine --rotate 90 --strip 14:630

    Parameters
    ----------
    video
        A video as for track.
    config
        TOML file with any of these options; the command line wins.
    """
    from vision.command import views

    return views.preview(video, reading, config, output)


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class WindowOptions:
    """What of the strip is shown."""

    sheet: Annotated[tuple[str, ...], Option(negative="")] = ()
    """Window around a sheet: side and number, as right:23, or the index from the left; can be repeated."""
    width: str | None = None
    """Width of the window in mm, um, µm or px; 0.2mm, or one pitch where there is no pixel size."""
    follow: Flag = False
    """The window moves with the sheet, interpolated between pixels, instead of standing still."""
    time: str | None = None
    """Part of the recording in seconds of the video's clock, A:B."""


def kymograph(
    video_or_run: Path,
    /,
    window: WindowOptions = WindowOptions(),
    reading: VideoOptions = VideoOptions(),
    *,
    picture: Literal["png", "pdf", "svg"] = "png",
    output: OutputOptions = OutputOptions(),
) -> int:
    """Space-time diagrams: the whole strip, or windows around sheets, side by side.

    Writes the folder NAME_kymograph with a 16-bit TIFF for each, which Fiji opens in µm and s, and one
    picture with axes. Slips are marked: those of a run's force recording, else the common outward steps of
    the sheets. Of a run only columns, frames and pixel size can be chosen.

    Examples:

        track kymograph test_tracks --sheet right:23 --sheet right:10 --width 0.2mm --time 40:45.1

        track kymograph test.avi --frames 0:600

    Parameters
    ----------
    video_or_run
        A run folder, or a video as for track.
    picture
        Kind of the picture.
    """
    from vision.command import views

    return views.kymograph(video_or_run, window, reading, picture, output)


def export(
    run: Path,
    /,
    *,
    to: Literal["csv", "xlsx", "parquet", "mat", "trackpy", "napari"],
    output: OutputOptions = OutputOptions(),
) -> int:
    """Tables of a finished run in another program's format.

    csv and parquet: a folder with a file for each table. xlsx: one worksheet for each. mat: matrices and
    structs for MATLAB. trackpy: x, y, frame, particle. napari: track_id, t, y, x. The unit is the last part
    of a column's name; trackpy and napari have px. The file or folder is called after the run.

    Positions that were not measured are empty in csv, xlsx and parquet, NaN in mat, and left out for trackpy
    and napari.

    Examples:

        track export test_tracks --to xlsx

        track export test_tracks --to mat --out for_matlab.mat

    Parameters
    ----------
    run
        Run folder.
    to
        Format.
    """
    from vision.command import finished

    return finished.export(run, to, output)


def figures(
    run: Path | None = None,
    /,
    *names: str,
    compare: Path | None = None,
    to: Literal["pdf", "svg", "png", "csv"] = "pdf",
    output: OutputOptions = OutputOptions(),
) -> int:
    """The figures of a finished run, for a manuscript; csv holds a figure's numbers.

    Writes one file for each into the folder RUN_figures.

    Examples:

        track figures test_tracks --to svg

        track figures test_tracks deformation shells --to pdf --out manuscript

        track figures --compare comparison collapse trends

    Parameters
    ----------
    run
        Run folder.
    names
        Figures; all of the run if none is named.
    compare
        Folder that `track compare` wrote, in place of a run.
    to
        Format.
    """
    from vision.command import finished

    return finished.figures(run, names, compare, to, output)


def overlay(
    run: Path,
    /,
    *,
    film: Path | None = None,
    frames: str | None = None,
    output: OutputOptions = OutputOptions(),
) -> int:
    """The film of a finished run with its tracks drawn on it, as MP4: to see whether they follow the sheets.

    Writes RUN_overlay.mp4.

    Examples:

        track overlay test_tracks

        track overlay test_tracks --frames 300:600 --film /archive/test.avi

    Parameters
    ----------
    run
        Run folder.
    film
        Where the film lies now, if not where it was when it was tracked.
    frames
        Part of the film, A:B, frame numbers as in tracks.csv.
    """
    from vision.command import finished

    return finished.overlay(run, film, frames, output)


def certify(
    run: Path, /, *, films: int = 3, most_frames: int = 600, output: OutputOptions = OutputOptions()
) -> int:
    """What the recording of a finished run can resolve, from films like it whose truth is known.

    Films are put together from the run's own mean ridges, light, motion and residuals, and go through the
    same analysis. Writes the folder RUN_certificate: certificate.html says on one page how large the error of
    each sheet is, the smallest sweep in a stick, the pull towards whole pixels, how safe identities are, and
    the bias of σ_x/Λ_st at the threshold; certificate.csv and certificate.json hold the numbers. Exit status
    1 where something is not covered.

    Examples:

        track certify test_tracks

        track certify test_tracks --films 6 --out certified

    Parameters
    ----------
    run
        Run folder.
    films
        Films made. More take longer and average over more encounters of noise and motion.
    most_frames
        Frames imitated, from the middle of the run.
    """
    from vision.command import finished

    return finished.certify(run, films, most_frames, output)


def compare(
    *runs: Path,
    table: Path | None = None,
    main_sample: str | None = None,
    fix_yeff: float | None = None,
    report: Report = True,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Several finished tests side by side: one table, one μ, the collapse, the change points, the trends.

    Writes the folder comparison: tests.csv (one row per run), trends.json, all_events.csv, figures.npz,
    collapse.png, trends.png, report.html and run.json. A run that cannot be used is named, the rest is done,
    and the exit status is 1.

    Examples:

        track compare old_tracks new_tracks --table tests.csv

        track compare --table tests.csv --main-sample A --out two_samples

    Parameters
    ----------
    runs
        Run folders with a force recording; those that the table names if none is given.
    table
        CSV with any of the columns run,sample,V_mm_min,n_test,RH_percent,T_C.
    main_sample
        Sample whose Y_eff is held fixed for all tests; that of the first run if not given.
    fix_yeff
        Y_eff in GPa, where it is known otherwise.
    report
        Write report.html.
    """
    from vision.command import finished

    return finished.compare(runs, table, main_sample, fix_yeff, report, output)


def review(
    run_or_video: Path,
    /,
    reading: VideoOptions = VideoOptions(),
    test: TestOptions = TestOptions(),
    machine: ForceOptions = ForceOptions(),
    sample: SampleOptions = SampleOptions(),
    run: RunOptions = RunOptions(),
    *,
    config: Path | None = None,
    film: Path | None = None,
    browser: bool = True,
    port: int = 0,
) -> int:
    """See a run and correct it in a browser; a video is tracked first.

    The page is served to this machine alone, at an address with a token. Decisions are kept at once in
    corrections.toml of the run folder; saving re-runs what follows from them. Ctrl-C or the page's button
    ends it. Options of track are for a video; of a run everything is known.

    Examples:

        track review test_tracks

        track review test.avi --force test.txt --pixel-size 10

    Parameters
    ----------
    run_or_video
        Run folder, or a video as for track.
    config
        TOML file with any of these options.
    film
        Where the film of a run lies now, if not where it was when it was tracked.
    browser
        Open the default browser; the address is printed in any case.
    port
        Of the address; a free one if not given.
    """
    from vision.command import review

    return review.review(
        run_or_video, (reading, test, machine, sample), run, config, film=film, browser=browser, port=port
    )


def force(
    file: Path,
    /,
    machine: ForceOptions = ForceOptions(),
    sample: SampleOptions = SampleOptions(),
    *,
    free_t_star: Flag = False,
    detection_limit: Flag = False,
    config: Path | None = None,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Stick-slip events, stiffness and model fits from a force recording alone.

    Writes the folder FILE_force: events.csv, models.json, run.json and force.png. Exit status 1 if a warning
    matters.

    Parameters
    ----------
    file
        Recording of a testing machine: text, CSV, .TRA or .mat.
    free_t_star
        Fit T* too (it can hardly be told from the friction coefficient).
    detection_limit
        Also put small known slips into the recording and look for them.
    config
        TOML file with any of these options; the command line wins.
    """
    from vision.command import recordings

    return recordings.force(
        file, (machine, sample), config, output, free_t_star=free_t_star, limit=detection_limit
    )


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class ModulusOptions:
    """The sheet and the machine of push–pull cycles."""

    thickness: float = 0.1
    """Of the sheet, mm."""
    width: float = 45.0
    """Of the sheet, mm."""
    length: float = 16.8
    """Between the clamps, mm."""
    clamp_distance: float | None = None
    """Distance of the clamps at the first sample, mm, where it is neither the displacement nor the length."""
    machine_stiffness: float | None = None
    """The machine's own stiffness in N/mm, to correct the distance; no correction if absent."""
    part: str = "0.4:0.9"
    """Part of the rise of the force on each loading branch that is fitted."""
    force_columns: str | None = None
    """Columns by name or number, as in time=Time,load=Load:kN,displacement=3."""


def modulus(
    file: Path,
    /,
    options: ModulusOptions = ModulusOptions(),
    *,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Young's modulus of one sheet from push–pull cycles.

    Writes the folder FILE_modulus: cycles.csv, modulus.json, run.json, modulus.png and figures.npz. Exit
    status 1 if a warning matters.

    Parameters
    ----------
    file
        Recording of a testing machine with time, load and displacement.
    """
    from vision.command import recordings

    return recordings.modulus(file, options, output)


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class FrictionOptions:
    """The discs of a rheometer and what is measured on them."""

    radius: float = 25.0
    """Radius of the discs in mm."""
    normal_force: str | None = None
    """Normal force in N in place of a recorded one: one for all files, or one a file, as in 0.1,0.5,1."""
    dynamic: str = "0.3:120"
    """Travelled angles in degrees over which the dynamic coefficient is the mean."""
    mu: float = 0.89
    """Constant coefficient with which the thresholds are compared."""


def friction(
    *files: Path, options: FrictionOptions = FrictionOptions(), output: OutputOptions = OutputOptions()
) -> int:
    """Static and dynamic friction of two sheets from a rheometer's files, and the law μ_s = a(1 + b/N).

    Writes the folder FIRSTFILE_friction: friction.csv, friction.json, run.json, friction.png and figures.npz.
    A file or measurement that cannot be used is named, the others are done, and the exit status is 1.

    Parameters
    ----------
    files
        RheoCompass exports (UTF-16 or UTF-8, several results and intervals), TRIOS exports, or tables with
        units.
    """
    from vision.command import recordings

    return recordings.friction(files, options, output)


def _sets(setting: str) -> Any:
    """An option, not given, for this setting of `vision.experiment`."""
    return field(default=None, metadata={"setting": setting})


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class SimulateOptions:
    """The main settings of a synthetic test. What is not given is the preset's."""

    seed: int | None = _sets("seed")
    """Same seed, same data."""
    duration: float | None = _sets("camera.duration_s")
    """Length of the video, s."""
    fps: float | None = _sets("camera.fps")
    """Frames per second."""
    width: int | None = _sets("camera.width")
    """Columns, px."""
    height: int | None = _sets("camera.height")
    """Rows, px."""
    pixel_size: float | None = _sets("camera.pixel_size_um")
    """Micrometres per pixel."""
    exposure: float | None = _sets("camera.exposure_s")
    """Exposure, ms."""
    bits: int | None = _sets("camera.bits")
    """Bits per pixel, 8 to 16."""
    speed: float | None = _sets("mechanics.speed_mm_min")
    """Speed V of the pull, mm/min."""
    d0: float | None = _sets("mechanics.d0_mm")
    """Separation at the start of the pull, mm."""
    d_end: float | None = _sets("mechanics.d_end_mm")
    """Separation at its end, mm."""
    offset: float | None = _sets("clocks.offset_s")
    """Force clock at video time 0, s."""
    sheets: int | None = _sets("sheets.count")
    """Ridges in view."""
    pitch: float | None = _sets("sheets.pitch_px")
    """Distance between ridges, px."""
    fwhm: float | None = _sets("optics.fwhm_px")
    """Ridge width, px."""
    contrast: float | None = _sets("optics.contrast")
    """Michelson contrast of the ridges."""
    ridges: Literal["bright", "dark"] | None = _sets("optics.polarity")
    """Polarity."""
    dropped: float | None = _sets("clocks.dropped")
    """Fraction of frames lost."""
    force_rate: float | None = _sets("clocks.force_rate_Hz")
    """Force samples per second."""
    force_layout: Literal["mts", "instron", "zwick", "csv"] | None = _sets("force_file.layout")
    """Layout of force.txt."""
    force_decimal: Literal[".", ","] | None = _sets("force_file.decimal")
    """Decimal mark in force.txt."""
    force_encoding: Literal["utf-8-sig", "utf-8", "latin-1"] | None = _sets("force_file.encoding")
    """Encoding of force.txt."""
    force_unit: Literal["N", "kN"] | None = _sets("force_file.unit")
    """Unit of force in force.txt."""
    video_time: bool | None = _sets("force_file.video_time")
    """Write the camera's clock as a column of force.txt."""


def simulate(
    directory: Path,
    /,
    options: SimulateOptions = SimulateOptions(),
    *,
    preset: str = "paper",
    container: str = "raw",
    toml: Path | None = None,
    set_: Annotated[tuple[str, ...], Option(name="--set")] = (),
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """Make a synthetic traction test: video, force.txt, truth.nc and the camera's timestamps.txt.

    Settings come from the preset, then the TOML file, then the options, then --set.

    Parameters
    ----------
    directory
        Folder to make.
    preset
        paper, late, fast, fresh, hostile or sheets.
    container
        raw (Y800 AVI), mjpeg, h264, ffv1, tiff or png.
    toml
        Settings from a file: tables sample, mechanics, sheets, optics, camera, clocks, load_cell.
    set_
        Any setting by name, such as --set optics.tilt_deg=0.5; can be repeated.
    overwrite
        Replace an earlier synthetic test.
    quiet
        No progress bar and no summary.
    """
    from vision.command import recordings

    return recordings.simulate(
        directory, options, preset, container, toml, set_, overwrite=overwrite, quiet=quiet
    )


@Option(name="*")
@dataclass(frozen=True, kw_only=True)
class CampaignOptions:
    """How many films are tracked."""

    out: Path | None = None
    """The campaign's folder; TABLE_campaign in the working directory if not given."""
    config: Path | None = None
    """TOML file of options for all films; the table wins."""
    dry_run: Flag = False
    """Say what would run and how long it takes; write nothing."""
    executor: Literal["local", "slurm"] = "local"
    """local or slurm."""
    profile: Path | None = None
    """Folder with a Snakemake profile, in place of the shipped one."""
    cores: int | None = None
    """Jobs at a time; all cores (on a cluster, the profile's number of jobs) if not given."""
    watch: Path | None = None
    """Folder into which films are written: each is taken when it is complete, until Ctrl-C."""
    idle: float | None = None
    """End watching when no film came for so many seconds."""
    stage: Flag = False
    """Copy each film to the node's own disk (TMPDIR) before it is read."""
    report: Report = True
    """Write report.html of each run."""
    quiet: Flag = False
    """No progress and no summary."""
    plan: Annotated[Flag, Option(show=False)] = False
    """Write plan.json and end: for the Snakefile."""


def campaign(table: Path | None = None, /, options: CampaignOptions = CampaignOptions()) -> int:
    """Track many films, on all cores of this machine or on a cluster; never repeat what is done.

    The table has a row a test: film, force, any option of track as a column, and what describes it: sample,
    V_mm_min, n_test, RH_percent, T_C. It is checked whole before anything starts. A film runs again where its
    files or its options have changed; one that fails is tried twice and keeps no other from being done.

    Writes a run folder for each film in runs/, campaign.csv, index.html (live while it runs), the comparison
    of the finished tests in pool/ and their tables as Parquet in tables/.

    Examples:

        track campaign tests.csv --dry-run

        track campaign tests.csv --out series

        track campaign tests.csv --executor slurm --stage

        track campaign --watch /data/camera --config setup.toml

    Parameters
    ----------
    table
        CSV; files in it are relative to it.
    """
    from vision.command import campaign

    return campaign.campaign(table, options)


def campaign_job(plan: Path, job: str, /, *fetched: Path) -> int:
    """Take the films of one job of a plan: for the Snakefile."""
    from vision.command import campaign

    return campaign.job(plan, job, fetched)


def campaign_pool(plan: Path, /) -> int:
    """Compare the finished runs of a plan: for the Snakefile."""
    from vision.command import campaign

    return campaign.pool_runs(plan)

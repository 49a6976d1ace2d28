"""Arguments and help of every command but `track review`, whose own module imports nothing slow.

Each function imports the module that does the work only when it is called, so that `--help` is quick.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from vision.command.options import (
    CampaignOptions,
    CompareOptions,
    Flag,
    ForceOptions,
    FrictionOptions,
    ModulusOptions,
    OutputOptions,
    RunOptions,
    SampleOptions,
    SimulateOptions,
    TestOptions,
    VideoOptions,
    WindowOptions,
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

    Several videos are tracked one after the other, each into its own folder. If one cannot be used, the
    others are still tracked, and the exit status is the highest of all, here 2. --out is then the folder that
    holds their folders.

    Parameters
    ----------
    videos
        One or several: a video file, a TIFF stack, a folder of films or images, or a quoted glob of images.
    config
        TOML file with any of these options; the command line takes precedence.
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
    """Show within seconds the frame, the strip, the ridges and their noise, as a picture and ten lines.

    Reads some tens of frames: the first ones, which are tracked, and others spread over the film. Writes
    NAME_preview.png, or with --out also a .pdf or .svg file.

    For example:

        track preview test.avi

        track preview beam.cine --rotate 90 --strip 14:630

    Parameters
    ----------
    video
        A video as for track.
    config
        TOML file with any of these options; the command line takes precedence.
    """
    from vision.command import views

    return views.preview(video, reading, config, output)


def kymograph(
    video_or_run: Path,
    /,
    window: WindowOptions = WindowOptions(),
    reading: VideoOptions = VideoOptions(),
    *,
    picture: Literal["png", "pdf", "svg"] = "png",
    output: OutputOptions = OutputOptions(),
) -> int:
    """Draw space-time diagrams of the whole strip, or of windows around sheets, side by side.

    Writes the folder NAME_kymograph with one 16-bit TIFF per diagram, which Fiji opens in µm and s, and one
    picture of all with axes. Slips are marked: those of the run's force recording, or without one the common
    outward steps of the sheets. The options of a video below are for films; with a run only --columns,
    --frames and --pixel-size count, as the others were decided when it was made. Those of sheets
    (--sheets to --corrections) count only where a film is tracked, with --sheet or --pitch.

    For example:

        track kymograph test_tracks --sheet right:23 --sheet right:10 --width 0.2mm --time 40:45.1

        track kymograph test.avi --frames 0:600

    Parameters
    ----------
    video_or_run
        A run folder, or a video as for track.
    picture
        Format of the picture.
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
    """Write the tables of a finished run in another program's format.

    csv and parquet: a folder with one file per table. xlsx: one worksheet per table. mat: matrices and
    structs for MATLAB. trackpy: x, y, frame, particle. napari: track_id, t, y, x. The unit is the last part
    of a column's name; trackpy and napari use px. The file or folder has the run's name.

    Positions that were not measured are empty in csv, xlsx and parquet, NaN in mat, and left out for trackpy
    and napari.

    For example:

        track export test_tracks --to xlsx

        track export test_tracks --to mat --out for_matlab.mat

    Parameters
    ----------
    run
        Run folder.
    to
        Format.
    """
    from vision.command import views

    return views.export(run, to, output)


def figures(
    run: Path,
    /,
    *names: str,
    to: Literal["pdf", "svg", "png", "csv"] = "pdf",
    output: OutputOptions = OutputOptions(),
) -> int:
    """Write the figures of a finished run for a manuscript, or their numbers as csv.

    A comparison of several tests has figures, too. Writes one file per figure into the folder RUN_figures.

    For example:

        track figures test_tracks --to svg

        track figures test_tracks deformation shells --to pdf --out manuscript

        track figures comparison collapse trends

    Parameters
    ----------
    run
        Run folder, or the folder that `track compare` wrote.
    names
        Names of figures; all if none is given.
    to
        Format.
    """
    from vision.command import views

    return views.figures(run, names, to, output)


def overlay(
    run: Path,
    /,
    *,
    film: Path | None = None,
    frames: str | None = None,
    output: OutputOptions = OutputOptions(),
) -> int:
    """Draw the tracks of a finished run on its film, as MP4, to see whether they follow the sheets.

    Writes RUN_overlay.mp4.

    For example:

        track overlay test_tracks

        track overlay test_tracks --frames 300:600 --film /archive/test.avi

    Parameters
    ----------
    run
        Run folder.
    film
        Path of the film, if it was moved since it was tracked.
    frames
        Part of the film, A:B, with frame numbers as in tracks.csv.
    """
    from vision.command import views

    return views.overlay(run, film, frames, output)


def certify(
    run: Path, /, *, films: int = 3, most_frames: int = 600, output: OutputOptions = OutputOptions()
) -> int:
    """Measure what the recording of a finished run can resolve, from similar films with known truth.

    Synthetic films are made from the run's own mean ridges, light, motion and residuals, and analysed in the
    same way. Writes the folder RUN_certificate: certificate.html states on one page the error of each sheet,
    the smallest sweep in a stick phase, the pixel locking, how certain identities are, and the bias of
    σ_x/Λ_st at the threshold; certificate.csv and certificate.json hold the numbers. Exit status 1 if the
    certificate does not cover everything.

    For example:

        track certify test_tracks

        track certify test_tracks --films 6 --out certified

    Parameters
    ----------
    run
        Run folder.
    films
        Number of synthetic films. More take longer and average over more noise and motion.
    most_frames
        Largest number of frames of a film, from the middle of the run.
    """
    from vision.command import views

    return views.certify(run, films, most_frames, output)


def compare(
    *runs: Path, options: CompareOptions = CompareOptions(), output: OutputOptions = OutputOptions()
) -> int:
    """Compare several finished tests: one table, one μ, the collapse, change points and trends.

    Writes the folder comparison: tests.csv (one row per run), trends.json, all_events.csv, figures.npz,
    collapse.png, trends.png (if conditions vary), report.html and run.json. A run that cannot be used is
    named, the others are compared, and the exit status is 1.

    For example:

        track compare old_tracks new_tracks --table tests.csv

        track compare --table tests.csv --main-sample A --out two_samples

    Parameters
    ----------
    runs
        Run folders with a force recording; those of the table if none is given.
    """
    from vision.command import views

    return views.compare(runs, options, output)


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
    """Find stick-slip events, stiffness and model fits from a force recording alone.

    Writes the folder FILE_force: events.csv, models.json, run.json and force.png. Exit status 1 if there is a
    warning that matters.

    Parameters
    ----------
    file
        Recording of a testing machine: text, CSV, .TRA, .xlsx or .mat.
    free_t_star
        Also fit T* (the data hardly separate it from the friction coefficient).
    detection_limit
        Also measure the smallest slip that is found, by adding known slips to the recording.
    config
        TOML file with any of these options; the command line takes precedence.
    """
    from vision.command import recordings

    return recordings.force(
        file, (machine, sample), config, output, free_t_star=free_t_star, limit=detection_limit
    )


def modulus(
    file: Path, /, options: ModulusOptions = ModulusOptions(), *, output: OutputOptions = OutputOptions()
) -> int:
    """Measure Young's modulus of one sheet from push–pull cycles.

    Writes the folder FILE_modulus: cycles.csv, modulus.json, run.json, modulus.png and figures.npz. Exit
    status 1 if there is a warning that matters.

    Parameters
    ----------
    file
        Recording of a testing machine with time, load and displacement.
    """
    from vision.command import recordings

    return recordings.modulus(file, options, output)


def friction(
    *files: Path, options: FrictionOptions = FrictionOptions(), output: OutputOptions = OutputOptions()
) -> int:
    """Measure static and dynamic friction of two sheets from rheometer files, and fit μ_s = a(1 + b/N).

    Writes the folder FIRSTFILE_friction: friction.csv, friction.json, run.json, friction.png and figures.npz.
    A file or measurement that cannot be used is named, the others are used, and the exit status is 1.

    Parameters
    ----------
    files
        RheoCompass exports (UTF-16 or UTF-8, several results and intervals), or tables with units.
    """
    from vision.command import recordings

    return recordings.friction(files, options, output)


def simulate(directory: Path, /, options: SimulateOptions = SimulateOptions()) -> int:
    """Make a synthetic traction test: video, force.txt, truth.nc and the camera's timestamps.txt.

    Settings are taken from the preset, then the TOML file, then the options, then --set; later ones override.

    Parameters
    ----------
    directory
        Folder to make.
    """
    from vision.command import recordings

    return recordings.simulate(directory, options)


def campaign(table: Path | None = None, /, options: CampaignOptions = CampaignOptions()) -> int:
    """Track many films, on all cores of this machine or on a cluster, each only once.

    The table has one row per test. Its columns are film, force, any option of track, and the conditions
    sample, V_mm_min, n_test, RH_percent and T_C. All rows are checked before anything starts. A film is
    tracked again only if its files or options have changed. One that fails is tried twice; the others
    continue.

    Writes a run folder for each film in runs/, campaign.csv, index.html (updated while it runs), the
    comparison of the finished tests in pool/ and their tables as Parquet in tables/.

    For example:

        track campaign tests.csv --dry-run

        track campaign tests.csv --out series

        track campaign tests.csv --executor slurm --stage

        track campaign --watch /data/camera --config setup.toml

    Parameters
    ----------
    table
        CSV file; paths in it are relative to its folder.
    """
    from vision.command import campaign

    return campaign.campaign(table, options)

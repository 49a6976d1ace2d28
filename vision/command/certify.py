"""`track certify RUN`: what a recording can resolve."""

from __future__ import annotations

from pathlib import Path

from vision.command.console import complain, frame_progress, say
from vision.command.options import Flag
from vision.errors import InputError


def certify(
    run: Path,
    /,
    *,
    films: int = 3,
    most_frames: int = 600,
    out: Path | None = None,
    overwrite: Flag = False,
    quiet: Flag = False,
) -> int:
    """What the recording of a finished run can resolve, from films like it whose truth is known.

    Films are put together from the run's own mean ridges, light, motion and residuals, and go through the
    same analysis. certificate.html says on one page how large the error of each sheet is, the smallest sweep
    in a stick, the pull towards whole pixels, how safe identities are, and the bias of σ_x/Λ_st at the
    threshold; certificate.csv and certificate.json hold the numbers. Exit status 1 where something is not
    covered.

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
    out
        Folder; the run's name with _certificate in the working directory by default.
    overwrite
        Replace an earlier certificate.
    quiet
        No summary.
    """
    from dataclasses import replace

    from vision.certify import CertifySettings, certify_run, write_certificate
    from vision.certify.page import statements
    from vision.run import read_run

    for name, value, least in (("--films", films, 1), ("--most-frames", most_frames, 30)):
        if value < least:
            raise InputError(name, f"a whole number from {least}", f"{value}")
    finished = read_run(run)
    target = out or Path(f"{finished.folder.resolve().name}_certificate")
    if (target / "certificate.json").exists() and not overwrite:
        raise InputError(
            target, "a new folder", "an earlier certificate", "give `overwrite` or another `out`"
        )
    if target.exists() and not target.is_dir():
        raise InputError(target, "a folder", "a file", "give another `out`")
    settings = replace(CertifySettings(), films=films, most_frames=most_frames)
    with frame_progress("films", quiet=quiet) as progress:
        certificate = certify_run(finished, settings=settings, progress=progress)
    write_certificate(certificate, target)
    for line in certificate.warnings:
        complain(f"warning: {line}")
    if not quiet:
        wide = max(len(name) for name, _ in statements(certificate))
        say([*(f"{name:<{wide}}  {text}" for name, text in statements(certificate)), f"-> {target}/"])
    return 1 if certificate.warnings else 0

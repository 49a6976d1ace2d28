"""Write a certificate as one page, with its numbers as JSON and CSV."""

from __future__ import annotations

import math
from pathlib import Path

from vision.certify.certificate import Certificate
from vision.figures import Figure, Panel, Series
from vision.figures.style import DATA, PEAK, VALLEY, from_zero
from vision.folder import whole_file, write_csv, write_json
from vision.numeric import with_minus
from vision.report.page import render_page
from vision.summary import Answer


def write_certificate(certificate: Certificate, folder: Path) -> None:
    """Write certificate.html, certificate.json and certificate.csv, or none of them.  Raises: InputError."""
    csv, facts, page = (whole_file(folder / f"certificate.{kind}") for kind in ("csv", "json", "html"))
    with csv as csv_path, facts as facts_path, page as page_path:
        write_csv(certificate.sheets, csv_path, digits=None)
        write_json(certificate.facts, facts_path)
        _write_page(certificate, page_path)


def _write_page(c: Certificate, path: Path) -> None:
    if c.encoding:
        films_made = (
            "As the codec carries errors from frame to frame, no residual shows all of them: the films were "
            f"drawn without residuals on one of the recording's frames and encoded again ({c.encoding})."
        )
        not_shown = "Motion so fast or small that the recording does not show it."
    else:
        films_made = (
            "The residual holds noise, unequal pixels and the effect of the codec; each frame of the films "
            "has the residual of another frame of the same brightness."
        )
        not_shown = "Errors that last as long as a stick phase, which look like motion."
    render_page(
        path,
        [("Every sheet", [certificate_figure(c)])],
        {},
        title=Path(c.source).name,
        kind="certificate",
        subtitle=f"What this recording can resolve: {c.frames} frames, {len(c.sheets)} sheets, fit {c.fit}, "
        f"codec {c.codec or 'none'}",
        answers=statements(c),
        warnings=c.warnings,
        missing=[
            "A constant error of each sheet's position, which displacements do not have.",
            not_shown,
            "Frames in which a slip happens.",
        ],
        methods=[_methods(c, films_made)],
        tables=(),
    )


def certificate_figure(certificate: Certificate) -> Figure:
    """Return error, smallest sweep and pixel locking of every sheet."""
    table = certificate.sheets
    x = table["x_px"].to_numpy(float)
    error, stated, sweep, locking = (
        1000 * table[name].to_numpy(float)
        for name in ("error_px", "stated_px", "smallest_sweep_px", "locking_px")
    )
    panel = Panel(
        x_label="position of the sheet (px)",
        y_label="error, sweep (10⁻³ px)",
        series=(
            Series.points("RMS random error of a position", x, error, DATA),
            Series(label="stated by the run, x_err_px", x=x, y=stated, ink=DATA, dashed=True),
            Series.points("smallest sweep in a stick phase", x, sweep, PEAK, hollow=True),
            Series(label="pixel locking, peak to peak", x=x, y=locking, ink=VALLEY),
        ),
        y_range=from_zero(error, stated, sweep, locking),
        aspect=0.45,
    )
    caption = "Measured on films that are similar to the recording and have known truth."
    return panel.figure("certificate", caption, title="Accuracy of each sheet's position")


def statements(certificate: Certificate) -> list[Answer]:
    """Return what can be resolved."""
    c, errors_px = certificate, certificate.sheets["error_px"]
    sweep = Answer("Smallest sweep", "not known", "as no two slips are far enough apart")
    if math.isfinite(c.smallest_sweep_px):
        within = f"in a stick phase of {c.stick_frames:.0f} frames, {c.errors_resolved:g}"
        sweep = Answer(sweep.what, _length(c.smallest_sweep_px, c), f"{within} standard errors from zero")
    answers = [
        Answer(
            "Random error of a position",
            f"{'about ' if c.uncertain else ''}{_length(c.error_px, c)}",
            f"RMS over all sheets; that of the best is {_length(float(errors_px.min()), c)}, that of the "
            f"worst {_length(float(errors_px.max()), c)}",
            doubt=c.uncertain,
        ),
        Answer(
            "Stated errors",
            f"{100 * c.within_error:.0f} %",
            "of the errors are within the stated error (68 % if normal)",
        ),
        sweep,
        Answer("Pixel locking", _length(c.locking_px, c), "peak to peak, without noise"),
        Answer(
            "Identities",
            f"{c.wrong} wrong",
            f"of {c.films * c.frames * len(c.sheets)} positions, {100 * c.found:.1f} % found; largest jump "
            f"{c.largest_jump_pitches:.2f} pitches, and {_margin(c)}",
            doubt=c.identity_margin < 1,
        ),
    ]
    if (t := c.threshold) is None:
        needed = "as it needs a force recording, a clock and the pixel size"
        return [*answers, Answer("σ_x/Λ_st", "not known", needed)]
    at_threshold = Answer(
        f"σ_x/Λ_st at {t.ratio:g}",
        f"bias {_signed_percent(t.bias)}",
        f"(uncorrected {_signed_percent(t.raw_bias)}), single measurements scatter by "
        f"{100 * t.scatter:.1f} %, stated {100 * t.stated:.1f} %; {100 * t.called_stiff:.0f} % "
        "called stiff (50 % without bias)",
    )
    return [*answers, at_threshold]


def _margin(c: Certificate) -> str:
    """Return up to which multiple of the motion identities are correct, as text."""
    if c.identity_margin < 1:
        return "identities are not certain even with the recording's own motion"
    if c.identity_margin == c.identity_tried:
        more = "with more the sheets would overlap, or it was not tested"
        return f"identities are correct with {c.identity_margin:g} times the motion ({more})"
    return (
        f"identities are correct with {c.identity_margin:g} times the motion, not {c.identity_tried:g} times"
    )


def _signed_percent(share: float) -> str:
    return with_minus(f"{100 * share:+.1f} %")


def _length(px: float, c: Certificate) -> str:
    if not math.isfinite(px):
        return "–"
    return f"{_digits(px)} px" + (f" ({_digits(px * c.pixel_size_um)} µm)" if c.pixel_size_um else "")


def _digits(number: float) -> str:
    """Return a number with three digits, or fewer if the fourth decimal is reached before."""
    decimals = 4 if number <= 0 else min(max(2 - math.floor(math.log10(number)), 0), 4)
    return f"{number:.{decimals}f}"


def _methods(c: Certificate, films_made: str) -> str:
    return (
        "The recording was separated into its mean picture in coordinates that move with the sheets (the "
        "shape of each ridge, the gaps, the light), the smooth motion of the sheets between slips "
        f"including their common motion, and the residual. {films_made} Synthetic films of the same length"
        f" ({c.films}), with positions known exactly, were tracked like the recording. For the pixel "
        "locking the sheets cross one pixel without noise. For the identities the motion was enlarged. At"
        " the threshold every sheet creeps by √12 times the threshold times Λ_st in each stick phase, and"
        " the whole analysis follows. Repeated and missing frames, steps of the brightness, clipped "
        "pixels and distorted ridges are in the films where they are in the recording."
    )

"""Write a certificate as one page, with its numbers as JSON and CSV."""

from __future__ import annotations

import base64
import html
import math
from pathlib import Path

import numpy as np

import vision
from vision.certify.certificate import Certificate
from vision.figures import Figure, Panel, Series
from vision.figures.labels import to_html
from vision.figures.style import DATA, PEAK, VALLEY
from vision.run import write_json

_STYLE = """
body { font: 16px/1.5 Georgia, serif; max-width: 46em; margin: 2em auto; padding: 0 1em; color: #1a1a1a }
h1 { font-size: 1.5em; margin-bottom: 0.2em }
table { border-collapse: collapse; margin: 1em 0; width: 100% }
td, th { text-align: left; padding: 0.25em 0.8em 0.25em 0; vertical-align: top }
td, th { border-bottom: 1px solid #ccc }
img { width: 100% } .warning { border-left: 4px solid #b34700; padding-left: 0.8em }
"""


# How films were made, and what the certificate does not include.
_RESIDUALS = (
    "The residual holds noise, unequal pixels and the effect of the codec; each frame of the films has the "
    "residual of another frame of the same brightness.",
    "errors that last as long as a stick phase, which look like motion;",
)
_ENCODED = (
    "As the codec carries errors from frame to frame, no residual shows all of them: the films were drawn "
    "without residuals on one of the recording's frames and encoded again ({}).",
    "motion so fast or small that the recording does not show it;",
)


def write_certificate(certificate: Certificate, folder: Path) -> None:
    """Write certificate.html, certificate.json and certificate.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    certificate.sheets.to_csv(folder / "certificate.csv", index=False, lineterminator="\n")
    write_json(certificate.facts, folder / "certificate.json")
    (folder / "certificate.html").write_text(_page(certificate), encoding="utf-8", errors="replace")


def certificate_figure(certificate: Certificate) -> Figure:
    """Return error, smallest sweep and pixel locking of every sheet."""
    table = certificate.sheets
    x = table["x_px"].to_numpy(float)
    lines = (
        ("RMS error of a displacement", "error_px", DATA, "points", False),
        ("stated by the run, x_err", "stated_px", DATA, "line", True),
        ("smallest sweep in a stick phase", "smallest_sweep_px", PEAK, "points", True),
        ("pixel locking, peak to peak", "locking_px", VALLEY, "line", False),
    )
    series = tuple(
        Series(
            label=label,
            x=x,
            y=1000 * table[name].to_numpy(float),
            ink=ink,
            look=look,  # type: ignore[arg-type]
            dashed=look == "line" and other,
            hollow=look == "points" and other,
        )
        for label, name, ink, look, other in lines
    )
    top = 1.15 * float(np.nanmax([np.nanmax(line.y, initial=0.0) for line in series], initial=1.0))
    panel = Panel(
        x_label="position of the sheet (px)",
        y_label="thousandths of a pixel",
        series=series,
        y_range=(0.0, top),
        aspect=0.45,
    )
    return Figure(
        name="certificate",
        title="Accuracy of each sheet's position",
        caption="Measured on films that are similar to the recording and have known truth.",
        panels=(panel,),
        width_in=7.0,
    )


def statements(certificate: Certificate) -> list[tuple[str, str]]:
    """Return what can be resolved as pairs of quantity and text."""
    c = certificate
    answers = [
        (
            "Error of a displacement",
            f"{'about ' if c.uncertain else ''}{_length(c.error_px, c)} RMS over all sheets; from "
            f"{_length(float(c.sheets['error_px'].min()), c)} to "
            f"{_length(float(c.sheets['error_px'].max()), c)}",
        ),
        (
            "Stated errors",
            f"{100 * c.within_error:.0f} % of the errors are within the stated error (68 % if normal)",
        ),
        (
            "Smallest sweep",
            f"{_length(c.smallest_sweep_px, c)} in a stick phase of {c.stick_frames:.0f} frames, "
            "which differs from zero by three standard errors"
            if math.isfinite(c.smallest_sweep_px)
            else "not known: no two slips far enough apart",
        ),
        ("Pixel locking", f"{_length(c.locking_px, c)} peak to peak, without noise"),
        (
            "Identities",
            f"{c.wrong} wrong of {c.films * c.frames * len(c.sheets)} positions, "
            f"{100 * c.found:.1f} % found; largest jump {c.largest_jump_pitches:.2f} pitches, and "
            + _margin(c),
        ),
    ]
    if c.threshold is not None:
        t = c.threshold
        answers.append(
            (
                f"σ_x/Λ_st at {t.ratio:g}",
                f"bias {100 * t.bias:+.1f} % (uncorrected {100 * t.raw_bias:+.1f} %), single measurements "
                f"scatter by {100 * t.scatter:.1f} %, stated {100 * t.stated:.1f} %; "
                f"{100 * t.called_stiff:.0f} % called stiff (50 % without bias)",
            )
        )
    return answers


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


def _length(px: float, c: Certificate) -> str:
    if not math.isfinite(px):
        return "–"
    return f"{px:.4f} px" + (f" ({px * c.pixel_size_um:.3f} µm)" if c.pixel_size_um else "")


def _page(c: Certificate) -> str:
    rows = "".join(
        f"<tr><th>{to_html(name)}</th><td>{to_html(text)}</td></tr>" for name, text in statements(c)
    )
    notes = "".join(f'<p class="warning">{to_html(line)}</p>' for line in c.warnings)
    picture = base64.b64encode(certificate_figure(c).png()).decode()
    source = html.escape(Path(c.source).name)
    films_made, not_included = _ENCODED if c.encoding else _RESIDUALS
    films_made = films_made.format(html.escape(c.encoding))
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Certificate of {source}</title><style>{_STYLE}</style>
<h1>What this recording can resolve</h1>
<p>{source}: {c.frames} frames, {len(c.sheets)} sheets, fit {html.escape(c.fit)},
codec {html.escape(c.codec or "none")}; sheetvision {vision.__version__}.</p>
<table>{rows}</table>
{notes}
<img alt="Errors of every sheet" src="data:image/png;base64,{picture}">
<h2>How it was measured</h2>
<p>The recording was separated into its mean picture in coordinates that move with the sheets (the shape of
each ridge, the gaps, the light), the smooth motion of the sheets between slips including their common motion,
and the residual. {films_made}
Synthetic films of the same length ({c.films}), with positions known exactly, were tracked like the recording.
For the pixel locking the sheets cross one pixel without noise. For the identities the motion was enlarged.
At the threshold every sheet creeps by √12 times the threshold times Λ<sub>st</sub> in each stick phase, and
the whole analysis follows. Repeated and missing frames, steps of the brightness, clipped pixels and distorted
ridges are in the films where they are in the recording.</p>
<p>Not included: a constant error of each sheet's position, which displacements do not have; {not_included}
frames in which a slip happens. certificate.csv holds the numbers of every sheet, certificate.json all other
numbers.</p>
</html>
"""

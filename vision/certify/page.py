"""The certificate on one page, with its numbers as JSON and CSV."""

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


_RESIDUALS = (
    "That rest, the residual, holds noise, unequal pixels and what the codec did; the films got the "
    "residuals of other frames of the same brightness.",
    "errors that last as long as a stick, which look like motion;",
)
_ENCODED = (
    "The codec carries errors from frame to frame, so that no residual shows them all: the films were drawn "
    "without the rest on one of the recording's frames and encoded again ({}).",
    "motion so fast or small that the recording itself lost it;",
)


def write_certificate(certificate: Certificate, folder: Path) -> None:
    """Write certificate.html, certificate.json and certificate.csv."""
    folder.mkdir(parents=True, exist_ok=True)
    certificate.sheets.to_csv(folder / "certificate.csv", index=False, lineterminator="\n")
    write_json(certificate.facts, folder / "certificate.json")
    (folder / "certificate.html").write_text(_page(certificate), encoding="utf-8", errors="replace")


def certificate_figure(certificate: Certificate) -> Figure:
    """Error, smallest sweep and locking of every sheet."""
    table = certificate.sheets
    x = table["x_px"].to_numpy(float)
    lines = (
        ("RMS error of a displacement", "error_px", DATA, "points", False),
        ("stated by the run, x_err", "stated_px", DATA, "line", True),
        ("smallest sweep in a stick", "smallest_sweep_px", PEAK, "points", True),
        ("pull to whole pixels, peak to peak", "locking_px", VALLEY, "line", False),
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
        title="What each sheet's position is good for",
        caption="From films like the recording whose truth is known.",
        panels=(panel,),
        width_in=7.0,
    )


def statements(certificate: Certificate) -> list[tuple[str, str]]:
    """What can be resolved, in plain words: (question, answer)."""
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
            f"hold {100 * c.within_error:.0f} % of the truths (68 % if normal)",
        ),
        (
            "Smallest sweep",
            f"{_length(c.smallest_sweep_px, c)} in a stick of {c.stick_frames:.0f} frames, "
            "which differs from zero by three standard errors"
            if math.isfinite(c.smallest_sweep_px)
            else "not known: no two slips far enough apart",
        ),
        ("Pull towards whole pixels", f"{_length(c.locking_px, c)} peak to peak, without noise"),
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
    if c.identity_margin < 1:
        return "identities are not safe even with the recording's own motion"
    if c.identity_margin == c.identity_tried:
        more = "more would make them overlap or was not tried"
        return f"sheets are still told apart with {c.identity_margin:g} times the motion ({more})"
    safe, unsafe = c.identity_margin, c.identity_tried
    return f"sheets are told apart with {safe:g} times the motion, not with {unsafe:g} times"


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
    what_else, without = _ENCODED if c.encoding else _RESIDUALS
    what_else = what_else.format(html.escape(c.encoding))
    return f"""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Certificate of {source}</title><style>{_STYLE}</style>
<h1>What this recording can resolve</h1>
<p>{source}: {c.frames} frames, {len(c.sheets)} sheets, fit {html.escape(c.fit)},
codec {html.escape(c.codec or "none")}; sheetvision {vision.__version__}.</p>
<table>{rows}</table>
{notes}
<img alt="Errors of every sheet" src="data:image/png;base64,{picture}">
<h2>How it was found</h2>
<p>The recording was taken apart into its mean picture in the coordinate of the sheets (each ridge's own
shape, the gaps, the light), the smooth motion of the sheets between slips with what they all do together, and
everything else. {what_else}
{c.films} films of the same length, whose positions are known exactly, were tracked as the recording was.
For the pull towards whole pixels the sheets cross one pixel without noise; for the identities the motion was
enlarged; at the threshold every sheet creeps by √12 times the threshold times Λ<sub>st</sub> in each stick,
and the whole analysis follows. Frames that repeat the one before or are not there, steps of the brightness,
clipped tops and whatever pulls ridges aside are in the films where they are in the recording.</p>
<p>Not in it: a constant error of each sheet's position, which displacements do not have; {without}
frames in which a slip happens. certificate.csv holds the numbers of
every sheet, certificate.json the rest.</p>
</html>
"""

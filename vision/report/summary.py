"""The answer at the top of the page: what was found, and what to be careful about."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vision.report.numbers import percent, plus_minus, signed
from vision.report.results import RunResults
from vision.run.summary import flag_counts, noise_figures, warnings_that_matter

_END_ROWS = 6  # rows of the shell table, three sticks of two sides, that stand for either end of the video


@dataclass(frozen=True)
class Answer:
    """One box at the top. doubt: whether it must not be taken at face value."""

    what: str
    value: str
    detail: str
    doubt: bool = False


def answers(results: RunResults) -> list[Answer]:
    """The boxes, most important first."""
    boxes = (_sheets, _sticks, _shell, _clocks, _friction, _noise, _frames)
    return [answer for box in boxes if (answer := box(results)) is not None]


def subtitle(results: RunResults) -> str:
    """What was recorded, in one line."""
    profile = results.profile
    time = np.asarray(profile["time_s"].values, np.float64)
    known = time[np.isfinite(time)]
    span = f" over {known[-1] - known[0]:.4g} s" if known.size > 1 else ""
    scale = "no pixel size given" if results.pixel_size_um is None else f"{results.pixel_size_um:g} µm per px"
    return f"{profile.sizes['frame']} frames{span}, {profile.sizes['x']} columns, {scale}"


def warnings_of(results: RunResults) -> list[str]:
    """Every warning that matters, each once."""
    given = [str(line) for line in results.facts.get("warnings", ())]
    found = warnings_that_matter(results.profile, results.tracks)
    return list(dict.fromkeys([*given, *found]))


def _sheets(results: RunResults) -> Answer:
    tracks = results.tracks
    side, flags = tracks["side"].values, flag_counts(tracks)
    total = max(1, sum(flags.values()))
    ok = flags.get("ok", 0) / total
    return Answer(
        "sheets tracked",
        f"{side.size} ({(side < 0).sum()} left, {(side > 0).sum()} right)",
        f"{percent(ok)} of all positions measured; {tracks.attrs['ridges']} ridges",
        doubt=ok < 0.99,
    )


def _sticks(results: RunResults) -> Answer | None:
    if results.force is None or results.sticks is None:
        return None
    inside = 0 if results.motion is None else results.motion.sizes["event"]
    whole = int((results.sticks["flag"] == "ok").sum())
    detail = f"of {len(results.sticks)} in the force recording, {whole} of them without a flag"
    return Answer("stick phases in the video", str(inside), detail, doubt=inside == 0)


def _shell(results: RunResults) -> Answer | None:
    """First and last size of the shell: medians over the first and the last few sticks of both sides."""
    if results.shells is None:
        return None
    known = results.shells[results.shells["stiff_sheets"].notna()].sort_values("d_v_mm")
    if known.empty:
        return Answer("stiff shell", "not known", "too few sheets with a known deformation", doubt=True)
    ends = known.head(_END_ROWS), known.tail(_END_ROWS)
    first, last = (f"{end['stiff_sheets'].astype(float).median():.3g}" for end in ends)
    d_mm = known["d_v_mm"]
    size = first if first == last else f"{first} → {last}"
    where = f"from d = {d_mm.min():.2f} to {d_mm.max():.2f} mm" if d_mm.notna().any() else "d not known"
    return Answer("stiff shell", f"{size} sheets a side", f"σ_x/Λ_st below {results.threshold:g}, {where}")


def _clocks(results: RunResults) -> Answer | None:
    clock = results.clock
    if clock is None:
        return None
    told = f"drift {signed(clock.drift_ppm)} ppm, {clock.matched} slips matched"
    spread = f", residual {clock.residual_ms:.2g} ms" if np.isfinite(clock.residual_ms) else ""
    doubt = clock.status == "ambiguous"
    value = "ambiguous" if doubt else f"offset {clock.offset_s:.4f} s"
    why = {"ok": "", "given": f" ({clock.how})", "ambiguous": f"; likeliest offset {clock.offset_s:.3f} s"}
    return Answer("clocks", value, told + spread + why[clock.status], doubt=doubt)


def _friction(results: RunResults) -> Answer | None:
    fits = results.fits
    if fits is None:
        return None
    modulus = f"Y_eff = {fits.modulus_GPa.value:.3g} GPa"
    detail = f"N̂ = {fits.n_hat_N.value:.3g} N, A = {fits.amplitude.value:.3g}, {modulus}"
    return Answer("friction coefficient", f"μ = {plus_minus(fits.mu)}", detail)


def _noise(results: RunResults) -> Answer:
    figures = noise_figures(results.tracks, results.pixel_size_um)
    if not np.isfinite(figures["measured_px"]):
        return Answer(
            "noise of a position", "not known", "too few positions in a row to measure it", doubt=True
        )
    length = "" if results.pixel_size_um is None else f" = {figures['measured_um']:.2g} µm"
    return Answer(
        "noise of a position",
        f"{figures['measured_px']:.2g} px{length}",
        f"median of the sheets, as measured; {figures['predicted_px']:.2g} px expected from the picture",
        doubt=bool(figures["measured_px"] > 3 * figures["predicted_px"]),
    )


def _frames(results: RunResults) -> Answer:
    a = results.profile.attrs
    bad = {name: int(a[f"frames_{name}"]) for name in ("lost", "blank", "corrupt")}
    told = (
        ", ".join(f"{count} {name}" for name, count in bad.items() if count) or "none lost, blank or corrupt"
    )
    return Answer(
        "frames", f"{a['frames_read']} of {a['frames_expected']} read", told, doubt=any(bad.values())
    )

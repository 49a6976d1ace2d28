"""Ready-made experiments."""

from __future__ import annotations

from dataclasses import replace

from vision.errors import InputError
from vision.experiment.settings import (
    Camera,
    Clocks,
    Experiment,
    LoadCell,
    Mechanics,
    Optics,
    Sheets,
)


def preset(name: str, *, seed: int = 0) -> Experiment:
    """One of the ready-made experiments.

    Parameters
    ----------
    name
        - ``"paper"``: 1 mm/min with the publication's numbers, d near 13.7 mm.
        - ``"late"``: d near 17 mm, sweeps under a pixel.
        - ``"fast"``: 10 mm/min, two slopes in every stick.
        - ``"fresh"``: a new sample with 600 N peaks, jumps over half a pitch.
        - ``"hostile"``: everything at its worst at once.
        - ``"sheets"``: 2M springs decide by themselves which sheets stick, with the publication's numbers.
    seed
        Of all random numbers.

    Raises
    ------
    InputError
        For another name.
    """
    if name not in _PRESETS:
        raise InputError("`preset`", ", ".join(_PRESETS), name)
    return replace(_PRESETS[name], seed=seed)


_PRESETS = {
    "paper": Experiment(),
    "late": Experiment(
        clocks=Clocks(offset_s=240.0, drift_ppm=50.0),
        camera=Camera(duration_s=15.0),
    ),
    "fast": Experiment(
        mechanics=Mechanics(speed_mm_min=10.0, early_stiffness_ratio=1.8, slip_s=0.005),
        camera=Camera(fps=160.0, duration_s=5.0, exposure_s=0.002),
        clocks=Clocks(offset_s=4.0, force_rate_Hz=2000.0),
        load_cell=LoadCell(lowpass_s=0.001),
    ),
    "fresh": Experiment(
        mechanics=Mechanics(mu=1.003, period_jitter=0.1, peak_scatter=0.03),
        sheets=Sheets(pitch_px=11.0, pitch_jitter=0.04),
        optics=Optics(fwhm_px=5.5, fwhm_spread=0.03),
        clocks=Clocks(offset_s=6.0),
    ),
    "hostile": Experiment(
        mechanics=Mechanics(peak_scatter=0.03, period_jitter=0.1, softening=0.1),
        sheets=Sheets(pitch_jitter=0.12, sweep_scatter=0.1, bow_px=2.0, slip_delay_s=0.02),
        optics=Optics(
            shape="shouldered",
            fwhm_spread=0.12,
            contrast=0.12,
            contrast_spread=0.35,
            faint_sheets=4,
            gradient=0.4,
            flicker=0.03,
            tilt_deg=1.0,
            distortion=0.01,
            drift_px=1.5,
            vibration_px=0.1,
            texture=0.15,
            dust=40,
        ),
        camera=Camera(fps=25.0, exposure_s=0.01, read_noise_e=8.0, prnu=0.015),
        clocks=Clocks(offset_s=27.3, drift_ppm=-3000.0, dropped=0.01, stale=0.02, force_rate_Hz=100.0),
        load_cell=LoadCell(lowpass_s=0.01, noise_N=0.5, drift_N=2.0),
    ),
    "sheets": Experiment(mechanics=Mechanics(model="sheets")),
}

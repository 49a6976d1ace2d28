"""Event tables of simulated tests: several samples, speeds and build-ups, with the noise of a recording."""

from __future__ import annotations

import numpy as np
import pandas as pd
import xarray as xr

from tests.scenes.sawtooth import recording
from vision.experiment import simulate_pull
from vision.experiment.settings import Mechanics
from vision.models import equations, fit_models
from vision.sample import Sample

SAMPLES = (
    Sample(),
    Sample(sheets_per_block=20, thickness_mm=0.15),
    Sample(sheets_per_block=30, thickness_mm=0.075, width_mm=50.0, length_mm=60.0),
)
SPEEDS = (0.5, 1.0, 5.0, 10.0)
BUILD_UPS_MM = (0.0, 0.05, 0.1, 0.2, 0.4)
NOISE_N, RATE_HZ = 0.05, 200.0
PARAMETERS = ("mu", "t0_N", "amplitude", "scale_mm", "modulus_GPa")


def build_up_of(seed: int) -> float:
    """Length of the build-up of one test, mm."""
    return BUILD_UPS_MM[seed // (len(SAMPLES) * len(SPEEDS)) % len(BUILD_UPS_MM)]


def truth_of(seed: int) -> tuple[Sample, Mechanics]:
    """The sample and the pull of one test."""
    rng = np.random.default_rng(seed)
    sample = SAMPLES[seed % len(SAMPLES)]
    speed = SPEEDS[seed // len(SAMPLES) % len(SPEEDS)]
    # One α for all samples, so that forces are as published.
    same = 0.1 * 25**2 / (sample.thickness_mm * sample.sheets_per_block**2)
    mechanics = Mechanics(
        speed_mm_min=speed,
        mu=float(rng.uniform(0.82, 0.93) * same),
        t0_N=float(rng.uniform(-5, 5)),
        amplitude=float(rng.uniform(0.3, 0.4)),
        n_hat_N=float(rng.uniform(0.48, 0.65) / same),
        modulus_GPa=float(rng.uniform(3.2, 4.4)),
        buildup_mm=build_up_of(seed),
    )
    return sample, mechanics


def event_table(seed: int) -> tuple[xr.Dataset, pd.DataFrame]:
    """The facts of the recording and its events, measured with the noise of a load cell."""
    sample, mechanics = truth_of(seed)
    made = simulate_pull(mechanics, seed=seed, sample=sample).events()
    rng = np.random.default_rng([seed, 1])
    rate = RATE_HZ * mechanics.speed_mm_min  # as many samples a stick at any speed
    length = made["stick_length_um"].to_numpy() / 1000
    samples = np.maximum(length / (mechanics.speed_mm_min / 60) * rate, 4)
    # A line through n points: its slope over the central half, its ends over the whole.
    slope = NOISE_N * np.sqrt(12 / (samples / 2)) / (length / 2)
    corner = 2 * NOISE_N / np.sqrt(samples)
    valley, peak = (made[name] + corner * rng.standard_normal(len(made)) for name in ("F_v_N", "F_p_N"))
    few = np.arange(10.0)
    facts = recording(few, few, mechanics.d0_mm + few, mechanics.speed_mm_min)
    return facts, made.assign(
        F_v_N=valley,
        F_p_N=peak,
        dF_N=peak - valley,
        K_N_per_mm=made["K_N_per_mm"] + slope * rng.standard_normal(len(made)),
        K_err_N_per_mm=slope,
        flag="ok",
    )


def pulls(seed: int, *, fit_range_mm: tuple[float, float] | None = None) -> dict[str, float]:
    """(fitted − true) / stated error of every parameter of one test."""
    sample, mechanics = truth_of(seed)
    force, events = event_table(seed)
    fits = fit_models(force, events, sample, fit_range_mm=fit_range_mm)
    scale = equations.separation_scale_mm(mu=mechanics.mu, n_hat_N=mechanics.n_hat_N, sample=sample)
    true = {name: float(getattr(mechanics, name, scale)) for name in PARAMETERS}
    found = {name: getattr(fits, name) for name in PARAMETERS}
    return {name: (found[name].value - true[name]) / found[name].error for name in PARAMETERS}

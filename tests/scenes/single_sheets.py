"""Raw files of measurements on single sheets with known truth: rheometer exports and push–pull cycles."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from vision.experiment.mechanics import random_stream
from vision.experiment.settings import ForceFile
from vision.experiment.simulate import write_force
from vision.models.equations import sheet_stiffness
from vision.models.friction import PUBLISHED_FRICTION, RADIUS_MM, FrictionSettings, StaticFriction
from vision.models.modulus import PUBLISHED_SHEET
from vision.numeric import Floats
from vision.sample import Sample

# --- two discs on the rheometer -----------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class DiscTest:
    """Two discs of paper that rotate against each other, with one measurement per normal force."""

    loads_N: tuple[float, ...] = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0, 1.5, 2.0)  # one measurement each
    law: StaticFriction = PUBLISHED_FRICTION  # true μ_s(N)
    mu_dynamic: float = 0.44  # true μ_d at every load
    radius_mm: float = RADIUS_MM
    speed_rad_s: float = 0.1  # Ω
    end_deg: float = 125.0  # total rotation
    peak_deg: float = 0.12  # angle at which μ_s is reached
    peak_width_deg: float = 0.04  # width over which μ falls to μ_d
    ripple: float = 0.01  # relative slow variation of μ_d
    ripple_deg: float = 11.0  # period of the ripple
    fine_Hz: float = 1000.0  # sampling rate of the first interval, of length `fine_s`
    fine_s: float = 0.5
    coarse_Hz: float = 20.0  # sampling rate of the second interval
    torque_noise_mN_m: float = 0.01  # white noise
    normal_noise_N: float = 0.003
    normal_drift: float = 0.0  # relative decrease of N until the end
    seed: int = 0  # seed of the noise

    def friction(self, load_N: float, angle_deg: ArrayLike) -> Floats:
        """Return the true μ(φ): a quarter sine up to μ_s, then a Gaussian down to μ_d with its ripple."""
        x = np.asarray(angle_deg, float)
        peak = float(self.law.mu_s(load_N))
        later = np.maximum(x - self.peak_deg, 0.0)
        fall = (peak - self.mu_dynamic) * np.exp(-0.5 * (later / self.peak_width_deg) ** 2)
        slow = self.mu_dynamic * self.ripple * np.sin(2 * np.pi * later / self.ripple_deg)
        rise = peak * np.sin(0.5 * np.pi * np.clip(x / self.peak_deg, 0, 1))
        return np.where(x < self.peak_deg, rise, self.mu_dynamic + fall + slow)

    def times_s(self) -> tuple[Floats, Floats]:
        """Return the sampling times of the fine and the coarse interval."""
        end_s = math.radians(self.end_deg) / self.speed_rad_s
        coarse = np.arange(self.fine_s, end_s, 1 / self.coarse_Hz)
        return np.arange(0, self.fine_s, 1 / self.fine_Hz), coarse

    def truth(self) -> pd.DataFrame:
        """Return N_N, mu_s and mu_d (exact mean over the range of angles) of each measurement."""
        angle = np.linspace(*FrictionSettings().dynamic_deg, 400_001)
        mean = [float(np.trapezoid(self.friction(load, angle)) / (angle.size - 1)) for load in self.loads_N]
        rows = [
            {"N_N": load, "mu_s": float(self.law.mu_s(load)), "mu_d": mu_d}
            for load, mu_d in zip(self.loads_N, mean, strict=True)
        ]
        return pd.DataFrame(rows)


def disc_record(test: DiscTest, load_N: float, time_s: Floats, *, number: int = 0) -> pd.DataFrame:
    """Return the recording: time_s, torque_mN_m, normal_force_N, angle_mrad, speed_rpm."""
    rng = random_stream(test.seed, "rheometer", number, time_s.size)
    angle_deg = np.degrees(test.speed_rad_s * np.maximum(time_s, 0.0))
    normal = load_N * (1 - test.normal_drift * angle_deg / test.end_deg)
    torque = 2 / 3 * test.friction(load_N, angle_deg) * normal * test.radius_mm
    return pd.DataFrame(
        {
            "time_s": time_s,
            "torque_mN_m": torque + test.torque_noise_mN_m * rng.standard_normal(time_s.size),
            "normal_force_N": normal + test.normal_noise_N * rng.standard_normal(time_s.size),
            "angle_mrad": np.radians(angle_deg) * 1000,
            "speed_rpm": np.where(time_s > 0, test.speed_rad_s * 30 / np.pi, 0.0),
        }
    )


def write_rheocompass(
    path: str | os.PathLike[str],
    test: DiscTest,
    *,
    encoding: Literal["utf-16", "utf-8", "utf-8-sig"] = "utf-16",
    separator: Literal["\t", ",", ";"] = "\t",
    decimal: Literal[".", ","] = ".",
    torque_unit: Literal["mN·m", "µN·m", "N·m"] = "mN·m",
    angle_unit: Literal["mrad", "rad", "°"] = "mrad",
    unit_rows: Literal[1, 2] = 2,
) -> pd.DataFrame:
    """Write a RheoCompass export and return its truth, one row per result.

    There is one result per load, with a waiting interval, a finely and a coarsely sampled one. Numbers with a
    decimal comma are quoted if commas separate columns.

    unit_rows: rows between the names and the data; the last has the units.
    """
    torque = {"mN·m": 1.0, "µN·m": 1e3, "N·m": 1e-3}[torque_unit]
    angle = {"mrad": 1.0, "rad": 1e-3, "°": math.degrees(1e-3)}[angle_unit]
    names = ["Point No.", "Time", "Torque", "Normal Force", "Deflection Angle", "Rotational Speed", "Status"]
    units = ["", "[s]", f"[{torque_unit}]", "[N]", f"[{angle_unit}]", "[1/min]", ""]
    times = (np.arange(-2.0, 0.0, 0.1), *test.times_s())
    rows: list[Sequence[str]] = [["Project:", "Paper on paper"], ["Test:", "Disc 25 mm"], []]
    for number, load in enumerate(test.loads_N):
        rows += [["Result:", f"Friction {load:g} N"], []]
        for interval, time in enumerate(times, start=1):
            record = disc_record(test, load, time, number=3 * number + interval)
            if interval == 1:
                record["torque_mN_m"] = 0.0
            rows.append(["Interval and data points:", str(interval), str(len(record))])
            rows.append(["Interval data:", *names])
            rows += [["", *([""] * len(names))]] * (unit_rows - 1) + [["", *units]]
            columns = ["time_s", "torque_mN_m", "normal_force_N", "angle_mrad", "speed_rpm"]
            scaled = record[columns] * np.array([1.0, torque, 1.0, angle, 1.0])
            rows += [
                ["", str(point), *(f"{value:.7g}".replace(".", decimal) for value in values), "TG"]
                for point, values in enumerate(scaled.itertuples(index=False), start=1)
            ]
            rows.append([])
    quoted = [[f'"{cell}"' if separator in cell else cell for cell in row] for row in rows]
    text = "\r\n".join(map(separator.join, quoted))
    Path(path).write_bytes(text.encode(encoding))
    return test.truth()


def write_rheometer_csv(
    path: str | os.PathLike[str], test: DiscTest, *, load_N: float | None = None, normal: bool = True
) -> pd.DataFrame:
    """Write one measurement as a table with names and units in its header; return its truth, one row.

    load_N: the load, by default the first one.  normal: whether the normal force is recorded.
    """
    load = test.loads_N[0] if load_N is None else load_N
    record = disc_record(test, load, np.concatenate(test.times_s()))
    columns = {
        "Time (s)": record["time_s"],
        "Torque (mN·m)": record["torque_mN_m"],
        "Angle (°)": np.degrees(record["angle_mrad"] / 1000),
    }
    if normal:
        columns["Normal force (N)"] = record["normal_force_N"]
    pd.DataFrame(columns).to_csv(path, index=False, float_format="%.7g", encoding="utf-8")
    return replace(test, loads_N=(load,)).truth()


# --- push–pull cycles of one sheet --------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class CyclesTest:
    """One sheet between two clamps whose distance Δ is cycled about its free length."""

    sheet: Sample = PUBLISHED_SHEET  # ε, W and the free length L = Δ0
    modulus_GPa: float = 2.5  # true Y_p
    cycles: int = 5
    speed_mm_min: float = 1.0  # |dΔ/dt|
    rate_Hz: float = 50.0
    stretch_mm: float = 0.08  # largest Δ − Δ0
    slack_mm: float = 0.05  # largest Δ0 − Δ, at which the sheet buckles and carries no load
    knee_mm: float = 0.002  # width over which the sheet becomes taut
    friction_N: float = 0.8  # yield force f_y of a parallel Jenkins element, which causes the hysteresis
    friction_N_per_mm: float = 200.0  # stiffness of this element
    growth: float = 0.0  # relative increase of the modulus per cycle
    machine_stiffness_N_per_mm: float = math.inf  # in series
    noise_N: float = 0.05  # noise of the load
    quantum_mm: float = 5e-5  # resolution of the recorded displacement
    absolute: bool = False  # whether the recorded displacement is Δ; else it starts at 0 at Δ = L
    seed: int = 0  # seed of the noise

    @property
    def stiffness_N_per_mm(self) -> float:
        """True k = εWY/L of the first cycle."""
        return float(sheet_stiffness(modulus_GPa=self.modulus_GPa, sample=self.sheet))

    @property
    def loop_mJ(self) -> float:
        """Energy dissipated by the Jenkins element in a cycle of travel X: 2 f_y (X − 2 f_y / k_y)."""
        travel = self.stretch_mm + self.slack_mm
        return 2 * self.friction_N * (travel - 2 * self.friction_N / self.friction_N_per_mm)


def cycles_record(test: CyclesTest) -> pd.DataFrame:
    """Return the recording: time_s, crosshead_mm, load_N; and the exact force in force_N.

    It starts at Δ = L, within the range of Δ, so the path to the first lower end is not a cycle.
    """
    rng = random_stream(test.seed, "push-pull")
    up, down = test.stretch_mm, -test.slack_mm
    corners = np.array([0.0, down, *([up, down] * test.cycles)])
    path = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(corners)))])
    time = np.arange(0, path[-1] * 60 / test.speed_mm_min, 1 / test.rate_Hz)
    travelled = test.speed_mm_min / 60 * time
    stretch = np.interp(travelled, path, corners)
    cycle = np.clip((np.searchsorted(path, travelled, side="right") - 2) // 2, 0, test.cycles - 1)
    stiffness = test.stiffness_N_per_mm * (1 + test.growth * cycle)
    taut = (
        test.knee_mm * np.logaddexp(0.0, stretch / test.knee_mm) if test.knee_mm else np.maximum(stretch, 0)
    )
    force = stiffness * taut + _jenkins(stretch, test.friction_N, test.friction_N_per_mm)
    crosshead = stretch + force / test.machine_stiffness_N_per_mm
    crosshead = crosshead + (test.sheet.length_mm if test.absolute else 0.0)
    if test.quantum_mm:
        crosshead = np.round(crosshead / test.quantum_mm) * test.quantum_mm
    load = force + test.noise_N * rng.standard_normal(time.size)
    return pd.DataFrame({"time_s": time, "crosshead_mm": crosshead, "load_N": load, "force_N": force})


def _jenkins(position: Floats, limit: float, stiffness: float) -> Floats:
    """Return the force of a spring with a slider that starts at rest (play operator)."""
    reach = limit / stiffness if limit else 0.0
    force, anchor = np.empty_like(position), 0.0
    for k, x in enumerate(position.tolist()):
        anchor = min(max(anchor, x - reach), x + reach)
        force[k] = stiffness * (x - anchor)
    return force


def write_cycles(path: str | os.PathLike[str], test: CyclesTest) -> pd.DataFrame:
    """Write the recording as an MTS TestSuite export.

    Returns the truth, one row per cycle: ``k_N_per_mm``, ``Y_p_GPa``, ``loop_mJ``.
    """
    write_force(Path(path), cycles_record(test), ForceFile())
    share = 1 + test.growth * np.arange(test.cycles)
    return pd.DataFrame(
        {
            "k_N_per_mm": test.stiffness_N_per_mm * share,
            "Y_p_GPa": test.modulus_GPa * share,
            "loop_mJ": test.loop_mJ,
        }
    )

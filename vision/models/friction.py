"""Friction of two sheets on a rheometer: μ_s and μ_d of each measurement, and the law μ_s(N) = a (1 + b/N).

Two discs of paper of radius R, pressed together by N, turn against each other; the torque gives the friction
coefficient. Source: Plati, Restagno & Poulard, appendix "Single sheets characterization".
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import scipy
from numpy.typing import ArrayLike

from vision.data import Tunable
from vision.errors import InputError, check_positive
from vision.models.rheometer import ROTATION, RotationMetadata
from vision.numeric import Floats, white_noise

RADIUS_MM = 25.0
"""Radius of the publication's discs."""

RIM_CAVEAT = (
    "μ_s takes the whole disc to be at its threshold; where slip starts at the rim (shear ∝ r), the torque "
    "is μ_s N R / 2 and the value is 0.75 times the true μ_s"
)
"""Assumption of the static coefficient, to be shown beside it."""


@dataclass(frozen=True, kw_only=True, repr=False)
class FrictionSettings(Tunable):
    """Tunable constants of the measurement of μ_s and μ_d from a curve μ(φ)."""

    dynamic_deg: tuple[float, float] = (0.3, 120.0)
    """Range of the travelled angle over which μ_d is the mean; the publication's. A smaller start includes
    the static peak (`test_a_mean_from_zero_takes_in_the_peak`)."""
    peak_before_deg: float = 5.0
    """Angle up to which the static peak is searched. Larger mistakes a later, slower maximum for the static
    one; smaller misses the peak of a soft mounting, which is twisted first
    (`test_a_later_maximum_is_not_the_static_one`)."""
    peak_noise: float = 8.0
    """Least decrease after the peak, in standard deviations of the noise. Larger misses peaks in noise;
    smaller mistakes noise for the peak."""
    normal_window_s: float = 1.0
    """Window of the running mean of the measured normal force. Longer averages more noise, shorter follows a
    controller that overshoots (`test_a_drifting_normal_force_is_followed`)."""
    normal_window_samples: int = 50
    """`normal_window_s` in samples, for files without times: rheometers write 25 to 100 samples a second."""
    blocks: int = 12
    """Number of blocks whose means give the error of μ_d. With more, blocks are shorter than the fluctuations
    of μ and the error is too small."""


def disc_friction(
    torque_N_m: ArrayLike, *, normal_force_N: ArrayLike, radius_mm: float = RADIUS_MM
) -> Floats:
    r"""Friction coefficient of two discs of radius R from their torque, if the whole area slides at uniform
    pressure; NaN where the normal force is not positive.

    .. math:: \tau = \int_0^R \mu \frac{N}{\pi R^2}\, 2\pi r^2\, dr = \tfrac{2}{3}\mu N R,
              \qquad \mu = \frac{3}{2}\frac{\tau}{R N}

    Torque and normal force broadcast. Source: appendix "Single sheets characterization".
    """
    load = np.asarray(normal_force_N, float)
    usable = np.where(load > 0, load, np.nan)
    return np.asarray(3 * np.asarray(torque_N_m, float) / (2 * radius_mm / 1000 * usable))


@dataclass(frozen=True, kw_only=True)
class DiscFriction:
    """Friction coefficients of one measurement with their standard errors."""

    source: str  # file
    measurement: str
    N_N: float  # mean normal force over the range of μ_d
    N_err_N: float  # 0 where N was given
    mu_s: float  # first maximum; NaN if the curve has none
    mu_s_err: float
    mu_d: float  # mean over the range of angles
    mu_d_err: float
    peak_deg: float  # travelled angle of the maximum
    # One row per sample: angle_deg (travelled), mu, N_N (given, or the running mean of the recorded one) and
    # N_err_N (its standard error).
    curve: pd.DataFrame = field(repr=False, compare=False)
    warnings: tuple[str, ...] = ()  # possible errors of these numbers


def _curve(
    rotation: pd.DataFrame, radius_mm: float, normal_force_N: float | None, settings: FrictionSettings
) -> pd.DataFrame:
    """Friction coefficient against the travelled angle, as in `DiscFriction`."""
    ROTATION.check(rotation)
    about = f"{RotationMetadata.of(rotation).source}: {RotationMetadata.of(rotation).measurement}"
    check_positive(radius_mm=radius_mm, normal_force_N=normal_force_N)
    rows = len(rotation)
    if normal_force_N is not None:
        load, error = np.full(rows, float(normal_force_N)), np.zeros(rows)
    elif "normal_force_N" not in rotation or rotation["normal_force_N"].isna().all():
        raise InputError(about, "a normal force", "none recorded", "give `normal_force_N`")
    else:
        load, error = _running_load(rotation, settings)
    if (load <= 0).any() or not np.isfinite(load).all():
        wanted = "a compressive normal force all along"
        raise InputError(about, wanted, f"{load.min():.3g} to {load.max():.3g} N", "give `normal_force_N`")
    torque = rotation["torque_N_m"].to_numpy(float)
    return pd.DataFrame(
        {
            "angle_deg": np.degrees(rotation["angle_rad"].to_numpy(float)),
            "mu": disc_friction(torque, normal_force_N=load, radius_mm=radius_mm),
            "N_N": load,
            "N_err_N": error,
        }
    )


def _running_load(rotation: pd.DataFrame, settings: FrictionSettings) -> tuple[Floats, Floats]:
    """Running mean of the normal force and its standard error; compression is positive. Without times, it is
    one over samples."""
    time, window = rotation["time_s"].to_numpy(float), settings.normal_window_s
    record_N = rotation["normal_force_N"].to_numpy(float)
    known = np.isfinite(record_N)
    if not np.isfinite(time).all():
        time, window = np.arange(len(time), dtype=float), float(settings.normal_window_samples)
    at, load = time[known], record_N[known]
    load = load if float(np.median(load)) >= 0 else -load
    total = np.concatenate([[0.0], np.cumsum(load)])
    first = np.searchsorted(at, time - window / 2, side="left")
    last = np.maximum(np.searchsorted(at, time + window / 2, side="right"), first + 1)
    last = np.minimum(last, load.size)
    first = np.minimum(first, last - 1)
    count = last - first
    return (total[last] - total[first]) / count, _noise(load) / np.sqrt(count)


def _noise(values: Floats) -> float:
    """Standard deviation of the noise; 0 for too few values to tell."""
    return white_noise(values) if values.size > 4 else 0.0


def friction_of_disc(
    rotation: pd.DataFrame,
    *,
    radius_mm: float = RADIUS_MM,
    normal_force_N: float | None = None,
    settings: FrictionSettings = FrictionSettings(),
) -> DiscFriction:
    """Measure μ_s and μ_d of one measurement, with standard errors.

    Parameters
    ----------
    rotation
        One measurement from `read_rheometer`.
    radius_mm
        Radius R of the discs.
    normal_force_N
        N, if it was not recorded or is to replace the recorded one.
    settings
        See `FrictionSettings`.

    Returns
    -------
    DiscFriction
        μ_s is the first maximum of μ(φ): the height of a parabola through the surrounding samples, if one
        fits them within the noise, else the highest sample of a sharp peak. μ_d is the mean over the angle
        from 0.3° to 120°; its error follows from the scatter of block means. The errors include that of a
        measured N. Sheets differ from each other by more than these errors.

    Raises
    ------
    InputError
        If there is no normal force, it is not compressive throughout, or the rotation ends before the range
        of μ_d.

    Notes
    -----
    If slip starts at the rim, the static value is 0.75 times the true one: `RIM_CAVEAT`. Source: appendix
    "Single sheets characterization".
    """
    facts = RotationMetadata.of(rotation)
    curve = _curve(rotation, radius_mm, normal_force_N, settings)
    angle, mu = curve["angle_deg"].to_numpy(), curve["mu"].to_numpy()
    low, high = settings.dynamic_deg
    inside = (angle >= low) & (angle <= high)
    if int(inside.sum()) < settings.blocks:
        wanted = f"{settings.blocks} samples between {low:g}° and {high:g}°"
        found = f"{int(inside.sum())} (rotation from 0° to {angle.max():.3g}°)"
        raise InputError(f"{facts.source}: {facts.measurement}", wanted, found)
    mean_load = float(curve["N_N"].to_numpy()[inside].mean())
    load_err = 0.0
    if normal_force_N is None:
        load = rotation["normal_force_N"].to_numpy(float)[inside]
        load = load[np.isfinite(load)]
        load_err = _noise(load) / math.sqrt(max(load.size, 1))
    mu_d, scatter = _mean_over_angle(angle[inside], mu[inside], settings)
    noise = _noise(mu[inside])
    peak = _first_maximum(angle, mu, noise, mu_d, settings)
    mu_s, mu_s_err, peak_deg = (math.nan,) * 3
    if peak is not None:
        mu_s, fit_err = _peak_height(mu, peak, noise)
        share = float(curve["N_err_N"].iloc[peak] / curve["N_N"].iloc[peak])
        mu_s_err, peak_deg = math.hypot(fit_err, mu_s * share), float(angle[peak])
    samples = int(np.argmax(angle >= low))
    return DiscFriction(
        source=facts.source,
        measurement=facts.measurement,
        N_N=mean_load,
        N_err_N=load_err,
        mu_s=mu_s,
        mu_s_err=mu_s_err,
        mu_d=mu_d,
        mu_d_err=math.hypot(scatter, mu_d * load_err / mean_load),
        peak_deg=peak_deg,
        curve=curve,
        warnings=(*facts.warnings, *_warnings(angle, peak_deg, samples, settings)),
    )


def _warnings(angle: Floats, peak_deg: float, samples: int, settings: FrictionSettings) -> list[str]:
    """Warnings of a short rotation, a missing or late maximum, and an unresolved peak."""
    low, high = settings.dynamic_deg
    found = []
    if angle.max() < 0.98 * high:
        found.append(f"the rotation ends at {angle.max():.3g}°: μ_d is the mean from {low:g}° to there")
    if math.isnan(peak_deg):
        found.append(f"no maximum before {settings.peak_before_deg:g}°: no μ_s")
    elif peak_deg > low:
        found.append(f"the first maximum lies at {peak_deg:.2g}°, within the range of μ_d")
    if samples < 5:  # they must show the rise to the peak and the fall after it
        found.append(
            f"{samples} samples before {low:g}°: the static peak is not resolved and μ_s may be too small"
        )
    return found


def _mean_over_angle(angle: Floats, mu: Floats, settings: FrictionSettings) -> tuple[float, float]:
    """Mean of μ over the angle, and its standard error from the means of blocks of equal length."""
    edges = np.linspace(angle[0], angle[-1], settings.blocks + 1)
    order = np.argsort(angle, kind="stable")
    area = scipy.integrate.cumulative_trapezoid(mu[order], angle[order], initial=0)
    means = np.diff(np.interp(edges, angle[order], area)) / np.diff(edges)
    return float(means.mean()), float(means.std(ddof=1) / math.sqrt(means.size))


def _first_maximum(
    angle: Floats, mu: Floats, noise: float, mu_d: float, settings: FrictionSettings
) -> int | None:
    """Index of the first maximum after which μ decreases significantly; None without one in the range."""
    count = int(np.searchsorted(np.maximum.accumulate(angle), settings.peak_before_deg, side="right"))
    early = mu[:count]
    if not early.size:
        return None
    highest = np.maximum.accumulate(early)
    decreased = (highest - early > settings.peak_noise * noise) & (highest > 0.5 * mu_d)
    return int(np.argmax(early[: int(np.argmax(decreased)) + 1])) if decreased.any() else None


def _peak_height(mu: Floats, peak: int, noise: float) -> tuple[float, float]:
    """Height of the peak and its error: of the widest parabola of at most 41 samples that fits within the
    noise, of which 0.6 is used, as a bias just hidden by the noise increases with the cube of the width. If
    even the narrowest does not fit, the peak is sharp and the error is half a step between samples."""
    reach = min(peak, mu.size - 1 - peak, 20)
    fitting = [half for half in range(2, reach + 1) if _parabola(mu, peak, half, noise)[2]]
    if noise > 0 and fitting:
        height, error, _ = _parabola(mu, peak, max(2, round(0.6 * max(fitting))), noise)
        return height, error
    steps = np.abs(np.diff(mu[max(peak - 1, 0) : peak + 2]))
    return float(mu[peak]), math.hypot(noise, 0.5 * float(steps.min()) if steps.size else 0.0)


def _parabola(mu: Floats, peak: int, half: int, noise: float) -> tuple[float, float, bool]:
    """Height and error of the parabola through 2 half + 1 samples, and whether it fits within the noise."""
    values, u = mu[peak - half : peak + half + 1], np.arange(-half, half + 1) / half
    curve, covariance = np.polyfit(u, values, 2, cov="unscaled")
    squares, free = float(np.sum((values - np.polyval(curve, u)) ** 2)), 2 * half - 2
    good = squares <= free * noise**2 * (1 + 2 * math.sqrt(2 / free)) and curve[0] < 0
    at = float(np.clip(-curve[1] / (2 * curve[0]), -1, 1)) if curve[0] else 0.0
    row = np.array([at * at, at, 1.0])
    return float(row @ curve), noise * math.sqrt(float(row @ covariance @ row)), bool(good)


def friction_table(measured: Iterable[DiscFriction]) -> pd.DataFrame:
    """Table with one row per measurement: file, measurement, N_N, mu_s, mu_s_err, mu_d, mu_d_err, N_err_N,
    peak_deg, warnings."""
    names = ("measurement", "N_N", "mu_s", "mu_s_err", "mu_d", "mu_d_err", "N_err_N", "peak_deg")
    rows = [
        {"file": Path(one.source).name}
        | {name: getattr(one, name) for name in names}
        | {"warnings": "; ".join(one.warnings)}
        for one in measured
    ]
    return pd.DataFrame(rows)


# --- μ_s against N ------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StaticFriction:
    r"""The law μ_s(N) = a (1 + b/N), with the publication's numbers by default.

    .. math:: \mu_s(N) = a\,(1 + b/N), \qquad \mu_s N = a\,(N + b)

    Source: the publication's appendix "Single sheets characterization", after Crassous et al. 1999.
    """

    a: float = 0.507  # coefficient at large loads
    b_N: float = 0.143  # load at which adhesion doubles it
    a_err: float = math.nan
    b_err_N: float = math.nan
    correlation: float = math.nan  # of a and b
    chi2_dof: float = math.nan  # NaN with two points; above 1 the errors are scaled by its square root
    points: int = 0  # number of measurements fitted

    def mu_s(self, N_N: ArrayLike) -> Floats:
        """Static coefficient under a load; infinite at zero load, where the friction force is a b."""
        with np.errstate(divide="ignore"):
            return np.asarray(self.a * (1 + self.b_N / np.asarray(N_N, float)))

    def threshold_N(self, N_N: ArrayLike) -> Floats:
        """Largest static friction force a (N + b)."""
        return np.asarray(self.a * (np.asarray(N_N, float) + self.b_N))

    def crossing_N(self, mu: float) -> float:
        """Load at which the threshold equals that of a constant coefficient mu; infinite for mu <= a."""
        return self.a * self.b_N / (mu - self.a) if mu > self.a else math.inf


PUBLISHED_FRICTION = StaticFriction()
"""The publication's law: a = 0.507, b = 0.143 N."""


def fit_static_friction(N_N: ArrayLike, mu_s: ArrayLike, mu_s_err: ArrayLike | None = None) -> StaticFriction:
    r"""Weighted least squares of μ_s = a (1 + b/N).

    Parameters
    ----------
    N_N, mu_s
        Loads and static coefficients of the measurements; pairs with NaN are left out.
    mu_s_err
        Standard errors. If None, or not all positive, all points have equal weights and the errors follow
        from the scatter.

    Raises
    ------
    InputError
        If there are fewer than two different loads, a load is not positive, or the result is a ≤ 0.

    Notes
    -----
    The law is linear in a and c = a b; b = c/a with

    .. math:: \sigma_b^2 = \left(\sigma_c^2 + b^2\sigma_a^2 - 2b\,\sigma_{ac}\right)/a^2 .

    All errors are scaled by the square root of χ²/dof if that is above 1, as sheets differ from each other.
    """
    load, mu = np.asarray(N_N, float), np.asarray(mu_s, float)
    error = np.full(mu.shape, np.nan) if mu_s_err is None else np.asarray(mu_s_err, float)
    if load.shape != mu.shape or error.shape != mu.shape or load.ndim != 1:
        raise InputError("`N_N`, `mu_s`, `mu_s_err`", "columns of one length", f"{load.shape}, {mu.shape}")
    known = np.isfinite(load) & np.isfinite(mu)
    load, mu, error = load[known], mu[known], error[known]
    if (load <= 0).any():
        raise InputError("`N_N`", "positive loads", f"{load.min():.3g} N")
    if load.size < 2 or float(np.ptp(load)) < 0.01 * float(load.max()):
        found = ", ".join(f"{value:.3g} N" for value in np.unique(load)) or "no μ_s at all"
        raise InputError("the law μ_s = a(1 + b/N)", "two different normal forces with a μ_s", found)
    weighted = bool((error > 0).all())
    sigma = error if weighted else np.ones_like(mu)
    (c, a), covariance = np.polyfit(1 / load, mu, 1, w=1 / sigma, cov="unscaled")
    free = load.size - 2
    chi2_dof = float(np.sum(((mu - a - c / load) / sigma) ** 2)) / free if free else math.nan
    if a <= 0:
        raise InputError("the law μ_s = a(1 + b/N)", "a positive a", f"{a:.3g}", "measure at larger loads")
    if not weighted:
        covariance = covariance * (chi2_dof if free else math.nan)
        chi2_dof = math.nan
    elif free and chi2_dof > 1:
        covariance = covariance * chi2_dof
    b = c / a
    jacobian = np.array([[0.0, 1.0], [1 / a, -b / a]])  # of (a, b) by (c, a)
    covariance = jacobian @ covariance @ jacobian.T
    a_err, b_err = (float(value) for value in np.sqrt(np.diag(covariance)))
    return StaticFriction(
        a=float(a),
        b_N=float(b),
        a_err=a_err,
        b_err_N=b_err,
        correlation=float(covariance[0, 1] / (a_err * b_err)) if a_err * b_err > 0 else math.nan,
        chi2_dof=chi2_dof,
        points=int(load.size),
    )

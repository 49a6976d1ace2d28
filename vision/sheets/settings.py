"""Everything about tracking that can be tuned, in one place."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class TrackingSettings:
    """Thresholds and costs of `vision.track_sheets`.

    Lengths are fractions of the ridges' width (FWHM) or of their pitch, so that they hold at every
    magnification; costs are negative log-likelihoods in nats.
    """

    # --- which ridges are candidates ---
    noise_factor: float = 7.0
    faint_fraction: float = 0.08
    smoothing_widths: float = 0.2
    surroundings_widths: float = 1.7
    same_width_factor: float = 1.6
    dark_width_ratio: float = 0.9
    narrowest_widths: float = 0.25
    widest_widths: float = 2.5
    standard_window_px: int = 9
    standard_widths_px: tuple[float, float] = (6.0, 14.0)
    window_per_width: float = 1.4
    step_fraction: float = 0.3
    least_change: float = 0.2
    present_inside: float = 0.3
    present_at_edge: float = 0.04
    far_outside: float = 2.6
    spacing_spread: float = 0.08
    spacing_limit: float = 8.0
    brightness_spread: float = 0.25
    brightness_limit: float = 4.0
    stay_cost: float = 4.0
    missing_cost: float = 6.0
    false_detection_cost: float = 7.0
    outside_cost: float = 0.5
    crossing_cost: float = 2.0
    edge_pitches: float = 1.5
    uneven_cost: float = 3.0
    even_spread: float = 0.12
    contrast_score: float = 0.4
    usual_widths: float = 0.35
    odd_width_cost: float = 3.0
    moving_px: float = 0.7
    static_fraction: float = 0.3
    frames_per_rest: int = 32
    doubt: float = 3.0
    faint_reach: float = 0.3
    faint_contrast: float = 0.2
    tear_fraction: float = 0.6
    merged_widths: float = 0.8
    axis_sigmas: float = 4.0
    axis_slack: float = 0.02
    vibration_sigmas: float = 2.0
    decided_sheets: int = 2
    wide_pitches: float = 1.6


DEFAULT = TrackingSettings()

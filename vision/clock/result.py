"""Clock: how the camera's clock maps to the testing machine's, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Status = Literal["ok", "ambiguous", "given"]
How = Literal["given", "video time column", "events"]


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One alignment of the slips: its clock, log-likelihood (less that of no match), and slips paired."""

    offset_s: float
    drift_ppm: float
    log_likelihood: float
    matched: int


@dataclass(frozen=True, kw_only=True)
class Clock:
    """t_force = offset_s + (1 + drift_ppm 1e-6) t_video.

    offset_s: force clock at video time 0.  residual_ms: median absolute residual of the matched slips, NaN
    without any.  error_ms: standard error of a mapped time in the middle of the matched slips, NaN where it
    is not known (a given offset).  drift_err_ppm: of the drift, NaN likewise.  matched, unmatched_video,
    unmatched_force: slips within the time both saw.  margin: log-likelihood over the next different
    alignment, NaN where the slips did not decide.  status: "ok", "ambiguous" (the numbers are those of the
    best candidate and may be wrong by whole events: do not use them unseen) or "given" (offset or column).
    how: what decided.  candidates: alignments considered, best first.  warnings: what the user must be told.
    """

    offset_s: float
    drift_ppm: float
    residual_ms: float
    matched: int
    unmatched_video: int
    unmatched_force: int
    margin: float
    status: Status
    how: How
    error_ms: float = math.nan
    drift_err_ppm: float = math.nan
    candidates: tuple[Candidate, ...] = ()
    warnings: tuple[str, ...] = ()

    def to_force_s(self, video_time_s: ArrayLike) -> NDArray[np.float64]:
        """Force clock at these video times, s; NaN stays NaN."""
        return self.offset_s + (1 + 1e-6 * self.drift_ppm) * np.asarray(video_time_s, np.float64)

    def to_video_s(self, force_time_s: ArrayLike) -> NDArray[np.float64]:
        """Video time at these times of the force clock, s; NaN stays NaN."""
        return (np.asarray(force_time_s, np.float64) - self.offset_s) / (1 + 1e-6 * self.drift_ppm)

    def to_json(self) -> dict[str, Any]:
        """What `clock.json` holds; numbers that are not known are null."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value

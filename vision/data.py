"""The datasets that pass between stages: their variables, dimensions, units and metadata.

Each stage returns an xarray object or a pandas table. Its variables are declared here as a `Schema`, which a
later stage checks. Further facts that later stages need (the fit used, the codec, the time of the first slip)
are declared as a `Metadata` class, stored in ``attrs`` and read back with ``of``. Every stage appends its
name and parameters to ``attrs["operations"]``.
"""

# ruff: noqa: N815 (the unit is part of a name, and newton is N)
from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, fields
from itertools import compress
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import numpy as np
import pandas as pd
import xarray as xr

from vision.errors import InputError, check_within
from vision.numeric import Bools

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Data = xr.DataArray | xr.Dataset | pd.DataFrame
PIXEL_SIZE_UM = (1e-3, 1000.0)
"""Least and largest µm per pixel. Less than the former, which light does not resolve, is a mistyped unit (m
for µm); a picture with more would not show sheets."""
WHOLE_RATIO = 1.0
"""Largest threshold of σ_x/Λ_st: sheets that move steadily by a whole stick length have 1/√12 = 0.29."""
AnyData = TypeVar("AnyData", xr.DataArray, xr.Dataset, pd.DataFrame)


@dataclass(frozen=True)
class Variable:
    """One variable, coordinate or column.

    Parameters
    ----------
    dims
        Names of its dimensions; ``("event",)`` for a column of a table of events.
    units
        As in ``attrs["units"]``; "" for text and flags, "1" for a ratio.
    long_name
        Description, used for axis labels and in netCDF files.
    """

    dims: tuple[str, ...]
    units: str
    long_name: str

    @property
    def attrs(self) -> dict[str, str]:
        """Return ``long_name`` and, if there are any, ``units`` as a dictionary."""
        return {"long_name": self.long_name} | ({"units": self.units} if self.units else {})


@dataclass(frozen=True)
class Schema:
    """The declared variables of one dataset.

    Parameters
    ----------
    name
        Name of the dataset in messages.
    made_by
        The function that returns the dataset.
    variables
        Every variable, coordinate and column with its declaration.
    needs
        Variables that every later stage needs; None for all.
    kind
        Its type.
    """

    name: str
    made_by: str
    variables: Mapping[str, Variable]
    needs: Sequence[str] | None = None
    kind: type[Data] = xr.Dataset

    def __getitem__(self, name: str) -> Variable:
        return self.variables[name]

    def check(self, data: Data, needs: Sequence[str] | None = None) -> None:
        """Check that the data have the declared variables and dimensions.

        Parameters
        ----------
        data, needs
            Input of a stage, and the variables that it requires; by default those that every stage needs.

        Raises
        ------
        InputError
            If anything is not as declared. One message names every such variable.
        """
        if isinstance(data, self.kind):
            needed = needs or self.needs or list(self.variables)
            problems = [_problem(data, name, made, name in needed) for name, made in self.variables.items()]
        else:  # a path, None, one variable of several or the result of another stage
            problems = [f"the type {type(data).__name__}"]
        if found := ", ".join(filter(None, problems)):
            wanted = f"what `{self.made_by}` returns"
            raise InputError(f"the {self.name}", wanted, found, "pass that on unchanged")


def _problem(data: Data, name: str, declared: Variable, required: bool) -> str:
    """Return what is wrong with one variable; "" if nothing is."""
    if isinstance(data, pd.DataFrame):
        return f"no column {name}" if required and name not in data.columns else ""
    variables = data.variables if isinstance(data, xr.Dataset) else {**data.coords, data.name: data}
    if name not in variables:
        return f"no {name}" if required else ""
    dims = variables[name].dims
    return "" if dims == declared.dims else f"{name} with dimensions {dims} in place of {declared.dims}"


@dataclass(frozen=True, kw_only=True)
class Metadata:
    """Facts stored in the ``attrs`` of a dataset, one entry per field. NaN marks an unknown number."""

    @classmethod
    def of(cls, data: Data) -> Self:
        """Read the metadata from the ``attrs`` of a dataset; what is not there has its default."""
        return cls(**{part.name: data.attrs[part.name] for part in fields(cls) if part.name in data.attrs})

    def attrs(self) -> dict[str, Any]:
        """Return the fields as a dictionary for ``assign_attrs``; the values are not copied."""
        return {part.name: getattr(self, part.name) for part in fields(self)}


def check_pixel_size(pixel_size_um: Any) -> None:
    """Raise `InputError` for a pixel size that is neither None nor within `PIXEL_SIZE_UM`."""
    low, high = PIXEL_SIZE_UM
    check_within(f"a number from {low:g} to {high:g} (µm per px)", low, high, pixel_size_um=pixel_size_um)


def check_threshold(threshold: Any) -> None:
    """Raise `InputError` for a threshold of σ_x/Λ_st that is not above 0 and at most `WHOLE_RATIO`."""
    expected = f"a number above 0, at most {WHOLE_RATIO:g} (steady motion by a whole Λ_st has 1/√12 = 0.29)"
    check_within(expected, 1e-9, WHOLE_RATIO, threshold=threshold)


def record(data: AnyData, operation: str, **parameters: Any) -> AnyData:
    """Return the data with the operation and its parameters appended to ``attrs["operations"]``."""
    entry = {"operation": operation, "parameters": parameters}
    done = [*data.attrs.get("operations", ()), entry]
    if isinstance(data, pd.DataFrame):
        table = data.copy(deep=False)
        table.attrs = {**data.attrs, "operations": done}
        return table
    return data.assign_attrs(operations=done)


def changed_settings(settings: DataclassInstance) -> dict[str, Any]:
    """Return the fields of a settings dataclass that differ from its defaults, for `record`."""
    defaults = type(settings)()
    return {
        one.name: value
        for one in fields(settings)
        if (value := getattr(settings, one.name)) != getattr(defaults, one.name)
    }


def load_unit(force: xr.Dataset) -> str:
    """Return the unit of a recording's load: "N", or "1" for a force over a weight."""
    return str(force["load_N"].attrs.get("units", "N"))


def warnings_of(*parts: Data | None) -> list[str]:
    """Return the warnings of several stages in order, without repetition."""
    lines = [line for part in parts if part is not None for line in part.attrs.get("warnings", ())]
    return list(dict.fromkeys(lines))


# --- I(x, t) ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StripMetadata(Metadata):
    """How the strip was read.

    Parameters
    ----------
    source
        The video's path.
    codec
        Codec as FFmpeg names it ("mjpeg" also for JPEG images and JPEG in TIFF), "uncompressed", "packed",
        the compression of a TIFF, or the suffix of an image file. A lossy codec hides the noise.
    container, pixel_format, decoder, grey
        Kind of file, how a pixel is stored, which program decoded it ("none" if none was needed), and how
        grey values follow from pixels.
    file_pixel_size_um, file_scale_unused
        µm per pixel that the file states, NaN without; a scale in it that is not used, and why.
    rotate
        Degrees clockwise by which the frames were rotated.
    depth_bits, saturation_level
        Significant bits per pixel (32 for float) and the value of a saturated pixel (NaN for float).
    strip_z0, strip_z1, strip_how, strip_clarity
        Averaged rows, half-open; "found", "given" or "all rows" (if no strip stood out); correlation of the
        ridges' slopes in odd and even rows, 0 to 1.
    tilt_deg
        Tilt of the ridges against the columns; NaN if unknown.
    strip_halves_px, strip_bow_px, strip_err_px
        RMS difference between positions from the upper and the lower half of the strip, and between those
        from its outer and inner half, beyond tilt and noise; error of positions due to the latter. 0 if
        there is no significant difference.
    clock_kind, clock_file, fps
        "file" (time stamps of the recording), "given" or "playback" (rate in the file's header); name of the
        file of time stamps that was given, "" for none; frames per second, NaN if unknown.
    frames_expected, frames_read, frames_lost, frames_blank, frames_corrupt
        Counts of frames: expected = read + lost. The read frames include blank ones, the lost frames
        corrupt ones.
    warnings
        Problems that may affect the results.
    """

    source: str = "the video"
    container: str = ""
    codec: str = ""
    pixel_format: str = ""
    decoder: str = ""
    grey: str = ""
    file_pixel_size_um: float = math.nan
    file_scale_unused: str = ""
    rotate: int = 0
    depth_bits: int = 32
    saturation_level: float = math.nan
    strip_z0: int = 0
    strip_z1: int = 1
    strip_how: str = "given"
    strip_clarity: float = math.nan
    tilt_deg: float = math.nan
    strip_halves_px: float = 0.0
    strip_bow_px: float = 0.0
    strip_err_px: float = 0.0
    clock_kind: str = "playback"
    clock_file: str = ""
    fps: float = math.nan
    frames_expected: int = 0
    frames_read: int = 0
    frames_lost: int = 0
    frames_blank: int = 0
    frames_corrupt: int = 0
    warnings: Sequence[str] = field(default_factory=list)


STRIP = Schema(
    "strip",
    "vision.strip_profile",
    {
        "intensity": Variable(("frame", "x"), "grey level", "mean intensity of the strip"),
        "frame": Variable(("frame",), "", "frame number in the file"),
        "x": Variable(("x",), "px", "column"),
        "time_s": Variable(("frame",), "s", "time of the frame"),
        "status": Variable(("frame",), "", "ok, blank, corrupt or lost"),
    },
    needs=("frame", "x", "time_s"),
    kind=xr.DataArray,
)


@dataclass(frozen=True, kw_only=True)
class DiagramMetadata(Metadata):
    """What a space-time diagram shows.

    Parameters
    ----------
    pixel_size_um
        µm per pixel; NaN if it is unknown.
    sheet, sheet_index
        Side and n, such as "right:23", and index of the sheet in the middle of the window; "" and -1 for the
        whole strip.
    centre_px
        Column of the middle of the window, the sheet's mean position; NaN for the whole strip.
    follow
        Whether the window follows the sheet.
    """

    pixel_size_um: float = math.nan
    sheet: str = ""
    sheet_index: int = -1
    centre_px: float = math.nan
    follow: bool = False

    @property
    def size_um(self) -> float | None:
        """µm per pixel; None if it is unknown."""
        return None if math.isnan(self.pixel_size_um) else self.pixel_size_um


STRIP_PARTS = Schema(
    "parts of the strip",
    "vision.video.strip_profiles",
    {
        "intensity": Variable(("z", "frame", "x"), "grey level", "mean intensity of a part of the strip"),
        "z": Variable(("z",), "px", "middle row of the part, counted from the top"),
        **{name: STRIP[name] for name in ("frame", "x")},
    },
    kind=xr.DataArray,
)

# --- x(n, t) ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class TrackMetadata(Metadata):
    """How the sheets were found. The attributes of the tracks also hold the strip's metadata.

    Parameters
    ----------
    fit, fit_asked, window_px
        Subpixel method used ("unknown" for positions from another program), the requested method, and its
        window. The error of positions depends on method and window.
    ridges, ridges_likelier, ridges_doubt, sheets, sheets_how
        Polarity ("bright" or "dark"), that which the film suggests if another was given ("" if not), why the
        polarity that was found may be wrong ("" if it is clear or given), number of sheets, and
        whether it was given.
    ridge_fwhm_px, pitch_px, contrast, profile_noise
        Width and spacing of the ridges; their height and the noise in grey levels.
    axis_px, axis_how, axis_low_px, axis_high_px
        Position of the symmetry axis; "given", "motion" or "geometry"; interval in which the axis lies
        according to the motion of the sheets (NaN without motion).
    axis_missing
        Number of sheets that seem to be missing in wide spacings and count where the axis is the middle of
        the comb ("geometry").
    least_margin
        Smallest difference in log-likelihood between the chosen assignment of identities and the next best.
    ridges_dropped
        Number of persistent ridges that are not sheets.
    wide_spacings
        Spacings in which a sheet may have been overlooked, such as "748 px (1.9 pitches)".
    scene_changes
        Permanent changes of the picture: first frame of the new scene (``frame``), common displacement of
        all sheets (``moved_px``), change of the logarithm of their relative brightness (``brightness``).
    sheets_alike, large_steps
        "yes" if the sheets look so alike that a picture does not show which sheets it contains, else "no"; if
        "yes", frames before which the whole comb moved so far that the number of spacings is uncertain.
    ridges_beyond
        Number of ridges that resemble the sheets and continue the comb beyond the given number of sheets.
    locking_px, locking_err_px
        Locking of positions to whole pixels that was subtracted, rms, and what remains of it in the errors,
        px; 0 for none (`vision.sheets.distortion`).
    noise_lasts
        Correlation of the pixels' noise between a frame and the next if the camera averages in time, else 0.
    corrections_applied
        Number of manual corrections; they are listed among the operations.
    """

    fit: str = "unknown"
    fit_asked: str = "unknown"
    window_px: int = 9
    ridges: str = "bright"
    ridges_likelier: str = ""
    ridges_doubt: str = ""
    sheets: int = 0
    sheets_how: Literal["given", "found"] = "found"
    ridge_fwhm_px: float = math.nan
    pitch_px: float = math.nan
    contrast: float = math.nan
    profile_noise: float = math.nan
    axis_px: float = math.nan
    axis_how: str = "given"
    axis_low_px: float = math.nan
    axis_high_px: float = math.nan
    axis_missing: int = 0
    least_margin: float = math.nan
    ridges_dropped: int = 0
    wide_spacings: Sequence[str] = field(default_factory=list)
    scene_changes: Sequence[Mapping[str, float]] = field(default_factory=list)
    sheets_alike: Literal["yes", "no"] = "no"
    large_steps: Sequence[int] = field(default_factory=list)
    ridges_beyond: int = 0
    locking_px: float = 0.0
    locking_err_px: float = 0.0
    noise_lasts: float = 0.0
    corrections_applied: int = 0


MEASURED = ("ok", "blurred")  # flags of positions that were measured
_FRAME_SHEET, _SHEET = ("frame", "sheet"), ("sheet",)
TRACKS = Schema(
    "tracks",
    "vision.track_sheets",
    {
        "x_px": Variable(_FRAME_SHEET, "px", "position of the sheet"),
        "x_err_px": Variable(
            _FRAME_SHEET, "px", "random standard error of a position, without the error shared by all frames"
        ),
        "flag": Variable(_FRAME_SHEET, "", "ok, blurred, or why there is no position"),
        "why": Variable(_FRAME_SHEET, "", "why the identity is doubtful"),
        "x_withheld_px": Variable(_FRAME_SHEET, "px", "ridge whose identity is doubtful"),
        "x_expected_px": Variable(_FRAME_SHEET, "px", "position predicted from the neighbouring sheets"),
        "x_mean_px": Variable(_SHEET, "px", "median position"),
        "found": Variable(_SHEET, "1", "fraction of the frames with a position"),
        "fwhm_px": Variable(_SHEET, "px", "full width of the ridge at half maximum"),
        "distorted": Variable(
            _SHEET, "1", "fraction of the positions distorted by dirt, a highlight or an edge"
        ),
        "snr": Variable(_SHEET, "1", "contrast over noise"),
        "x_lasting_px": Variable(
            _SHEET,
            "px",
            "rough size of a lasting distortion, which shifts all positions of the sheet; 0 if none is seen",
        ),
        "misscaled": Variable(
            _SHEET, "1", "relative error of the sheet's displacements, from dirt that stands still; 0 if none"
        ),
        "x_noise_px": Variable(_SHEET, "px", "measured scatter of the position from frame to frame"),
        "x_scatter_px": Variable(
            _SHEET, "px", "measured scatter of the position between neighbouring sheets"
        ),
        "x_predicted_px": Variable(_SHEET, "px", "error predicted from the noise of pixels"),
        "x_z_px": Variable(("frame", "sheet", "z"), "px", "position in a part of the strip"),
        "x_z_err_px": Variable(("frame", "sheet", "z"), "px", "standard error of the position in a part"),
        "time_s": Variable(("frame",), "s", "time of the frame"),
        "side": Variable(_SHEET, "", "-1 left, +1 right of the axis"),
        "n": Variable(_SHEET, "", "sheet number, counted from the centre outwards"),
    },
    needs=("x_px", "x_err_px", "flag", "time_s", "side", "n"),
)

# --- F(t), d(t) ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ForceMetadata(Metadata):
    """How the testing machine's file was read.

    Parameters
    ----------
    source
        The file's path.
    separation_from
        How the separation d was obtained: "displacement", "speed" (d = d0 + V t) or "none" (unknown).
    speed_mm_min, d0_mm, d0_err_mm
        Speed V, measured if a displacement was recorded; initial separation d0 and its error. NaN if unknown.
    layout, encoding, separator, decimal, columns, blocks, columns_seen
        Format of the file, and the meaning of its columns.
    displacement_unit
        "stated", or "assumed" if the file states none.
    notes, warnings
        Assumptions, and problems that may affect the results.
    """

    source: str = "the force recording"
    separation_from: str = "none"
    speed_mm_min: float = math.nan
    d0_mm: float = math.nan
    d0_err_mm: float = math.nan
    layout: str = ""
    encoding: str = ""
    separator: str = ""
    decimal: str = ""
    columns: str = ""
    blocks: str = ""
    columns_seen: str = ""
    displacement_unit: Literal["stated", "assumed"] = "stated"
    notes: Sequence[str] = field(default_factory=list)
    warnings: Sequence[str] = field(default_factory=list)

    @property
    def lacks_d0(self) -> bool:
        """Whether d is how far the machine moved, since the initial separation is not known."""
        return self.separation_from != "none" and math.isnan(self.d0_mm)


_TIME = ("time_s",)
FORCE = Schema(
    "force",
    "vision.read_force",
    {
        "load_N": Variable(_TIME, "N", "load"),
        "d_mm": Variable(_TIME, "mm", "separation distance"),
        "flag": Variable(_TIME, "", "ok, or what is wrong with the sample"),
        "time_s": Variable(_TIME, "s", "machine's clock"),
        "crosshead_mm": Variable(_TIME, "mm", "crosshead displacement"),
        "video_time_s": Variable(_TIME, "s", "camera's clock"),
    },
    needs=("load_N", "d_mm", "time_s"),
)

# --- stick-slip events --------------------------------------------------------------------------------------


RegimeName = Literal["stick-slip", "oscillation", "cycles", "noise"]
ThresholdHow = Literal["", "noise", "jumps", "gap", "given"]
LowpassHow = Literal["recorded", "given", "found", "doubtful", "none"]
LowpassDoubt = Literal["", "differs", "shape"]


@dataclass(frozen=True, kw_only=True)
class StickMetadata(Metadata):
    """How the stick-slip events were found.

    Parameters
    ----------
    noise_N, threshold_N, threshold_how
        Noise of the load; smallest drop that counts as a slip; its source: "noise" (a multiple of the noise),
        "jumps" (above the load's upward jumps), "gap" (between small and large drops) or "given".
    period_samples, spikes
        Typical number of samples from slip to slip; number of single-sample spikes that were ignored.
    lowpass_s, lowpass_how
        Time constant of the load cell's low-pass that was corrected for, 0 for none; "recorded" (no
        correction requested, the default), "given", or the result of the search: "found" (proven),
        "doubtful" (seen but not proven, not corrected) or "none" (not seen).
    lowpass_proposed_s, lowpass_proven, lowpass_doubt
        Time constant suggested by the transients after slips but not corrected for (NaN: none); whether slips
        of different size and spacing agree on it, and it leaves no tail when corrected; else which of the
        two is not so, "differs" or "shape". Its effect is part of the errors.
    lowpass_dF_share, lowpass_K_share
        Median relative change of ΔF and K that this correction would cause.
    lowpass_peak_mm
        Median travel in which a stick rises by as much as this correction would raise its peak.
    K_err_by_d
        Median error of K from that of the displacement within each stick, over K, where it is the larger part
        of the error; else 0.
    average_s, ringing_s
        Time over which the load was averaged, 0 for none; period of the load's ringing after slips, or
        of hum; NaN for none.
    filter_s
        Duration that a filter of the machine may have given every slip; 0 where a low-pass was found, samples
        were lost, slips last less than 2.5 samples, or the load is level at their ends. Its effect is part of
        the errors of the fits.
    two_slopes, bend_share
        Whether stick phases were fitted with a knee; correction of the lines at the valley for the curvature
        common to all sticks, over their rise (negative: sticks begin steeply).
    hum_Hz, hum_N
        Frequency and root mean square of hum, without which slips are searched; NaN and 0 for none. Forces
        are measured with it, and their errors contain it.
    regime, fall_over_rise
        "stick-slip", "oscillation", "cycles" or "noise"; median duration of falls over that of rises.
    warnings
        Reasons why this may not be stick-slip.
    first_slip_s, first_slip_N, last_slip_s
        Times (force clock) of the first and last slip; load before the first one.
    machine_stiffness_N_per_mm
        Stiffness by which d was corrected; NaN for no correction.
    central_part
        Fraction of the stick phase over which K is fitted.
    """

    noise_N: float = math.nan
    threshold_N: float = math.nan
    threshold_how: ThresholdHow = ""
    period_samples: float = math.nan
    spikes: int = 0
    lowpass_s: float = 0.0
    lowpass_how: LowpassHow = "none"
    lowpass_proposed_s: float = math.nan
    lowpass_proven: bool = False
    lowpass_doubt: LowpassDoubt = ""
    lowpass_dF_share: float = 0.0
    lowpass_K_share: float = 0.0
    lowpass_peak_mm: float = 0.0
    K_err_by_d: float = 0.0
    average_s: float = 0.0
    ringing_s: float = math.nan
    filter_s: float = 0.0
    two_slopes: bool = False
    bend_share: float = 0.0
    hum_Hz: float = math.nan
    hum_N: float = 0.0
    regime: RegimeName = "stick-slip"
    fall_over_rise: float = math.nan
    warnings: Sequence[str] = field(default_factory=list)
    first_slip_s: float = math.nan
    first_slip_N: float = math.nan
    last_slip_s: float = math.nan
    machine_stiffness_N_per_mm: float = math.nan
    central_part: float = 0.5


_EVENT = ("event",)
WHOLE = frozenset({"ok", "slow", "negative"})  # flags of whole events, which models are fitted to
STICKS = Schema(
    "stick-slip events",
    "vision.find_stick_slip",
    {
        "event": Variable(_EVENT, "", "event number"),
        "t_v_s": Variable(_EVENT, "s", "time of the valley"),
        "t_p_s": Variable(_EVENT, "s", "time of the peak"),
        "d_v_mm": Variable(_EVENT, "mm", "separation at the valley"),
        "d_p_mm": Variable(_EVENT, "mm", "separation at the peak"),
        "F_v_N": Variable(_EVENT, "N", "force at the valley"),
        "F_p_N": Variable(_EVENT, "N", "force at the peak"),
        "dF_N": Variable(_EVENT, "N", "ΔF = F_p − F_v"),
        "stick_length_um": Variable(_EVENT, "um", "Λ_st = d_p − d_v"),
        "stick_length_err_um": Variable(_EVENT, "um", "standard error of Λ_st"),
        "slip_length_um": Variable(_EVENT, "um", "Λ_sl, next d_v − d_p"),
        "K_N_per_mm": Variable(_EVENT, "N/mm", "stiffness of the stick phase"),
        "K_err_N_per_mm": Variable(_EVENT, "N/mm", "standard error of K"),
        "F_v_raw_N": Variable(_EVENT, "N", "lowest load near the valley, without spikes"),
        "F_p_raw_N": Variable(_EVENT, "N", "highest load near the peak, without spikes"),
        "K30_N_per_mm": Variable(_EVENT, "N/mm", "stiffness over the central 30 %"),
        "K70_N_per_mm": Variable(_EVENT, "N/mm", "stiffness over the central 70 %"),
        "F_v_err_N": Variable(_EVENT, "N", "standard error of F_v"),
        "F_p_err_N": Variable(_EVENT, "N", "standard error of F_p"),
        "dF_err_N": Variable(_EVENT, "N", "standard error of ΔF"),
        "K1_N_per_mm": Variable(_EVENT, "N/mm", "stiffness before the knee"),
        "K2_N_per_mm": Variable(_EVENT, "N/mm", "stiffness after the knee"),
        "K2_err_N_per_mm": Variable(_EVENT, "N/mm", "standard error of K2"),
        "knee": Variable(_EVENT, "1", "position of the knee, fraction of the fitted part"),
        "knee_gain": Variable(_EVENT, "1", "squared residuals of one line over those with a knee"),
        "K_lowpass_share": Variable(
            _EVENT, "1", "relative change of K if a low-pass that was found were corrected; it is in K_err"
        ),
        "slip_time_s": Variable(_EVENT, "s", "duration of the slip"),
        "samples": Variable(_EVENT, "", "samples in the stick phase"),
        "flag": Variable(
            _EVENT,
            "",
            "ok, or, joined by +, what is wrong within the stick phase; events that are only slow (the slip "
            "lasts a considerable part of a stick, and F_v and F_p are the recorded extremes) or negative "
            "(F_v below zero) are whole",
        ),
    },
    needs=("event", "t_v_s", "t_p_s", "d_v_mm", "d_p_mm", "F_v_N", "F_p_N", "dF_N", "stick_length_um"),
    kind=pd.DataFrame,
)


def joined_flags(marks: Mapping[str, Bools]) -> list[str]:
    """Return the flag of each event: the words whose mark is set, joined by "+", or "ok"."""
    return ["+".join(compress(marks, row)) or "ok" for row in np.column_stack(list(marks.values()))]


def has_flag(flags: Iterable[object], word: str) -> Bools:
    """Return which flags contain this word."""
    return np.array([word in str(flag).split("+") for flag in flags], dtype=bool)


def only_flags(flags: Iterable[object], words: Set[str]) -> Bools:
    """Return which flags contain no other words than these."""
    return np.array([words >= set(str(flag).split("+")) for flag in flags], dtype=bool)


def whole_events(flags: Iterable[object]) -> Bools:
    """Return which events are whole: only these are used for fits and comparisons."""
    return only_flags(flags, WHOLE)


# --- deformation --------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class MotionMetadata(Metadata):
    """How the deformation was measured.

    Parameters
    ----------
    source, pixel_size_um, margin_s, interval_s
        The video's path; µm per pixel; time left out on either side of each slip; time between frames.
    noise_share, noise_rho
        Noise that is correlated from frame to frame: its share of the variance, and its AR(1) coefficient.
    camera_movement, warnings
        How the camera's movement was separated from the creep of the sheets; stick phases that are left out.
    """

    source: str = "the video"
    pixel_size_um: float = math.nan
    margin_s: float = math.nan
    interval_s: float = math.nan
    noise_share: float = 0.0
    noise_rho: float = 0.0
    camera_movement: str = ""
    warnings: Sequence[str] = field(default_factory=list)


_EVENT_SHEET = ("event", "sheet")
MOTION = Schema(
    "deformation",
    "vision.horizontal_deformation",
    {
        "sigma_x_um": Variable(
            _EVENT_SHEET, "um", "RMS displacement over the usable frames of the stick phase, as measured"
        ),
        "sigma_x_corrected_um": Variable(
            _EVENT_SHEET, "um", "RMS displacement over the stick phase, without noise and camera movement"
        ),
        "sigma_x_err_um": Variable(_EVENT_SHEET, "um", "standard error of sigma_x_corrected_um"),
        "sweep_um": Variable(
            _EVENT_SHEET, "um", "inward movement over the stick phase (fitted line), without camera movement"
        ),
        "ratio": Variable(_EVENT_SHEET, "1", "sigma_x_corrected_um over stick_length_um"),
        "ratio_err": Variable(_EVENT_SHEET, "1", "standard error of ratio"),
        "ratio_signed": Variable(
            _EVENT_SHEET, "1", "ratio before negative values are set to 0; positive inwards"
        ),
        "frames": Variable(_EVENT_SHEET, "1", "positions used"),
        "x_hat_px": Variable(_EVENT_SHEET, "px", "mean position over the stick phase"),
        "flag": Variable(_EVENT_SHEET, "", "ok, or what is unusual about the measurement"),
        "stick_length_um": Variable(_EVENT, "um", "stick length"),
        "length_err": Variable(
            _EVENT, "1", "relative error of the ratios, common to all sheets, from the ends of the stick"
        ),
        "frames_left_out": Variable(
            _EVENT, "1", "frames left out because a slip may lie within their exposure"
        ),
        "effective_frames": Variable(
            _EVENT, "1", "independent frames that would give the same error of the sweep"
        ),
        "drift_um": Variable(
            _EVENT, "um", "subtracted movement of the camera during the stick phase, to the right"
        ),
        "drift_err_um": Variable(_EVENT, "um", "standard error of drift_um"),
        "noise_um": Variable(_SHEET, "um", "standard deviation of single positions, from the residuals"),
        **{name: STICKS[name] for name in ("event", "t_v_s", "t_p_s", "d_v_mm", "d_p_mm")},
        **{name: TRACKS[name] for name in ("side", "n")},
    },
    needs=("ratio", "ratio_err", "ratio_signed", "event", "side", "n"),
)

# --- shells -------------------------------------------------------------------------------------------------

STIFF_BELOW = 0.1  # σ_x/Λ_st below which a sheet is stiff by default: the publication's
SHELLS = Schema(
    "shells",
    "vision.classify_shells",
    {
        **{name: STICKS[name] for name in ("event", "d_v_mm")},
        "side": Variable(_EVENT, "", "-1 left, +1 right of the axis"),
        "stiff_sheets": Variable(_EVENT, "", "sheets in the stiff inner shell"),
        "stiff_low": Variable(_EVENT, "", "lower end of the interval"),
        "stiff_high": Variable(_EVENT, "", "upper end of the interval"),
        "M_eff_model": Variable(_EVENT, "", "M_eff implied by the force"),
        "stiff_breakpoint": Variable(
            _EVENT,
            "",
            "n at which the ratio begins to rise, which needs no threshold; empty where no rise is"
            " significant",
        ),
        "monotone": Variable(_EVENT, "", "False where the ratio falls with n by more than chance"),
        "sheets_known": Variable(_EVENT, "", "sheets of this side with a ratio"),
    },
    kind=pd.DataFrame,
)

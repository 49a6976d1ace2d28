"""The datasets that pass between stages: their variables, dimensions, units and metadata.

Each stage returns an xarray object or a pandas table. Its variables are declared here as a `Schema`, which a
later stage checks. Further facts that later stages need (the fit used, the codec, the time of the first slip)
are declared as a `Metadata` class, stored in ``attrs`` and read back with ``of``. Every stage appends its
name and parameters to ``attrs["operations"]``. All of it can be written by xarray and pandas themselves, and
what xarray reads back can be given to the next stage.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field, fields
from itertools import compress
from typing import TYPE_CHECKING, Any, Literal, Self, TypeVar

import numpy as np
import pandas as pd
import xarray as xr

from vision.errors import InputError, check_within
from vision.folder import plain
from vision.numeric import Bools, Floats, Floats32, Ints
from vision.words import word_counts

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Data = xr.DataArray | xr.Dataset | pd.DataFrame
PIXEL_SIZE_UM = (1e-3, 1000.0)
"""Least and largest µm per pixel. Less than the former, which light does not resolve, is a mistyped unit (m
for µm); a picture with more would not show sheets."""
MOST_RATIO = 1.0
"""Largest threshold of σ_x/Λ_st: sheets that move steadily by a whole stick length have 1/√12 = 0.29."""
OPERATIONS = "operations"
"""Attribute with the stages that made the data, as JSON."""
AnyData = TypeVar("AnyData", xr.DataArray, xr.Dataset, pd.DataFrame)


@dataclass(frozen=True)
class Variable:
    """One variable, coordinate or column."""

    dims: tuple[str, ...]  # names of its dimensions; ``("event",)`` for a column of a table of events
    units: str  # as in ``attrs["units"]``; "" for text and flags, "1" for a ratio
    long_name: str  # description, used for axis labels and in netCDF files

    @property
    def attrs(self) -> dict[str, str]:
        """Return ``long_name`` and, if there are any, ``units`` as a dictionary."""
        return {"long_name": self.long_name} | ({"units": self.units} if self.units else {})


@dataclass(frozen=True)
class Schema:
    """The declared variables of one dataset."""

    name: str  # in messages
    made_by: str  # the function that returns the dataset
    variables: Mapping[str, Variable]  # every variable, coordinate and column
    needs: Sequence[str] | None = None  # variables that every later stage needs; None for all
    kind: type[Data] = xr.Dataset

    def __getitem__(self, name: str) -> Variable:
        return self.variables[name]

    def declared(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return the variables with these values as `xarray.Dataset` takes them."""
        return {name: (self[name].dims, one, self[name].attrs) for name, one in values.items()}

    def check(self, data: Data, needs: Sequence[str] | None = None) -> None:
        """Raise `InputError`, which names every such variable, unless the data are as declared.

        needs: variables that the stage requires; by default those that every later stage needs.
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
        found = {}
        for name, default in cls().attrs().items():
            if name in data.attrs:
                is_list = isinstance(default, list | tuple)
                found[name] = _listed(data.attrs[name]) if is_list else data.attrs[name]
        return cls(**found)

    def attrs(self) -> dict[str, Any]:
        """Return the fields as a dictionary for ``assign_attrs``; the values are not copied."""
        return {part.name: getattr(self, part.name) for part in fields(self)}


def check_pixel_size(pixel_size_um: Any) -> None:
    """Raise `InputError` for a pixel size that is neither None nor within `PIXEL_SIZE_UM`."""
    low, high = PIXEL_SIZE_UM
    check_within(f"a number from {low:g} to {high:g} (µm per px)", low, high, pixel_size_um=pixel_size_um)


def check_threshold(threshold: Any) -> None:
    """Raise `InputError` for a threshold of σ_x/Λ_st that is not above 0 and at most `MOST_RATIO`."""
    expected = f"a number above 0, at most {MOST_RATIO:g} (steady motion by a whole Λ_st has 1/√12 = 0.29)"
    check_within(expected, 1e-9, MOST_RATIO, threshold=threshold)


def record(data: AnyData, operation: str, **parameters: Any) -> AnyData:
    """Return the data with the operation and its parameters appended to ``attrs["operations"]``, as JSON."""
    done = json.dumps([*operations_of(data), plain({"operation": operation, "parameters": parameters})])
    if isinstance(data, pd.DataFrame):
        table = data.copy(deep=False)
        table.attrs = {**data.attrs, OPERATIONS: done}
        return table
    return data.assign_attrs({OPERATIONS: done})


def operations_of(data: Data) -> list[dict[str, Any]]:
    """Return the stages that made the data, in order: each one's ``operation`` and ``parameters``."""
    done: list[dict[str, Any]] = json.loads(data.attrs.get(OPERATIONS, "[]"))
    return done


def parameters_of(data: Data, operation: str) -> dict[str, Any]:
    """Return the parameters of the last such stage that made the data; empty if there is none.

    Their ``settings`` hold only what differs from the defaults.
    """
    done = [step["parameters"] for step in operations_of(data) if step["operation"] == operation]
    return done[-1] if done else {}


class Tunable:
    """Base of settings dataclasses, which have too many fields to show: shown are those that were changed."""

    def __repr__(self: DataclassInstance) -> str:
        changed = ", ".join(f"{name}={value!r}" for name, value in changed_settings(self).items())
        return f"{type(self).__name__}({changed})"


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


def load_unit_text(force: xr.Dataset) -> str:
    """Return the unit of a recording's load in a sentence: "N", or "of the weight"."""
    unit = load_unit(force)
    return "of the weight" if unit == "1" else unit


def with_word(name: str, word: str) -> str:
    """Insert a word before the unit of a column's name: N_hat_err_N from N_hat_N."""
    units = ("_N_per_mm", "_GPa", "_mJ", "_mm", "_N")
    unit = next((unit for unit in units if name.endswith(unit)), "")
    return f"{name.removesuffix(unit)}_{word}{unit}"


def warnings_of(*parts: Data | None) -> list[str]:
    """Return the warnings of several stages in order, without repetition."""
    lines = [line for part in parts if part is not None for line in _listed(part.attrs.get("warnings", []))]
    return list(dict.fromkeys(lines))


def _listed(value: Any) -> list[Any]:
    """Return a list of the attributes of a dataset, of which netCDF returns an array, or its only item."""
    return value if isinstance(value, list) else np.atleast_1d(value).tolist()


# --- I(x, t) ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class StripMetadata(Metadata):
    """How the strip was read."""

    source: str = "the video"  # path
    container: str = ""  # kind of file
    # As FFmpeg names it ("mjpeg" also for JPEG images and JPEG in TIFF), "uncompressed", "packed", the
    # compression of a TIFF, or the suffix of an image file. A lossy codec hides the noise.
    codec: str = ""
    # Step, grey levels, to which a codec that predicts frames from others rounds changes; 0 if unknown.
    quantiser_step: float = 0.0
    pixel_format: str = ""  # how a pixel is stored
    decoder: str = ""  # the program that decoded it, "none" if none was needed
    grey: str = ""  # how grey values follow from pixels
    file_pixel_size_um: float = math.nan  # µm per pixel that the file states
    file_scale_unused: str = ""  # a scale in the file that is not used, and why
    rotate: int = 0  # degrees clockwise by which the frames were rotated
    depth_bits: int = 32  # significant bits per pixel; 32 for float
    saturation_level: float = math.nan  # value of a saturated pixel; NaN for float
    strip_z0: int = 0  # averaged rows, half-open
    strip_z1: int = 1
    strip_how: str = "given"  # or "found", or "all rows" if no strip stood out
    padding: Sequence[str] = field(default_factory=list)  # columns beside the picture, half-open, left out
    strip_clarity: float = math.nan  # correlation of the ridges' slopes in odd and even rows, 0 to 1
    tilt_deg: float = math.nan  # of the ridges against the columns
    # RMS difference between positions from the upper and the lower half of the strip, and between those from
    # its outer and inner half, beyond tilt and noise, 0 if not significant; error of positions by the latter.
    strip_halves_px: float = 0.0
    strip_bow_px: float = 0.0
    strip_err_px: float = 0.0
    clock_kind: str = "playback"  # rate in the file's header, "file" (the recording's time stamps) or "given"
    clock_file: str = ""  # name of the file of time stamps that was given
    fps: float = math.nan  # frames per second
    frames_expected: int = 0  # read and lost
    frames_read: int = 0  # including blank ones
    frames_lost: int = 0  # including corrupt ones
    frames_blank: int = 0
    frames_corrupt: int = 0
    warnings: Sequence[str] = field(default_factory=list)  # problems that may affect the results


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


def check_strip(strip: xr.DataArray) -> None:
    """Raise `InputError` unless this is I(x, t) of neighbouring columns, with its frames in order."""
    STRIP.check(strip)
    odd = {
        "no frames" if not strip.sizes["frame"] else "no columns": not strip.size,
        f"dimensions {strip.dims}": strip.dims != ("frame", "x"),
        "columns that are not 1 px apart": (np.diff(strip["x"].values) != 1).any(),
        "frames out of order": (np.diff(strip["frame"].values) <= 0).any(),
    }
    if found := ", ".join(text for text, wrong in odd.items() if wrong):
        raise InputError("the strip", "I(x, t): neighbouring columns of frames in order, (frame, x)", found)


def strip_of(
    intensity: Floats32, *, frame: Ints, first_x: int, time_s: Floats, status: Any, attrs: Mapping[str, Any]
) -> xr.DataArray:
    """Return I(x, t), (frame, x), as `STRIP` declares it.  first_x: number of the leftmost column."""
    columns = np.arange(first_x, first_x + intensity.shape[1], dtype=np.int64)
    along = {"frame": frame, "time_s": time_s, "status": status}
    coords = {name: ("frame", values, STRIP[name].attrs) for name, values in along.items()}
    coords["x"] = ("x", columns, STRIP["x"].attrs)
    attrs = {**attrs, **STRIP["intensity"].attrs}
    return xr.DataArray(intensity, dims=("frame", "x"), coords=coords, name="intensity", attrs=attrs)


@dataclass(frozen=True, kw_only=True)
class DiagramMetadata(Metadata):
    """What a space-time diagram shows."""

    pixel_size_um: float = math.nan
    sheet: str = ""  # side and n, such as "right:23", of the sheet in the middle; "" for the whole strip
    sheet_index: int = -1  # of this sheet
    centre_px: float = math.nan  # column of the middle of the window, the sheet's mean position
    follow: bool = False  # whether the window follows the sheet

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
    """How the sheets were found. The attributes of the tracks also hold the strip's metadata."""

    fit: str = "unknown"  # subpixel method; "unknown" for positions from another program
    fit_asked: str = "unknown"  # the requested method
    window_px: int = 9  # of the fit
    ridges: str = "bright"  # or "dark"
    ridges_likelier: str = ""  # the polarity that the film suggests if another was given
    ridges_doubt: str = ""  # why the polarity that was found may be wrong
    ridges_alternate: Literal["yes", "no"] = "no"  # whether ridges of the other polarity lie between them
    sheets: int = 0
    sheets_how: Literal["given", "found"] = "found"
    ridge_fwhm_px: float = math.nan
    pitch_px: float = math.nan  # period of the comb, of whole pixels, by which sheets are searched
    spacing_px: float = math.nan  # median distance of neighbouring sheets
    contrast: float = math.nan  # height of the ridges, grey levels
    profile_noise: float = math.nan  # grey levels
    axis_px: float = math.nan  # position of the symmetry axis
    axis_how: str = "given"  # or "motion" or "geometry", the middle of the comb
    axis_low_px: float = math.nan  # interval in which the motion of the sheets puts the axis
    axis_high_px: float = math.nan
    axis_open: Literal["yes", "no"] = "no"  # whether this is wider than `TrackingSettings.decided_sheets`
    # whether most sheets move alike, as if the load carried them along
    axis_carried: Literal["yes", "perhaps", "no"] = "no"
    axis_missing: int = 0  # sheets that seem to be missing in wide spacings, and count for "geometry"
    gap_depth: float = math.nan  # of the gaps between ridges, over the ridges' height above the background
    least_margin: float = math.nan  # least log-likelihood of the identities over that of the next best
    ridges_dropped: int = 0  # persistent ridges that are not sheets
    wide_spacings: Sequence[str] = field(default_factory=list)  # "748 px (1.9 pitches)": a sheet overlooked
    sheets_alike: Literal["yes", "no"] = "no"  # whether a picture does not show which sheets it contains
    large_steps: Sequence[int] = field(default_factory=list)  # if so: frames before which the comb moved far
    unseen_jumps: Sequence[int] = field(default_factory=list)  # frames before which looks moved on by sheets
    ridges_beyond: int = 0  # ridges like sheets beyond or between the given number of sheets
    ridges_between: float = 0.0  # share of the frames with a further ridge in most spacings
    locking_px: float = 0.0  # locking to whole pixels that was subtracted, rms (`vision.sheets.distortion`)
    locking_err_px: float = 0.0  # what remains of it in the errors
    # light that goes from ridges to the gaps beside them or back, rms, over the ridges' height, and the error
    # of all positions by it; 0 unless it shows a second comb (`vision.sheets.film.second_comb`)
    second_comb: float = 0.0
    second_comb_err_px: float = 0.0
    noise_lasts: float = 0.0  # correlation of a frame's noise with the next if the camera averages in time
    mixed_frames: float = 0.0  # share of the frames that are mixed from two
    corrections_applied: int = 0  # manual ones; they are listed among the operations


SIDES = {-1: "left", 1: "right"}  # of the symmetry axis
MEASURED = ("ok", "blurred")  # flags of positions that were measured


class FlagCounts(Counter[str]):
    """How often each flag occurs in tracks, in alphabetical order."""

    def __init__(self, tracks: xr.Dataset) -> None:
        super().__init__(word_counts(tracks["flag"]))
        self.measured = self.of(MEASURED)
        self.frozen_frames = self["frozen"] // tracks.sizes["sheet"]  # every sheet has the flag there

    def of(self, flags: Iterable[str]) -> int:
        """Return how many positions have one of these flags."""
        return sum(self[flag] for flag in flags)


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
        "x_overlap_px": Variable(_SHEET, "px", "shift of all positions by neighbours that overlap"),
        "x_light_px": Variable(_SHEET, "px", "shift of all positions by uneven light"),
        "x_shape_px": Variable(_SHEET, "px", "error of all positions by the shape of the ridge"),
        "constant_error_px": Variable(_SHEET, "px", "error that all positions share; empty if not known"),
        "misscaled": Variable(
            _SHEET,
            "1",
            "relative error of the sheet's displacements, from what stands still meanwhile, such as dirt "
            "or uneven light; 0 below 1 %",
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
    """How the testing machine's file was read."""

    source: str = "the force recording"  # path
    separation_from: str = "none"  # unknown, or "displacement" or "speed" (d = d0 + V t)
    speed_mm_min: float = math.nan  # V, measured if a displacement was recorded
    d0_mm: float = math.nan  # initial separation
    d0_err_mm: float = math.nan
    layout: str = ""  # format of the file, and the meaning of its columns
    encoding: str = ""
    separator: str = ""
    decimal: str = ""
    columns: Sequence[str] = field(default_factory=list)  # role = name [unit] of each that is used
    blocks: str = ""
    columns_seen: str = ""
    displacement_unit: Literal["stated", "assumed"] = "stated"  # in the file
    notes: Sequence[str] = field(default_factory=list)  # assumptions
    warnings: Sequence[str] = field(default_factory=list)  # problems that may affect the results

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
    """How the stick-slip events were found."""

    noise_N: float = math.nan  # of the load
    threshold_N: float = math.nan  # smallest drop that counts as a slip
    # "noise" (a multiple of it), "jumps" (above those upwards), "gap" (between small and large drops)
    threshold_how: ThresholdHow = ""
    period_samples: float = math.nan  # typical number of samples used from slip to slip
    # One sample in so many is used: those between add nothing, as a filter has smoothed the noise.
    every: int = 1
    spikes: int = 0  # single samples that were ignored
    lowpass_s: float = 0.0  # time constant of the load cell that was corrected for, 0 for none
    # "recorded" (no correction requested), "given", or the result of the search: "found" (proven), "doubtful"
    # (seen but not proven, not corrected) or "none" (not seen)
    lowpass_how: LowpassHow = "none"
    # Time constant suggested by the transients after slips but not corrected for, whose effect is part of the
    # errors; whether slips of different size and spacing agree on it, and it leaves no tail when corrected;
    # else which of the two is not so.
    lowpass_proposed_s: float = math.nan
    lowpass_proven: bool = False
    lowpass_doubt: LowpassDoubt = ""
    lowpass_dF_share: float = 0.0  # median relative changes of ΔF and K that this correction would cause
    lowpass_K_share: float = 0.0
    lowpass_peak_mm: float = 0.0  # median travel in which a stick rises as much as it would raise the peak
    average_s: float = 0.0  # time over which the load was averaged, 0 for none
    ringing_s: float = math.nan  # period of the load's ringing after slips, or of hum
    # Duration that a filter of the machine may have given every slip, whose effect is part of the errors of
    # the fits; 0 where a low-pass was found, slips last less than 2.5 samples, or the load is level at their
    # ends.
    filter_s: float = 0.0
    two_slopes: bool = False  # whether stick phases were fitted with a knee
    # Correction of the lines at the valley for the curvature common to all sticks, over their rise; negative
    # where sticks begin steeply.
    bend_share: float = 0.0
    hum_Hz: float = math.nan  # of hum, without which slips are searched; forces and their errors contain it
    hum_N: float = 0.0  # its root mean square
    regime: RegimeName = "stick-slip"
    fall_over_rise: float = math.nan  # median duration of falls over that of rises
    warnings: Sequence[str] = field(default_factory=list)  # reasons why this may not be stick-slip
    first_slip_s: float = math.nan  # time of the first slip, force clock
    first_slip_N: float = math.nan  # load before it
    last_slip_s: float = math.nan
    machine_stiffness_N_per_mm: float = math.nan  # by which d was corrected; NaN for no correction
    central_part: float = 0.5  # fraction of the stick phase over which K is fitted


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

NOT_SUBTRACTED = "not subtracted"


@dataclass(frozen=True, kw_only=True)
class MotionMetadata(Metadata):
    """How the deformation was measured."""

    source: str = "the video"  # path
    pixel_size_um: float = math.nan
    margin_s: float = math.nan  # left out on either side of each slip
    interval_s: float = math.nan  # between frames
    noise_share: float = 0.0  # of noise that is correlated from frame to frame, in the variance
    noise_rho: float = 0.0  # its AR(1) coefficient
    camera_movement: str = ""  # how it was separated from the creep of the sheets, or `NOT_SUBTRACTED`
    warnings: Sequence[str] = field(default_factory=list)  # stick phases that are left out

    @property
    def corrected_for(self) -> str:
        """What σ_x is corrected for, as text."""
        common = "" if self.camera_movement == NOT_SUBTRACTED else " and for motion common to all sheets"
        return f"corrected for the noise of positions{common}"


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
        "monotone": Variable(_EVENT, "", "False where the ratio falls with n by more than chance"),
        "sheets_known": Variable(_EVENT, "", "sheets of this side with a ratio"),
    },
    kind=pd.DataFrame,
)

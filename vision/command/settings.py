"""Convert options, typed or from a TOML file, to the pipeline's settings."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from cyclopts import App, CycloptsError

from vision.command.options import GROUPS, SETTING_OF, flag_of, names_given, with_point
from vision.data import PIXEL_SIZE_UM
from vision.errors import InputError, did_you_mean
from vision.files import AGAIN, path_beside, read_toml, reading, shortened
from vision.folder import from_json
from vision.force import parse_columns
from vision.numeric import number
from vision.pipeline import Settings
from vision.run.provenance import Parameter
from vision.run.reading import read_run
from vision.sample import PUBLISHED, Sample
from vision.sheets import read_corrections
from vision.spacetime import Sheet

UM_PER = {"cm": 10_000.0, "mm": 1000.0, "um": 1.0, "µm": 1.0, "μm": 1.0}  # micro sign and Greek mu
_GEOMETRY = {SETTING_OF[name]: name for name in ("thickness", "width", "length", "t_star")}
_SAMPLE = ("sheets_per_block", *_GEOMETRY.values())
_WITH_ERROR = ("d0", "force_lowpass", "force_average", *_GEOMETRY.values())
_DEFAULT = Settings()
DEFAULTS: Mapping[str, Any] = {
    "strip": "auto",
    "force_lowpass": f"{_DEFAULT.force_lowpass_s:g}",
    "force_average": f"{_DEFAULT.force_average_s:g}",
    "common_mode": "on" if _DEFAULT.common_mode else "off",
    "sheets_per_block": PUBLISHED.sheets_per_block,
    **{name: getattr(_DEFAULT, name) for name in ("ridges", "fit", "rotate", "threshold")},
    **{option: getattr(PUBLISHED, name) for name, option in _GEOMETRY.items()},
}
"""Values that run.json holds for options that are not given, as they would be typed; None if not listed."""


def parameters_given(*groups: Any, **others: Any) -> dict[str, Parameter]:
    """Return a command's options for run.json, marked as given or default.

    groups: as in `vision.command.options`.  others: options outside them, given unless empty, None or False.
    """
    typed = {name: value for group in groups for name, value in vars(group).items()} | others
    given = {*names_given(*groups), *(name for name, value in others.items() if value)}
    return {name: Parameter(value, "given" if name in given else "default") for name, value in typed.items()}


def merged(*groups: Any, config: Path | None = None) -> dict[str, Parameter]:
    """Return every option of these groups, as typed, with its origin (see `with_config`)."""
    return with_config({name: value for group in groups for name, value in vars(group).items()}, config)


def with_config(typed: Mapping[str, Any], config: Path | None) -> dict[str, Parameter]:
    """Return typed options, those of a TOML file in place of None, and else the defaults, with their origin.

    Raises: InputError for a file that cannot be read, names an unknown option or gives it a wrong value.
    """
    from_file = read_config(config) if config else {}
    found: dict[str, Parameter] = {}
    for name, value in typed.items():
        if value is not None:
            found[name] = Parameter(_plain(name, value), "given")
        elif from_file.get(name) is not None:
            found[name] = Parameter(_plain(name, from_file[name]), "config")
        else:
            found[name] = Parameter(DEFAULTS.get(name), "default")
    return found | _pixel_size(found) if "pixel_size" in found else found


def _pixel_size(options: Mapping[str, Parameter]) -> dict[str, Parameter]:
    """Return the three options that set the pixel size, with `pixel_size` and `pixel_size_err` in µm or None.

    One of them on the command line overrides those of a file.

    Raises: InputError if two are given in the same place.
    """
    names, none = ("pixel_size", "scale", "pitch"), Parameter(None, "default")
    hows = [options[name].how for name in names if options[name].value is not None]
    how: Literal["given", "config"] = "given" if "given" in hows else "config"
    chosen = {name: options[name] if options[name].how == how else none for name in names}
    given = [flag_of(name) for name in names if chosen[name].value is not None]
    if len(given) > 1:
        raise InputError(" and ".join(given), "one of --pixel-size, --scale and --pitch", f"{len(given)}")
    size, error = parse_pixel_size(chosen["pixel_size"].value)
    if size is None:
        size, error = parse_scale(chosen["scale"].value)
    found = {"pixel_size": size, "pixel_size_err": error}
    return chosen | {name: Parameter(one, "default" if one is None else how) for name, one in found.items()}


def _plain(name: str, value: Any) -> Any:
    """Convert a value to a number if its option also accepts a word or an error, and it has neither."""
    plain = number(value) if name in _WITH_ERROR and isinstance(value, str) else math.nan
    return plain if math.isfinite(plain) else value


def read_config(path: Path) -> dict[str, Any]:
    """Read options from a TOML file and parse them as if they were typed.

    Keys are the long names with hyphens or underscores. Options of the sample may be in a table
    ``[sample]``. Paths are relative to the file, as those in a table of films.
    """
    table = read_toml(path, "a TOML file of options", "write lines like: strip = '60:144'")
    found: dict[str, Any] = {}
    for key, value in table.items():
        options = value if isinstance(value, dict) and key == "sample" else {key: value}
        for name, item in options.items():
            option = name.replace("-", "_")
            if option in found:
                raise InputError(path, f"one value for '{option}'", "two")
            parsed = parse_option(path, option, item)
            found[option] = path_beside(path.parent, parsed) if isinstance(parsed, Path) else parsed
    return found


def parse_option(source: Path, name: str, value: Any) -> Any:
    """Convert one option's value, text or a number, as the command line would.

    source: the TOML file or table that holds it.  name: the option, with underscores.
    Raises: InputError for an unknown option, or a value that it does not accept.
    """
    if name not in SETTING_OF:
        advice = did_you_mean(name, (*SETTING_OF, "sample"))
        wanted = "options of track" if advice else f"options of track ({', '.join(SETTING_OF)})"
        raise InputError(source, wanted, f"'{name}'", advice)
    if not isinstance(value, str | int | float) or isinstance(value, bool):
        raise InputError(source, f"one value for '{name}'", f"a {type(value).__name__}")
    app = App(help_flags=(), version_flags=())
    app.default(next(group for group in GROUPS if name in group.__dataclass_fields__))
    try:
        token = f"{flag_of(name)}={str(value)[:4000]}"  # longer than any name of a file
        options = app([token], exit_on_error=False, print_error=False, result_action="return_value")
        if name in _GEOMETRY.values():
            parse_with_error(getattr(options, name), flag_of(name))
    except (CycloptsError, ValueError, OverflowError) as error:
        found = shortened(repr(value))
        wanted = f"a value for '{name}' as on the command line"
        raise InputError(source, wanted, found, with_point(str(value))) from error
    return getattr(options, name)


def parse_range(text: str | None, option: str) -> slice | None:
    """Parse `A:B`, half-open; either end may be left out. None and "auto" give None.  Raises: InputError."""
    if text is None or text == "auto":
        return None
    match = re.fullmatch(r"\s*([0-9]{0,12})\s*:\s*([0-9]{0,12})\s*", text)
    start, stop = ((int(end) if end else None) for end in match.groups()) if match else (None, None)
    if match is None or (stop is not None and stop <= (start or 0)):
        raise InputError(option, "two whole numbers A:B with 0 <= A < B", f"'{text}'", "write 60:144")
    return slice(start, stop)


def parse_with_error(text: str | float | None, option: str) -> tuple[float | None, float | None]:
    """Return (value, error) of 13, 13mm, 13.0±0.1, 13.0+-0.1 or 13.0+/-0.1; the error is None if not given.

    Raises: InputError.
    """
    if text is None:
        return None, None
    unit = "N" if option == flag_of("t_star") else "mm"
    value, error = _value_and_error(str(text).strip().removesuffix(unit))
    if not 0 <= value < math.inf:
        advice = f"write it in {unit} with a decimal point, like 13.5 or 13.5±0.1"
        raise InputError(option, f"a number of {unit} from 0, or with its smaller error", f"'{text}'", advice)
    return value, error


def _value_and_error(text: str) -> tuple[float, float | None]:
    """Return the numbers of 13, 13±0.1, 13+-0.1 or 13+/-0.1, with None for no error.

    The value is NaN if the text is no number, or the error exceeds a value other than 0: 10±20.
    """
    first, sign, last = text.replace("+-", "±").replace("+/-", "±").partition("±")
    value, error = number(first), number(last) if sign else 0.0
    return value if 0 <= error <= (value or error) < math.inf else math.nan, error if sign else None


def _length_and_error(text: str) -> tuple[float, float | None, str]:
    """Return value, error and unit of a length, such as 10±0.1um, as `_value_and_error` does.

    The unit is "um" (also of lengths in cm and mm, which are converted), "px", or "" for none.
    """
    text = text.strip()
    unit = next((unit for unit in (*UM_PER, "px") if text.endswith(unit)), "")
    value, error = _value_and_error(text.removesuffix(unit))
    scale, name = (UM_PER[unit], "um") if unit in UM_PER else (1.0, unit)
    return value * scale, None if error is None else error * scale, name


def parse_duration(text: str | float, option: str) -> float | Literal["auto"]:
    """Parse a number of seconds from 0, of milliseconds with "ms", or "auto".  Raises: InputError."""
    if text == "auto":
        return "auto"
    figures, ms, rest = str(text).strip().partition("ms")
    value = math.nan if rest else number(figures) * (1e-3 if ms else 1.0)
    if not 0 <= value < math.inf:
        wanted = "seconds from 0, such as 0.05 or 50ms, or auto"
        raise InputError(option, wanted, f"'{text}'", with_point(figures))
    return value


def _refused(option: str, wanted: str, text: str, example: str) -> InputError:
    """Return the error for the value of an option; it says how to write decimal commas, or an example."""
    return InputError(option, wanted, f"'{text}'", with_point(text) or f"write {example}")


def parse_pair(
    text: str, option: str, wanted: str, *, example: str, most: float = math.inf
) -> tuple[float, float]:
    """Parse `A:B`, two numbers from 0 to `most`, the second larger.  Raises: InputError."""
    first, _, last = text.partition(":")
    low, high = number(first), number(last)
    if not 0 <= low < high <= most or high == math.inf:
        raise _refused(option, wanted, text, example)
    return low, high


def at_least(value: float, option: str, least: float) -> float:
    """Return the number unchanged if it is finite and not below `least`.  Raises: InputError."""
    if not (least <= value < math.inf):
        wanted = "a number above 0" if 0 < least < 1e-6 else f"a number from {least:g}"
        raise InputError(option, wanted, f"'{value}'")
    return value


def parse_pixel_size(text: str | None) -> tuple[float | None, float | None]:
    """Return µm per pixel and its error, or None, from 10, 10um, 0.01mm or 10±0.1um.  Raises: InputError."""
    if text is None:
        return None, None
    size, error, unit = _length_and_error(text.strip().removesuffix("/px"))
    if unit == "px" or not PIXEL_SIZE_UM[0] <= size <= PIXEL_SIZE_UM[1]:
        low, high = PIXEL_SIZE_UM
        wanted = f"a number from {low:g} to {high:g} (µm per px), or with its smaller error"
        raise _refused("--pixel-size", wanted, text, "10.5, 10.5um, 0.0105mm or 10.5±0.1um")
    return size, error


def parse_scale(text: str | None) -> tuple[float | None, float | None]:
    """Return µm per pixel and its error, or None, from a length in both units, in either order.

    Both lengths may have an error: 1mm=103px, 1mm=103±1px.  Raises: InputError.
    """
    if text is None:
        return None, None
    sides = sorted(map(_length_and_error, text.split("=")), key=lambda side: side[2] == "px")
    lengths, known = [side[0] for side in sides], [side[2] for side in sides] == ["um", "px"]
    if not (known and all(0 < one < math.inf for one in lengths) and lengths[0] / lengths[1] >= 1e-6):
        wanted = "a length in cm, mm or µm and its px, or with their smaller errors"
        raise _refused("--scale", wanted, text, "1mm=103px or 1mm=103±1px")
    size = lengths[0] / lengths[1]
    relative = [error / value for value, error, _ in sides if error is not None]
    return size, size * math.hypot(*relative) if relative else None


def parse_pitch(text: str | None) -> tuple[float | None, float | None]:
    """Return the distance of neighbouring sheets in µm and its error, or None, from 0.2mm or 0.2±0.002mm.

    Raises: InputError.
    """
    if text is None:
        return None, None
    value, error, unit = _length_and_error(text)
    if unit != "um" or not 0 < value < math.inf:
        wanted = "a length in cm, mm or µm, or with its smaller error"
        raise _refused("--pitch", wanted, text, "0.2mm or 0.2±0.002mm")
    return value, error


def parse_width(text: str) -> dict[str, float]:
    """Parse a width with its unit: {"width_um": …} for cm, mm, um and µm, {"width_px": …} for px.

    Raises: InputError, also for a number without a unit, which could be in µm or in px.
    """
    value, error, unit = _length_and_error(text)
    if not unit or error is not None or not 0 < value < math.inf:
        wanted = "a length with its unit: cm, mm, um, µm or px"
        raise _refused("--width", wanted, text, "0.2mm")
    return {f"width_{unit}": value}


def parse_seconds(text: str | None) -> tuple[float | None, float | None] | None:
    """Parse the `A:B` of --time, half-open; either end may be left out.  Raises: InputError."""
    if text is None:
        return None
    first, colon, last = text.partition(":")
    start = number(first) if first.strip() else None
    stop = number(last) if last.strip() else None
    ends = [end for end in (start, stop) if end is not None]
    rising = all(map(math.isfinite, ends)) and ends == sorted(set(ends))
    if not (colon and ends and rising):
        wanted = "two times in seconds A:B with A < B"
        raise _refused("--time", wanted, text, "40:45.1")
    return start, stop


def parse_sheets(texts: Sequence[str]) -> list[Sheet]:
    """Parse sheets: side and number (right:23) or index from the left (47), several with commas.

    Raises: InputError.
    """
    return [_sheet(part.strip()) for text in texts for part in text.split(",")]


def _sheet(text: str) -> Sheet:
    side, _, n = text.partition(":")
    if re.fullmatch(r"[0-9]{1,9}", text):
        return int(text)
    if side not in ("left", "right") or not re.fullmatch(r"[0-9]{1,9}", n) or int(n) < 1:
        wanted = "left or right and a number, or an index"
        raise InputError("--sheet", wanted, f"'{text}'", "write right:23 or 47")
    return side, int(n)


# --- the pipeline's settings --------------------------------------------------------------------------------

_PARSERS: Mapping[str, Callable[[Any, str], Any]] = {
    **dict.fromkeys(("strip", "columns", "frames"), parse_range),
    "window": lambda text, _: int(text) if re.fullmatch(r"[0-9]{1,9}", text) else text,
    "corrections": lambda file, _: read_corrections(file),
    "force_columns": lambda text, _: parse_columns(text),
    "force_lowpass": parse_duration,
    "force_average": parse_duration,
    "fit_range": partial(parse_pair, wanted="two separations in mm A:B with A < B", example="13.2:17"),
    "common_mode": lambda text, _: text != "off",
}
"""How the value of an option becomes a setting; the others are settings as they are."""


def settings_of(parameters: Mapping[str, Parameter]) -> Settings:
    """Return the pipeline's settings.  Raises: InputError for values that are invalid for any recording."""
    value = {name: parameter.value for name, parameter in parameters.items()}
    parts: dict[str, Any] = {
        setting: _PARSERS[option](value[option], flag_of(option)) if option in _PARSERS else value[option]
        for option, setting in SETTING_OF.items()
        if value.get(option) is not None and setting in Settings.__dataclass_fields__
    }
    parts["d0_mm"], parts["d0_err_mm"] = parse_with_error(value.get("d0"), "--d0")
    parts["pitch_um"], parts["pitch_err_um"] = parse_pitch(value.get("pitch"))
    parts["pixel_size_err_um"] = value.get("pixel_size_err")
    sizes = {name: parse_with_error(value.get(option), flag_of(option)) for name, option in _GEOMETRY.items()}
    parts["geometry_err"] = {name: error for name, (_, error) in sizes.items() if error is not None}
    if any(parameters[name].how != "default" for name in _SAMPLE if name in parameters):
        parts["sample"] = Sample(
            sheets_per_block=value.get("sheets_per_block", PUBLISHED.sheets_per_block),
            **{name: size for name, (size, _) in sizes.items() if size is not None},
        )
    return Settings(**{name: part for name, part in parts.items() if part is not None})


def options_of(settings: Settings) -> dict[str, Parameter]:
    """Return the options that give these settings, so that `settings_of` returns these settings again.

    Corrections and `Settings.tuning` are no options. A setting without one has its own name.
    """
    typed: dict[str, Any] = {}
    for option, setting in SETTING_OF.items():
        if setting in Settings.__dataclass_fields__ and option != "corrections":
            value = getattr(settings, setting)
            typed[option] = None if value == getattr(_DEFAULT, setting) else _as_typed(value)
    typed |= {"corrections": None, "scale": None, "d0": _with_error(settings.d0_mm, settings.d0_err_mm)}
    sample = settings.sample or (PUBLISHED if settings.geometry_err else None)
    typed["sheets_per_block"] = None if sample is None else sample.sheets_per_block
    for setting, option in _GEOMETRY.items():
        error = settings.geometry_err.get(setting)
        typed[option] = None if sample is None else _with_error(getattr(sample, setting), error)
    for name, error in (("pixel_size", settings.pixel_size_err_um), ("pitch", settings.pitch_err_um)):
        typed[name] = None if typed[name] is None else f"{_with_error(typed[name], error)}um"
    if typed["pitch"] is not None:  # the pixel size follows from it
        typed["pixel_size"] = None
    typed |= {"window": None if typed["window"] is None else str(typed["window"])}
    return with_config(typed, None) | parameters_given(free_t_star=settings.t_star_fitted)


def _as_typed(value: Any) -> Any:
    """Return a setting as its option would be typed."""
    if isinstance(value, slice):
        return ":".join("" if end is None else str(end) for end in (value.start, value.stop))
    if isinstance(value, tuple):
        return ":".join(map(repr, map(float, value)))
    if isinstance(value, Mapping):
        return ",".join(f"{role}={column}" for role, column in value.items())
    return ("on" if value else "off") if isinstance(value, bool) else value


def _with_error(value: float | None, error: float | None) -> float | str | None:
    return value if error is None else f"{value}±{error}"


def settings_of_run(folder: Path) -> Settings:
    """Return the settings that a run was made with, without its corrections.

    Raises: InputError for a folder that is no run, or whose run.json is damaged.
    """
    run = read_run(folder)
    parameters = run.parameters | {"corrections": Parameter(None, "default")}
    with reading(folder / "run.json", "the parameters of a run", AGAIN):
        if times := run.value("timestamps"):  # the working directory may be another one now
            parameters["timestamps"] = Parameter(run.found(Path(times)), "given")
        settings = replace(settings_of(parameters), t_star_fitted=run.value("free_t_star") is True)
        tuning = settings.tuning
        for stage, changed in (run.facts.get("tuning") or {}).items():
            values = {**changed, **from_json(getattr(tuning, stage), changed)}  # unknown names are refused
            tuning = replace(tuning, **{stage: replace(getattr(tuning, stage), **values)})
        return replace(settings, tuning=tuning)

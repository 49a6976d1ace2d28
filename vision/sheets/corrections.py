"""Manual corrections: their file format, and their effect on the detections.

A TOML file settles the doubts that `vision.sheets.recovery.doubtful_stretches` lists, and states which ridges
are sheets:

.. code-block:: toml

    [[accept]]            # the doubtful ridge is this sheet
    sheet = 0
    frames = "226:355"    # half-open, as in the film; "226:" goes to the end

    [[leave_out]]         # no position here, whatever was found
    sheet = 3
    frames = "10:12"

    [[swap]]              # these two were taken for each other
    sheets = [4, 5]
    frames = "60:61"

    [[assign]]            # the ridge at this column of the first frame, followed from there
    sheet = 6
    frames = "80:111"
    x_px = 687.0

    [[add]]               # a sheet that was not counted: the ridge here, followed both ways, or an empty
    frame = 500           # place between two sheets that are far enough apart: a sheet without positions
    x_px = 312.0

    [[delete]]            # this is no sheet
    sheet = 12

    [[axis]]              # the symmetry axis
    x_px = 959.5

    [[strip]]             # the rows that are averaged
    rows = "60:144"

    [[clock]]             # force clock at video time 0, and its drift if known
    offset_s = 36.0024
    drift_ppm = -181.4

`sheet` is the index from the left, as in tracks.csv; `accept` and `leave_out` take several at once, as in
``sheets = [0, 1, 2]``; ``frames = "70"`` is one frame. Every entry may have a ``note``, which is kept, and a
``date``. Entries with a date are applied in order of date, each to the result of the earlier ones: an index
is the one seen at that date.
Entries without a date are applied first, with the indices of the tracking. Of several axes, strips or clocks
the last is used. ``[run]`` names the film that the decisions belong to; entries under ``[[undone]]`` have no
effect.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime
from datetime import date as day
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from vision.data import SIDES
from vision.errors import InputError, check_kind, did_you_mean
from vision.files import read_toml, shortened
from vision.numeric import Floats, Ints, nan_median, nearest
from vision.sheets.identities import Doubt
from vision.sheets.numbering import placed
from vision.sheets.recovery import Detections, Flag
from vision.sheets.ridges import RidgeComb, Ridges

KEYS: Mapping[str, tuple[str, ...]] = {
    "accept": ("sheet", "frames"),
    "leave_out": ("sheet", "frames"),
    "swap": ("sheets", "frames"),
    "assign": ("sheet", "frames", "x_px"),
    "add": ("frame", "x_px"),
    "delete": ("sheet",),
    "axis": ("x_px",),
    "strip": ("rows",),
    "clock": ("offset_s",),
}
"""Kinds of corrections, and the keys that an entry of each kind must have."""
OPTIONAL: Mapping[str, tuple[str, ...]] = {"clock": ("drift_ppm",)}
"""Further keys that an entry may have, besides its date and a note."""
OF_SEVERAL = ("accept", "leave_out")
"""Kinds that may name several sheets in one entry."""
OF_STRETCHES = ("accept", "leave_out", "swap", "assign")
OF_SHEETS = (*OF_STRETCHES, "add", "delete")
"""Kinds that change which ridge is which sheet; the others change one number of the run."""
_LONGEST_NOTE = 500  # characters
_RENUMBERING = ("add", "delete", "axis")


@dataclass(frozen=True, kw_only=True)
class Correction:
    """One manual decision.

    Parameters
    ----------
    kind
        One of `KEYS`.
    sheets
        Index from the left; two for "swap", none for kinds that concern no sheet.
    first, stop
        Frames, half-open, as numbered in the film; stop None is the end. For "add" the frame of x_px alone.
    x_px
        Column of the ridge in the first frame, for "assign" and "add"; column of the axis.
    rows
        Rows of the strip, half-open.
    offset_s, drift_ppm
        Offset and drift of the clock.
    date
        Time of the decision, ISO 8601; "" if not stated.
    note
        What the user notes about it.
    name
        Name of the entry in messages.
    """

    kind: str
    sheets: tuple[int, ...] = ()
    first: int = 0
    stop: int | None = None
    x_px: float | None = None
    rows: tuple[int, int] | None = None
    offset_s: float | None = None
    drift_ppm: float = 0.0
    date: str = ""
    note: str = ""
    name: str = "the correction"

    def text(self, names: Sequence[str] = ()) -> str:
        """Return the decision and its note in words.

        names: as from `sheet_names`, one per sheet; without them a sheet is named by its index.
        """
        return self._text(names) + (f" ({self.note})" if self.note else "")

    def _text(self, names: Sequence[str]) -> str:
        named = (names[k] if k < len(names) else f"the sheet of index {k}" for k in self.sheets)
        who = " and ".join(named)
        when = f"frames {self.first}:{'' if self.stop is None else self.stop}"
        match self.kind:
            case "accept":
                return f"doubtful ridge accepted as {who}, {when}"
            case "leave_out":
                return f"{who} left out, {when}"
            case "swap":
                return f"{who} swapped, {when}"
            case "assign":
                return f"ridge at {self.x_px:.1f} px assigned to {who}, {when}"
            case "add":
                return f"sheet added at {self.x_px:.1f} px of frame {self.first}"
            case "delete":
                return f"{who} deleted"
            case "axis":
                return f"axis at {self.x_px:.1f} px"
            case "strip":
                top, bottom = self.rows or (0, 0)
                return f"strip at rows {top}:{bottom}"
            case _:
                drift = f", drift {self.drift_ppm:.1f} ppm" if self.drift_ppm else ""
                return f"force clock at {self.offset_s:.4f} s at video time 0{drift}"

    @property
    def what(self) -> tuple[str, dict[str, Any]]:
        """Content of the decision, without its date, note and name."""
        return self.kind, replace(self, date="", note="").entry()

    def entry(self) -> dict[str, Any]:
        """Return the entry as written in a file, without its kind."""
        stop = "" if self.stop is None else self.stop
        values: dict[str, Any] = {
            "sheet": self.sheets[0] if self.sheets else None,
            "sheets": list(self.sheets),
            "frames": f"{self.first}:{stop}",
            "frame": self.first,
            "x_px": self.x_px,
            "rows": "" if self.rows is None else f"{self.rows[0]}:{self.rows[1]}",
            "offset_s": self.offset_s,
            "drift_ppm": self.drift_ppm,
        }
        keys = (*KEYS[self.kind], *OPTIONAL.get(self.kind, ()))
        further = {"date": self.date, "note": self.note}
        return {key: values[key] for key in keys} | {key: text for key, text in further.items() if text}


@dataclass(frozen=True, kw_only=True)
class Decisions:
    """Content of a file of corrections.

    corrections: decisions in the order of application. undone: decisions that were undone, the last one last;
    they have no effect. film: SHA-256 or fingerprint of the film that they belong to; "" if not stated.
    """

    corrections: tuple[Correction, ...] = ()
    undone: tuple[Correction, ...] = ()
    film: str = ""


def sheet_names(side: Ints, n: Ints) -> list[str]:
    """Return the names of the sheets, from the left: "left 8 (index 4)"."""
    pairs = enumerate(zip(side.tolist(), n.tolist(), strict=True))
    return [sheet_name(which, number, k) for k, (which, number) in pairs]


def sheet_name(side: int, n: int, index: int) -> str:
    """Return the name of a sheet in messages, such as "left 8 (index 4)"."""
    return f"{SIDES[side]} {n} (index {index})"


def decision_texts(corrections: Sequence[Correction], names: Sequence[str]) -> list[str]:
    """Return decisions in words, with the names of the sheets as they are after all of them.

    Up to the last decision that changes the numbering, sheets had other names, and are named by their index.
    """
    last = max((k for k, one in enumerate(corrections) if one.kind in _RENUMBERING), default=-1)
    return [one.text(names if k > last else ()) for k, one in enumerate(corrections)]


def last_of(corrections: Sequence[Correction], kind: str) -> Correction | None:
    """Return the last correction of this kind, which is the one in effect; None without any."""
    return next((one for one in reversed(ordered(corrections)) if one.kind == kind), None)


def ordered(corrections: Sequence[Correction]) -> tuple[Correction, ...]:
    """Return the corrections in the order of application.

    Those without a date come first, and among these the kinds that change indices last; then by date.
    """
    change_indices = ("delete", "add")

    def key(one: Correction) -> tuple[str, int, int]:
        late = change_indices.index(one.kind) + 1 if not one.date and one.kind in change_indices else 0
        return one.date, late, -one.sheets[0] if late and one.sheets else 0

    return tuple(sorted(corrections, key=key))


# --- the file -----------------------------------------------------------------------------------------------


def check_corrections(**values: Any) -> None:
    """Raise `InputError` for an argument that is no tuple of corrections."""
    wanted = "the path of a file of corrections, or a tuple as `read_corrections` returns it"
    check_kind(tuple, wanted, **values)
    for name, corrections in values.items():
        for one in corrections:
            check_kind(Correction, wanted, **{name: one})


def read_corrections(path: str | Path) -> tuple[Correction, ...]:
    """Read decisions from a TOML file, in the order of application.

    Raises: InputError as `read_decisions`.
    """
    return read_decisions(path).corrections


def read_decisions(path: str | Path) -> Decisions:
    """Read a whole TOML file of decisions; the module describes its format.

    Raises: InputError for a file that cannot be read, an unknown kind or key, or a value of the wrong type.
    The message names the entry.
    """
    advice = "write entries such as [[swap]], sheets = [4, 5]"
    table = read_toml(Path(path), "a TOML file of corrections", advice)
    run, undone = table.pop("run", {}), table.pop("undone", [])
    if not isinstance(run, dict) or not isinstance(undone, list):
        raise InputError(path, "[run] and [[undone]] as tables", f"run = {run!r}")
    found = []
    for kind, entries in table.items():
        if kind not in KEYS:
            raise InputError(path, f"entries {', '.join(f'[[{name}]]' for name in KEYS)}", f"'{kind}'")
        if not isinstance(entries, list):
            raise InputError(path, f"[[{kind}]], in two brackets", f"{kind} = {entries!r}")
        found += [
            correction_of(kind, one, f"{path}, [[{kind}]] {number}")
            for number, entry in enumerate(entries, 1)
            for one in _one_sheet_each(kind, entry)
        ]
    return Decisions(
        corrections=ordered(found),
        undone=tuple(_undone(path, number, entry) for number, entry in enumerate(undone, 1)),
        film=str(run.get("film", "")),
    )


def _one_sheet_each(kind: str, entry: Any) -> list[Any]:
    """Return one entry per sheet of an entry with several, and any other entry as it is."""
    if kind not in OF_SEVERAL or not isinstance(entry, dict) or "sheet" in entry:
        return [entry]
    sheets = entry.get("sheets")
    if not isinstance(sheets, list) or not sheets:
        return [entry]
    rest = {key: value for key, value in entry.items() if key != "sheets"}
    return [{**rest, "sheet": sheet} for sheet in sheets]


def _undone(path: str | Path, number: int, entry: Any) -> Correction:
    name = f"{path}, [[undone]] {number}"
    if not isinstance(entry, dict) or entry.get("kind") not in KEYS:
        raise InputError(name, f"a kind of {', '.join(KEYS)}", repr(entry))
    return correction_of(entry["kind"], {key: entry[key] for key in entry if key != "kind"}, name)


def corrections_text(decisions: Decisions) -> str:
    """Return the text of a file that `read_decisions` reads, with one paragraph per entry, so that files can
    be merged line by line."""
    parts = [
        "# Manual decisions. `track VIDEO --corrections FILE` applies them; `track review` adds to them.\n"
    ]
    if decisions.film:
        parts.append(_paragraph("[run]", {"film": decisions.film}))
    parts += [_paragraph(f"[[{one.kind}]]", one.entry()) for one in decisions.corrections]
    parts += [_paragraph("[[undone]]", {"kind": one.kind} | one.entry()) for one in decisions.undone]
    return "\n".join(parts)


def _paragraph(head: str, values: Mapping[str, Any]) -> str:
    lines = (f"{name} = {json.dumps(value, ensure_ascii=False)}\n" for name, value in values.items())
    return f"{head}\n{''.join(lines)}"


def correction_of(kind: str, entry: Any, name: str = "the correction") -> Correction:
    """Return the decision that an entry of a file states.

    Raises: InputError for a key that is missing or unknown, or a value of the wrong type. The message names
    the entry.
    """
    _check_keys(kind, entry, name)
    parts: dict[str, Any] = {}
    if "sheet" in entry or "sheets" in entry:
        parts["sheets"] = _sheets(kind, entry, name)
    if "frames" in entry:
        parts["first"], parts["stop"] = _range(entry["frames"], name, "frames", open_end=True)
    if "frame" in entry:
        frame = entry["frame"]
        if type(frame) is not int or not 0 <= frame < 1 << 60:
            raise InputError(name, "frame, a number from 0", repr(frame))
        parts["first"], parts["stop"] = frame, frame + 1
    if "rows" in entry:
        parts["rows"] = _range(entry["rows"], name, "rows")
    for key, unit in (("x_px", "a column in px"), ("offset_s", "seconds"), ("drift_ppm", "a number")):
        if key in entry:
            parts[key] = _number(entry[key], name, f"{key}, {unit}")
    date, note = _date(entry.get("date", ""), name), shortened(str(entry.get("note", "")), _LONGEST_NOTE)
    return Correction(kind=kind, date=date, note=note, name=name, **parts)


def _check_keys(kind: str, entry: Any, name: str) -> None:
    """Refuse an entry that lacks a key of its kind, or has another one."""
    allowed = (*KEYS[kind], *OPTIONAL.get(kind, ()), "date", "note")
    if isinstance(entry, dict) and (unknown := next((key for key in entry if key not in allowed), None)):
        raise InputError(name, f"keys {', '.join(allowed)}", f"'{unknown}'", did_you_mean(unknown, allowed))
    if not isinstance(entry, dict) or not set(KEYS[kind]) <= set(entry):
        found = ", ".join(entry) if isinstance(entry, dict) else repr(entry)
        raise InputError(name, " and ".join(KEYS[kind]), found or "nothing")


def _sheets(kind: str, entry: Mapping[str, Any], name: str) -> tuple[int, ...]:
    sheets = entry["sheets"] if kind == "swap" else [entry["sheet"]]
    whole = isinstance(sheets, list) and all(type(sheet) is int and sheet >= 0 for sheet in sheets)
    if not whole or len(set(sheets)) != (2 if kind == "swap" else 1):
        swap = "sheets = [4, 5], two indices from the left"
        wanted = swap if kind == "swap" else "sheet = 4, from the left"
        raise InputError(name, wanted, repr(entry.get("sheets", entry.get("sheet"))))
    return tuple(sheets)


def _range(text: Any, name: str, what: str, *, open_end: bool = False) -> tuple[int, int | None]:
    if open_end and str(text).strip().isdecimal() and len(str(text)) < 19:  # one frame
        return int(text), int(text) + 1
    first, colon, stop = (part.strip() for part in str(text).partition(":"))
    digits = first.isdecimal() and (stop.isdecimal() or (open_end and not stop))
    if not (colon and digits and len(first + stop) < 19 and (not stop or int(first) < int(stop))):
        raise InputError(name, f'{what} = "A:B" with A < B', repr(text))
    return int(first), int(stop) if stop else None


def _number(value: Any, name: str, wanted: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e12:
        raise InputError(name, wanted, repr(value))
    return float(value)


def _date(value: Any, name: str) -> str:
    """Return a date as text that sorts by time, in UTC if it states its offset."""
    if isinstance(value, day):  # also a datetime
        value = value.isoformat()
    try:
        moment = datetime.fromisoformat(value) if value else None
    except (TypeError, ValueError):
        raise InputError(name, 'date = "2026-01-31T12:00:00Z"', repr(value)) from None
    if moment is None or moment.tzinfo is None:
        return str(value)
    return moment.astimezone(UTC).isoformat(timespec="milliseconds")


# --- application --------------------------------------------------------------------------------------------


class Corrected(ABC):
    """Sheets to which corrections are applied: their positions and what else is stored of them.

    arrays: (frame, sheet), with at least flag, why and withheld_px; changed in place, and replaced where a
    sheet is added or deleted. position: which of them has the positions, from column `origin_px` of the
    picture. frames: their numbers in the film.
    """

    def __init__(
        self, arrays: dict[str, Any], position: str, frames: Ints, comb: RidgeComb, origin_px: float
    ) -> None:
        self.arrays, self.position, self.frames = arrays, position, frames
        self.comb, self.origin_px = comb, origin_px

    @abstractmethod
    def follow(self, correction: Correction, rows: Ints, without: int | None = None) -> tuple[Floats, Ints]:
        """Follow the correction's ridge through these rows as `follow_ridge` does."""

    @abstractmethod
    def measured(self, rows: Ints, sheet: int, ridge_px: Floats, otherwise: Flag) -> dict[str, Any]:
        """Return position, flag and what else is stored of these ridges as those of a sheet, by array; the
        flag is `otherwise` where the ridge is NaN."""

    def put(self, rows: Ints, sheet: int, ridge_px: Floats, otherwise: Flag) -> None:
        """Give these ridges to a sheet, and the flag `otherwise` where the ridge is NaN; no doubt remains."""
        values = self.measured(rows, sheet, ridge_px, otherwise)
        for name, one in (values | {"why": Doubt.NONE, "withheld_px": np.nan}).items():
            self.arrays[name][rows, sheet] = one

    def rows_of(self, correction: Correction) -> Ints:
        """Return the rows of a correction.

        Raises: InputError for a sheet or frames that do not exist.
        """
        sheets, end = self.arrays["flag"].shape[1], int(self.frames[-1]) + 1
        stop = end if correction.stop is None else correction.stop
        rows = np.flatnonzero((self.frames >= correction.first) & (self.frames < stop))
        if max(correction.sheets, default=0) >= sheets:
            raise InputError(correction.name, f"a sheet from 0 to {sheets - 1}", str(max(correction.sheets)))
        if correction.kind != "delete" and len(rows) < max(1, stop - correction.first):
            found = f"{correction.first}:{stop}"
            raise InputError(correction.name, f"frames within {self.frames[0]}:{end}", found)
        return rows

    def apply(self, correction: Correction) -> tuple[int, ...]:
        """Apply a correction of the sheets; return which sheets it concerns.

        Raises: InputError as `apply_corrections`. Nothing is changed then.
        """
        rows, sheets = self.rows_of(correction), correction.sheets
        match correction.kind:
            case "add":
                return (self._add(correction, int(rows[0])),)
            case "delete":
                if self.arrays["flag"].shape[1] == 1:
                    raise InputError(correction.name, "a sheet beside others", "the only one that is left")
                self.arrays = {name: np.delete(one, sheets[0], axis=1) for name, one in self.arrays.items()}
            case "swap":
                pair = list(sheets)
                for one in self.arrays.values():
                    one[rows[:, None], pair] = one[rows[:, None], pair[::-1]]
            case "leave_out":
                self.put(rows, sheets[0], np.full(len(rows), np.nan), Flag.LEFT_OUT)
            case "accept":
                rows = rows[self.arrays["flag"][rows, sheets[0]] == Flag.DOUBTFUL]
                if not len(rows):
                    raise InputError(correction.name, "a doubtful stretch to accept", "none in these frames")
                self.put(rows, sheets[0], self.arrays["withheld_px"][rows, sheets[0]], Flag.MISSING)
            case "assign":
                ridge_px, owner = self.follow(correction, rows, without=sheets[0])
                _check_free(correction, self.frames[rows], owner)
                self.put(rows, sheets[0], ridge_px, Flag.MISSING)
        return sheets

    def _add(self, correction: Correction, row: int) -> int:
        """Insert a sheet at its position among the others; return its index. It is "missing" in frames in
        which its ridge is lost or is another sheet's, and in all frames if the place is empty but has room
        for a sheet: n of the sheets further out needs one that is covered throughout the film."""
        others = self.arrays[self.position]
        frames = np.arange(len(others))
        ridge_px, owner = np.full(len(others), np.nan), np.full(len(others), -1)
        usual = others[row].astype(np.float64)
        unseen = np.isnan(usual)
        usual[unseen] = nan_median(others[:, unseen])
        at = float(correction.x_px or 0.0) - self.origin_px
        try:
            for rows in (frames[row:], frames[row::-1]):
                ridge_px[rows], owner[rows] = self.follow(correction, rows)
        except _NoRidgeNearError:
            if not self._has_room(usual, at):
                raise
        _check_free(correction, self.frames[[row]], owner[[row]])
        ridge_px[owner >= 0] = np.nan
        sheet = int((placed(usual) < (at if np.isnan(ridge_px[row]) else ridge_px[row])).sum())
        empty = {"flag": Flag.MISSING, "why": Doubt.NONE}
        self.arrays = {
            name: np.insert(one, sheet, empty.get(name, np.nan), axis=1) for name, one in self.arrays.items()
        }
        self.put(frames, sheet, ridge_px, Flag.MISSING)
        return sheet

    def _has_room(self, usual_px: Floats, at_px: float) -> bool:
        """Return whether one more sheet fits between those beside this place, with positions (N,), NaN of
        sheets that were added without any: spacings are then no narrower than those of a wide one halved."""
        known = np.flatnonzero(np.isfinite(usual_px))
        right = int(np.searchsorted(usual_px[known], at_px))
        if right in (0, len(known)):
            return False
        beside = known[[right - 1, right]]
        narrowest = self.comb.settings.wide_pitches / 2 * self.comb.pitch_px
        return bool(np.diff(usual_px[beside])[0] / (np.diff(beside)[0] + 1) > narrowest)


def _check_free(correction: Correction, frames: Ints, owner: Ints) -> None:
    """Refuse a ridge that is another sheet's in one of these frames."""
    if (owner >= 0).any():
        first = int((owner >= 0).argmax())
        found = f"sheet {owner[first]}'s in frame {frames[first]}"
        advice = "swap the two, or leave the other one out"
        raise InputError(correction.name, "a ridge that is no other sheet's", found, advice)


class _NoRidgeNearError(InputError):
    """No ridge is near the column that a correction names."""


class PossibleRidges(NamedTuple):
    """Ridges of which a correction may say that one is a sheet, in the same rows."""

    candidates: Ridges  # from `find_ridges`
    maxima: Ridges  # from `find_faint`, taken where no candidate is near


class _CorrectedDetections(Corrected):
    """Detections, in columns of the profile, whose first pixel lies at column `origin_px` of the picture."""

    def __init__(
        self,
        detections: Detections,
        ridges: PossibleRidges,
        comb: RidgeComb,
        frames: Ints,
        origin_px: float,
    ) -> None:
        arrays = {part.name: np.array(getattr(detections, part.name)) for part in fields(detections)}
        super().__init__(arrays, "start_px", frames, comb, origin_px)
        self.ridges = ridges

    def follow(self, correction: Correction, rows: Ints, without: int | None = None) -> tuple[Floats, Ints]:
        others = self.arrays["start_px"]
        return follow_ridge(
            correction, rows, others, self.ridges, self.comb, without=without, origin_px=self.origin_px
        )

    def measured(self, rows: Ints, sheet: int, ridge_px: Floats, otherwise: Flag) -> dict[str, Any]:
        ridges = self.ridges.maxima
        known, (best, _) = np.isfinite(ridge_px), nearest(ridges.x_px[rows], ridge_px)
        return {
            "start_px": ridge_px,
            "contrast": np.where(known, ridges.contrast[rows, best], np.nan),
            "fwhm_px": np.where(known, ridges.fwhm_px[rows, best], np.nan),
            "flag": np.where(known, Flag.OK, otherwise),
        }


def apply_corrections(
    detections: Detections,
    ridges: PossibleRidges,
    corrections: Sequence[Correction],
    comb: RidgeComb,
    *,
    frames: Ints,
    origin_px: float,
) -> Detections:
    """Return the detections with the manual corrections applied, in the order of `ordered`.

    frames: frame numbers in the film, (frame,). origin_px: column of the profile's first pixel in the
    picture. ridges: of every frame.

    Raises: InputError for a sheet or frames that do not exist, two entries about one sheet in one frame, no
    doubtful ridge to accept, or a ridge that does not exist or is another sheet's. The message names the
    entry.
    """
    wanted = ordered([one for one in corrections if one.kind in OF_SHEETS])
    if not wanted:
        return detections
    _check_unique(wanted)
    corrected = _CorrectedDetections(detections, ridges, comb, frames, origin_px)
    for correction in wanted:
        corrected.apply(correction)
    return replace(detections, **corrected.arrays)


def _check_unique(corrections: Sequence[Correction]) -> None:
    """Refuse two decisions about one sheet in one frame if neither has a date."""
    for i, one in enumerate(corrections):
        for other in corrections[:i]:
            shared = set(one.sheets) & set(other.sheets)
            apart = one.first >= (other.stop or np.inf) or other.first >= (one.stop or np.inf)
            if shared and not apart and not (one.date or other.date):
                found = f"sheet {min(shared)} in the same frames as in {other.name.rpartition(', ')[2]}"
                raise InputError(one.name, "one decision per sheet and frame", found)


def follow_ridge(
    correction: Correction,
    rows: Ints,
    others: Floats,
    ridges: PossibleRidges,
    comb: RidgeComb,
    *,
    without: int | None,
    origin_px: float,
) -> tuple[Floats, Ints]:
    """Follow a ridge from row to row, with the motion of the other sheets.

    In the first row it is the ridge nearest to the correction's x_px, a column of the picture, then the one
    nearest to where that motion moves it: of the candidates, or of all maxima where none of these is near.
    Return whole pixels, one per row, NaN where no ridge is near; and the sheet that has this ridge already,
    -1 for none. rows: rows of `others` and `ridges`, in the order in which the ridge is followed. others:
    whole pixels of the sheets, (frame, sheet). without: one to ignore.

    Raises: InputError if no ridge is near the column in the first row.
    """
    others = others[rows]
    if without is not None:
        others[:, without] = np.nan
    moved = np.nan_to_num(nan_median(np.diff(others, axis=0), axis=1))
    reach = comb.settings.faint_reach * comb.pitch_px
    travelled = np.concatenate([[0.0], np.cumsum(moved)])
    candidates, maxima = (one.x_px[rows] - travelled[:, None] for one in ridges)  # relative to the others
    x = np.full(len(rows), np.nan)
    at = float(correction.x_px or 0.0) - origin_px
    for k, row in enumerate(values.tolist() for values in candidates):
        best = _nearest(row, at)
        if not abs(best - at) <= reach:
            best = _nearest(maxima[k].tolist(), at)
        if abs(best - at) <= reach:
            at, x[k] = best, round(best + travelled[k])
        elif k == 0:
            seen = maxima[0][np.isfinite(maxima[0])]
            close = np.sort(seen[np.argsort(np.abs(seen - at))[:2]] + origin_px)
            places = " and ".join(f"{x_px:.0f}" for x_px in close)
            found = f"the nearest at {places}" if places else "none"
            raise _NoRidgeNearError(correction.name, f"a ridge near x_px = {correction.x_px:g}", found)
    taken = others == x[:, None]
    return x, np.where(taken.any(axis=1), taken.argmax(axis=1), -1)


def _nearest(row: list[float], at: float) -> float:
    """Return the nearest of ascending values, with NaN last; NaN for none."""
    after = bisect_left(row, at)
    return min(row[max(0, after - 1) : after + 1], key=lambda x: abs(x - at), default=np.nan)

"""A finished run for other programs: its tables in their formats, its film with the tracks drawn on it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pandas as pd
import xarray as xr
from numpy.typing import NDArray

from vision.data import MEASURED, SIDES, StripMetadata
from vision.errors import InputError
from vision.figures.style import HIGHLIGHT, ON_GREY, label_step, rgb
from vision.files import AGAIN, Progress, reading
from vision.folder import check_new, flattened, harmless, run_folder, whole_file, write_csv, write_json
from vision.memory import row_parts
from vision.numeric import Floats, Ints, Pixels, nan_median
from vision.run.reading import RunFolder, check_outside, check_results, first_column, read_json
from vision.run.tables import tracks_table
from vision.spacetime import grey_limits
from vision.video import Video, open_video
from vision.video.reader import OVERLAY_COMMENT

Format = Literal["csv", "xlsx", "parquet", "mat", "trackpy", "napari", "imagej"]
MARK = "export"  # key in run.json that distinguishes exported tables from a run

EXCEL_ROWS = (1 << 20) - 1  # that a worksheet holds below the header
CELL_ROWS_AT_ONCE = 50_000  # converted to cells, so that memory does not grow with the recording


def export_run(
    run: RunFolder, to: Format, *, out: Path | None = None, overwrite: bool = False
) -> tuple[Path, list[str]]:
    """Write a run's tables for another program: a folder for csv and parquet, else one file.

    out: file (.xlsx is added to a workbook's name without it) or folder; by default the run's name with the
    format's suffix in the working directory.

    Returns: the file or folder that was written, and notes on what was left out.
    Raises: InputError for a target that exists (without overwrite), lies in the run itself, is another run or
    cannot be written; or for a run without the data that are exported.
    """
    ending, write = FILES.get(to, (f"_{to}", None))
    target = out or Path(f"{run.name}{ending}")
    if to == "xlsx" and target.suffix.lower() != ".xlsx" and not target.is_dir():  # or no program opens it
        target = target.with_name(f"{target.name}.xlsx")
    check_outside(target, run.folder)
    with reading(run.folder, "a run folder as track writes it", AGAIN):  # tables are read and checked here
        parts = "positions in parts of the strip are left out: tracks.nc and a mat export hold them"
        notes = [parts] if to != "mat" and run.of_video and "x_z_px" in run.tracks else []
        turned = StripMetadata.of(run.tracks).rotate if to in ("trackpy", "napari") else 0
        if turned:
            notes.append(f"x and y are those of the frames turned clockwise by {turned} degrees (`rotate`)")
        if write is None:
            _write_folder(run, to, target, overwrite=overwrite)
            return target, notes
        if target.is_dir():
            raise InputError(target, "a file to write", "a folder", "give another `out`")
        check_new(target, overwrite=overwrite)
        with whole_file(target) as path:
            return target, [*(write(run, path) or ()), *notes]


def _write_folder(run: RunFolder, to: Format, target: Path, *, overwrite: bool) -> None:
    check_results(target, overwrite=overwrite, mark=MARK)
    tables = all_tables(run)
    rows = {name: len(table) for name, table in tables.items()}
    facts = {**run.facts, MARK: {"to": to, "from": str(run.folder), "rows": rows}}
    with run_folder(target, overwrite=overwrite) as folder:
        for name, table in tables.items():
            if to == "csv":
                write_csv(table, folder / f"{name}.csv", digits=None)
            else:
                table.to_parquet(folder / f"{name}.parquet", engine="pyarrow", index=False)
        write_json(facts, folder / "run.json")


def all_tables(run: RunFolder) -> dict[str, pd.DataFrame]:
    """Return all tables that a run has, by name.

    tracks: one row per frame and sheet. positions: x with one row per frame and one column per sheet, called
    side_n_unit. sheets, events, deformation, shells: as in the run folder. settings: the content of run.json,
    clock.json and models.json. The unit is the last part of a column's name. Positions that were not measured
    are NaN; their flag says why.
    """
    tables: dict[str, pd.DataFrame] = {}
    if run.of_video:
        size = run.pixel_size_um
        tables["tracks"] = tracks_table(run.tracks, pixel_size_um=size)
        tables["positions"] = positions_table(run.tracks, pixel_size_um=size)
    return tables | run.tables | {"settings": settings_table(run)}


def positions_table(tracks: xr.Dataset, *, pixel_size_um: float | None) -> pd.DataFrame:
    """Return x(n, t), one row per frame: frame, time_s, then one column per sheet from left to right.

    Columns are called left_3_um, right_23_um, or …_px if the pixel size is not known.
    """
    unit, scale = ("px", 1.0) if pixel_size_um is None else ("um", pixel_size_um)
    sheets = zip(tracks["side"].values.tolist(), tracks["n"].values.tolist(), strict=True)
    names = [f"{SIDES[side]}_{n}_{unit}" for side, n in sheets]
    table = pd.DataFrame((tracks["x_px"].values * scale).round(4), columns=names)
    table.insert(0, "frame", tracks["frame"].values)
    table.insert(1, "time_s", tracks["time_s"].values.round(9))
    return table


def trackpy_table(run: RunFolder) -> pd.DataFrame:
    """Return the tracks as trackpy expects them: x, y, frame, particle and ep in px; also time_s, side and n.

    particle is the sheet's index from the left, ep the standard error of x, and y the middle of the strip.
    Positions that were not measured are left out, as trackpy accepts no NaN.
    """
    table, strip = tracks_table(run.tracks), StripMetadata.of(run.tracks)
    table = table.rename(columns={"x_px": "x", "x_err_px": "ep", "index": "particle"})
    table["y"] = (strip.strip_z0 + strip.strip_z1 - 1) / 2
    names = ["x", "y", "frame", "particle", "ep", "time_s", "side", "n"]
    return table.loc[table["flag"].isin(MEASURED), names].reset_index(drop=True)


def napari_table(run: RunFolder) -> pd.DataFrame:
    """Return the tracks for napari's tracks layer: track_id, t (frame number), y, x in px, track by track.

    y is the middle of the strip. Positions that were not measured are left out.
    """
    table = trackpy_table(run).rename(columns={"particle": "track_id", "frame": "t"})
    return table[["track_id", "t", "y", "x"]].sort_values(["track_id", "t"], ignore_index=True)


def write_rois(run: RunFolder, path: Path) -> None:
    """Write each sheet's track as polylines on kymograph.tif, for the ROI manager of Fiji and ImageJ.

    They are called right_23, or right_23_2 and so on after a gap. x is the diagram's column, y its row; whole
    coordinates are the middles of pixels, as in ImageJ for lines. Left sheets are blue, right ones orange.
    """
    import roifile

    tracks, start = run.tracks, first_column(run)
    rois = []
    sides, numbers, curves = tracks["side"].values.tolist(), tracks["n"].values, tracks["x_px"].values.T
    for side, n, x in zip(sides, numbers, curves - start, strict=True):
        name = f"{SIDES[side]}_{n}"
        known = np.flatnonzero(np.isfinite(x))
        stretches = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1) if known.size else []
        for k, rows in enumerate(stretches, 1):
            label = name if k == 1 else f"{name}_{k}"
            roi = roifile.ImagejRoi.frompoints(np.stack([x[rows], rows], axis=1), name=label)
            roi.roitype = roifile.ROI_TYPE.POLYLINE if rows.size > 1 else roifile.ROI_TYPE.POINT
            roi.stroke_color = bytes((255, *rgb(ON_GREY[side][0])))
            rois.append(roi)
    roifile.roiwrite(path, rois, mode="w")


def settings_table(run: RunFolder) -> pd.DataFrame:
    """Return name and value as text of all entries of the run's JSON files; nested names have dots."""
    facts = dict(run.facts)
    for name in ("clock", "models"):
        path = run.folder / f"{name}.json"
        if path.exists():
            facts[name] = read_json(path)
    pairs = [
        (name, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))
        for name, value in flattened(facts, ".")
    ]
    return pd.DataFrame(pairs, columns=["name", "value"], dtype=str)


def write_xlsx(tables: Mapping[str, pd.DataFrame], path: Path) -> list[str]:
    """Write one worksheet per table, with a frozen header; missing values are empty cells.

    Returns notes on what was left out: tracks, if it has more rows than a worksheet holds; its positions are
    also in the wide table.

    Raises: InputError if any other table is too long.
    """
    import openpyxl

    long = [name for name, table in tables.items() if len(table) > EXCEL_ROWS]
    if long not in ([], ["tracks"]):
        rows = len(tables[long[-1]])
        found = f"{rows} in {long[-1]}"
        raise InputError(path, f"at most {EXCEL_ROWS} rows", found, "use parquet, csv or mat")
    book = openpyxl.Workbook(write_only=True)
    for name, table in tables.items():
        if name not in long:
            _write_sheet(book, name, table)
    book.save(path)
    return [f"{name}: {len(tables[name])} rows are more than a worksheet holds; left out" for name in long]


def _write_sheet(book: Any, name: str, table: pd.DataFrame) -> None:
    from openpyxl.cell import WriteOnlyCell
    from openpyxl.styles import Font

    sheet = book.create_sheet(name)
    sheet.freeze_panes = "A2"
    header = [WriteOnlyCell(sheet, value=harmless(str(column))) for column in table.columns]
    for cell in header:
        cell.font = Font(bold=True)
    sheet.append(header)
    for row in _cells(table):
        sheet.append(row)


def _cells(table: pd.DataFrame) -> Iterator[tuple[Any, ...]]:
    """Yield the rows of a table as Excel can store them."""
    for rows in row_parts(len(table), CELL_ROWS_AT_ONCE):
        part = table.iloc[rows]
        columns = [_column(part[name]) for name in part.columns]
        yield from zip(*columns, strict=True)


def _column(column: pd.Series[Any]) -> pd.Series[Any]:
    """Convert NaN and empty text to None, infinity to text, and remove control characters from text."""
    from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE

    cells = column.astype(object).where(column.notna(), None)
    if column.dtype.kind == "f":
        return cells.mask(np.isinf(column), column.astype(str))
    if column.dtype.kind in "iub":
        return cells

    def as_stored(cell: Any) -> Any:
        return harmless(ILLEGAL_CHARACTERS_RE.sub("", cell)) or None if isinstance(cell, str) else cell

    return cells.map(as_stored)


def write_mat(run: RunFolder, path: Path) -> None:
    """Write a MATLAB 5 file: x_px, x_err_px, x_um and flag (frames × sheets), with their coordinates.

    frame and time_s are columns; index, side and n are rows. Positions that were not measured are NaN; flag
    is an index from 1 into flag_names. Positions in parts of the strip are x_z_px and x_z_err_px (frames ×
    sheets × parts), at the rows z. sheets, events, deformation, shells and settings are structs with one
    field per column. x_um is NaN if the pixel size is not known.
    """
    from scipy.io import savemat

    content: dict[str, Any] = {}
    if run.of_video:
        content = _matrices(run.tracks, np.nan if run.pixel_size_um is None else run.pixel_size_um)
    tables = run.tables | {"settings": settings_table(run)}
    content |= {name: _struct(table) for name, table in tables.items()}
    savemat(path, content, appendmat=False, long_field_names=True, do_compression=True)


def _matrices(tracks: xr.Dataset, pixel_size_um: float) -> dict[str, Any]:
    """Return x(n, t) and its coordinates, with numbers as doubles."""
    x = tracks["x_px"].values
    names, codes = np.unique(tracks["flag"].values, return_inverse=True)
    parts = {
        name: tracks[name].values.astype(np.float64)
        for name in ("x_z_px", "x_z_err_px", "z")
        if name in tracks.variables
    }
    return parts | {
        "x_px": x,
        "x_err_px": tracks["x_err_px"].values,
        "x_um": x * pixel_size_um,
        "pixel_size_um": pixel_size_um,
        "flag": (codes.reshape(x.shape) + 1).astype(np.uint8),
        "flag_names": names.astype(object)[None],
        "frame": tracks["frame"].values.astype(np.float64)[:, None],
        "time_s": tracks["time_s"].values[:, None],
        "index": tracks["sheet"].values.astype(np.float64)[None],
        "side": tracks["side"].values.astype(np.float64)[None],
        "n": tracks["n"].values.astype(np.float64)[None],
    }


def _struct(table: pd.DataFrame) -> dict[str, Any]:
    """Return the columns of a table: numbers as doubles, text as cells."""
    struct = {}
    for name, column in table.items():
        is_number = column.dtype.kind in "iufb"
        cells = column.to_numpy(np.float64) if is_number else column.fillna("").astype(str).to_numpy(object)
        struct[str(name)] = cells[:, None]
    return struct


FILES: dict[str, tuple[str, Callable[[RunFolder, Path], list[str] | None]]] = {
    "xlsx": (".xlsx", lambda run, path: write_xlsx(all_tables(run), path)),
    "mat": (".mat", write_mat),
    "trackpy": ("_trackpy.csv", lambda run, path: write_csv(trackpy_table(run), path, digits=None)),
    "napari": ("_napari.csv", lambda run, path: write_csv(napari_table(run), path, digits=None)),
    "imagej": ("_rois.zip", write_rois),
}
"""Formats of a single file: the end of its name, and a function that writes it and may return notes on what
was left out. The other formats are folders of tables."""


# --- the film with its tracks -------------------------------------------------------------------------------

Colour = NDArray[np.uint8]
MARGIN = 22  # px above the picture for the numbers, and below it for frame and time
LETTER_WIDTH = 9.0  # px of a digit at the size in use
_WHITE = (235, 235, 235)


def write_overlay(
    run: RunFolder, film: Path, target: Path, *, frames: slice | None = None, progress: Progress | None = None
) -> tuple[int, tuple[int, int], float]:
    """Write a film with marks at every sheet: strokes at both ends of the strip, and the number n above.

    One frame is in memory at a time. The same grey levels are black and white in every frame. Sheets left
    of the axis are blue, right ones orange; positions with a flag other than "ok" are white. Frames without a
    picture are black and show their status.

    film: as `RunFolder.input` returns it.  frames: half-open range of frame numbers; all by default.
    progress: called with (frames done, total frames or None).
    Returns: number of frames written, their shape (rows, columns), and frames per second.
    Raises: InputError if the film cannot be read, or holds none of these frames.
    """
    import av  # takes 30 ms, and only this export needs it

    tracks = run.tracks
    video = open_video(film, rotate=StripMetadata.of(tracks).rotate, frames=_within(tracks, frames, run))
    canvas = _Canvas.of(video, tracks)
    row_of = {int(number): row for row, number in enumerate(tracks["frame"].values)}
    # A high-speed film is played in slow motion, a time lapse faster than it was recorded.
    shown = float(np.clip(np.nan_to_num(StripMetadata.of(tracks).fps, nan=25.0), 5.0, 50.0))
    fps = Fraction(shown).limit_denominator(1000)
    quality = {"crf": "23", "preset": "veryfast", "maxrate": "8M", "bufsize": "16M"}
    done = 0
    with av.open(str(target), "w", format="mp4") as file:
        file.metadata["comment"] = OVERLAY_COMMENT
        stream: Any = file.add_stream("libx264", rate=fps, options=quality)
        stream.height, stream.width = canvas.shape
        stream.pix_fmt = "yuv420p"
        for block in video.blocks():
            for k, status in enumerate(block.status):
                row = row_of.get(block.start + k)
                if row is None:
                    continue
                picture = canvas.draw(block.pixels[k] if status == "ok" else None, row)
                file.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "rgb24")))
                done += 1
            if progress is not None:
                progress(done, video.estimated)
        if done:
            file.mux(stream.encode(None))
    if not done:
        raise InputError(film, "frames within `frames`", "none of the run's")
    return done, canvas.shape, float(fps)


def _within(tracks: xr.Dataset, frames: slice | None, run: RunFolder) -> slice:
    """Return the frames of the run that are to be drawn.  Raises: InputError if there are none."""
    numbers = tracks["frame"].values
    first, last = int(numbers[0]), int(numbers[-1]) + 1
    start, stop = (frames.start or first, frames.stop or last) if frames else (first, last)
    part = slice(max(start, first), min(stop, last))
    if part.start >= part.stop:
        raise InputError("`frames`", f"a part of {first}:{last}, those of {run.folder}", f"{start}:{stop}")
    return part


@dataclass(frozen=True)
class _Canvas:
    """Geometry and grey levels of the frames of an overlay."""

    tracks: xr.Dataset
    x_px: Floats  # (frame, sheet)
    scale: float  # pixels of the MP4 per pixel of the film
    picture: tuple[int, int]  # rows and columns of the film in the MP4
    low: float  # grey levels that are drawn black and white
    high: float

    @classmethod
    def of(cls, video: Video, tracks: xr.Dataset) -> _Canvas:
        rows, columns = video.shape
        scale = min(1.0, 1920 / columns, 1080 / rows)  # players show no more pixels
        if max(rows, columns) < 480:  # enlarge by a whole factor, or the numbers cover the picture
            scale = float(-(-480 // max(rows, columns)))
        low, high = grey_limits(*(np.asarray(frame, np.float32) for frame in video.sample(8)))
        picture = (max(2, round(rows * scale)), max(2, round(columns * scale)))
        x_px = np.asarray(tracks["x_px"].values, np.float64)
        return cls(tracks, x_px, scale, picture, low, high)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the MP4, both even as libx264 demands."""
        height, width = self.picture
        height, width = height + 2 * MARGIN, max(width, 240)  # room for the line of text below
        return height + height % 2, width + width % 2

    def draw(self, pixels: Pixels | None, row: int) -> Colour:
        """Return a frame with all marks, RGB; `row` is its row in the tracks."""
        canvas = np.zeros((*self.shape, 3), np.uint8)
        flag = np.asarray(self.tracks["flag"].values[row])
        state = f" {flag[0]}"
        if pixels is not None:
            state, (height, width) = "", self.picture
            grey = (np.asarray(pixels, np.float32) - self.low) * (255 / (self.high - self.low))
            grey = np.clip(np.nan_to_num(grey), 0, 255).astype(np.uint8)
            how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_NEAREST
            shown = cv2.resize(grey, (width, height), interpolation=how)
            canvas[MARGIN : MARGIN + height, :width] = shown[..., None]
            self._mark(canvas, row, flag)
        time_s = float(self.tracks["time_s"].values[row])
        when = f"{time_s:.4g} s  " if np.isfinite(time_s) else ""
        found = f"{(flag == 'ok').sum()} of {flag.size} sheets{state}"
        _write(canvas, f"frame {self.tracks['frame'].values[row]}  {when}{found}", 4, canvas.shape[0] - 6)
        return canvas

    def _mark(self, canvas: Colour, row: int, flag: NDArray[np.str_]) -> None:
        """Draw the edges of the strip, strokes at them, and the numbers above the picture."""
        strip = StripMetadata.of(self.tracks)
        top, bottom = self._y(strip.strip_z0 - 0.5), self._y(strip.strip_z1 - 0.5)
        for edge in (top, bottom):
            self._line(canvas, (0.0, edge), (self.picture[1] - 1.0, edge), rgb(HIGHLIGHT))
        stroke = max(3.0, (bottom - top) / 4)  # leaves the middle of the ridge visible
        side, n = self.tracks["side"].values, self.tracks["n"].values
        seen, numbered = np.flatnonzero(np.isfinite(self.x_px[row])), set(self._numbered(n))
        for k in seen:
            x = self._x(self.x_px[row, k])
            own = rgb(ON_GREY[int(side[k])][0])
            ink = own if flag[k] == "ok" else _WHITE
            self._line(canvas, (x, top), (x, top + stroke), ink)
            self._line(canvas, (x, bottom), (x, bottom - stroke), ink)
            if k in numbered:
                text = str(n[k])
                _write(canvas, text, x - LETTER_WIDTH * len(text) / 2, MARGIN - 7, own)

    def _numbered(self, n: Ints) -> Ints:
        """Return the sheets that get a number: all, or every second, fifth, …, so that none overlap."""
        middle = nan_median(self.x_px) * self.scale
        room = LETTER_WIDTH * (len(str(int(n.max(initial=1)))) + 0.6)
        every = label_step(middle[np.isfinite(middle)], room)
        return np.flatnonzero(n % every == 0) if every > 1 else np.arange(n.size)

    def _x(self, x_px: float) -> float:
        """Return the column in the MP4; pixel centres are at integers in both."""
        return float((x_px + 0.5) * self.scale - 0.5)

    def _y(self, z_px: float) -> float:
        return float((z_px + 0.5) * self.scale - 0.5 + MARGIN)

    @staticmethod
    def _line(canvas: Colour, start: tuple[float, float], end: tuple[float, float], ink: Any) -> None:
        bits = 4  # fractional bits of OpenCV's coordinates: strokes are positioned to 1/16 px
        fixed = [tuple(round(v * (1 << bits)) for v in point) for point in (start, end)]
        cv2.line(canvas, fixed[0], fixed[1], ink, 1, cv2.LINE_AA, bits)


def _write(canvas: Colour, text: str, x: float, y: float, ink: tuple[int, int, int] = _WHITE) -> None:
    cv2.putText(canvas, text, (round(x), round(y)), cv2.FONT_HERSHEY_SIMPLEX, 0.42, ink, 1, cv2.LINE_AA)

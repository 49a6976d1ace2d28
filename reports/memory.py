"""Memory at growing numbers of frames, for every format that is read, and for the whole command.

Run from the checkout: python -m reports.memory [--folder /tmp/films] [--most 16000]. Takes eight minutes and
some GB of disk. Writes reports/memory.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import tifffile

from reports.writing import head, row, write_report
from tests.scenes.comb_video import frames_of, positions
from tests.scenes.films import avi_header
from vision.experiment import Experiment, with_settings
from vision.experiment.scene import frame_times
from vision.experiment.settings import Camera
from vision.experiment.simulate import write_video
from vision.numeric import Pixels
from vision.video import VideoSettings

ROWS, COLUMNS = 800, 1280
STRIP = (360, 440)
GOP = 24  # frames that are encoded; longer films repeat them
WHOLE = (25_000, 100_000)  # frames for the whole command
SHEETS, WIDTH, HEIGHT = 24, 600, 24  # of these films
RUNS = {
    "raw, `--no-report`": ("raw", WHOLE, "--no-report"),
    "raw, with the report": ("raw", WHOLE, ""),
    "raw, `--strips 4`": ("raw", WHOLE[:1], "--strips 4"),
    "raw, `--force`": ("raw", WHOLE, "--force FORCE --d0 13 --offset 0 --pixel-size 10"),
    "MJPEG, with the report": ("mjpeg", WHOLE[1:], ""),
    "H.264, with the report": ("h264", WHOLE[1:], ""),
}
"""Container of `write_video`, numbers of frames, and options of the whole command."""
MIB = 1 << 20

PEAK = """
import json, sys
def peak():  # of this program alone; getrusage counts what its parent had as it was forked
    lines = open("/proc/self/status").read().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("VmHWM"))) << 10
"""
COMMAND = """
from vision.command.main import main
try:
    main(sys.argv[1:])
except SystemExit as ended:
    print(json.dumps([ended.code, peak()]))
"""
CHILD = """
from vision.video import VideoSettings, open_video, strip_profile
path, first, last = json.loads(sys.argv[1])
before = peak()
strip = strip_profile(open_video(path), slice(first, last))
in_memory = strip.nbytes if strip.nbytes <= VideoSettings.spill_bytes else 0
print(json.dumps([strip.sizes["frame"], in_memory, before, peak()]))
"""


def pictures() -> Pixels:
    """Return a few frames of a moving comb."""
    profile = frames_of(positions(frames=GOP, sheets=50), width_px=COLUMNS, rows=1)
    return np.ascontiguousarray(np.repeat(profile, ROWS, axis=1))


def raw_avi(path: Path, frames: int, shown: Pixels) -> None:
    """Write a sparse file: the first frames, and only the chunk headers of the others."""
    rows, columns = shown.shape[1:]
    head = avi_header(width=columns, height=rows, bits=8, fourcc=b"Y800", frames=frames)
    size = rows * columns
    with path.open("wb") as out:
        out.write(b"RIFF" + struct.pack("<I", 0) + b"AVI " + head + b"LIST" + struct.pack("<I", 0) + b"movi")
        start = out.tell()
        for n in range(frames):
            out.seek(start + n * (size + 8))
            stored = shown[n].tobytes() if n < len(shown) else b""
            out.write(b"00dc" + struct.pack("<I", size) + stored)
        out.truncate(start + frames * (size + 8))


def mraw(path: Path, frames: int, shown: Pixels, bits: int) -> None:
    """Write a sparse file that contains the first frames."""
    rows, columns = shown.shape[1:]
    fields = {"Total Frame": frames, "Image Width": columns, "Image Height": rows, "Color Bit": bits}
    text = "".join(f"{name} : {value}\n" for name, value in fields.items())
    path.with_suffix(".cih").write_text(f"Record Rate(fps) : 1000\n{text}")
    stored = shown if bits == 8 else np.repeat(shown, 3, axis=2)[:, :, : columns * 3 // 2]
    path.write_bytes(stored.tobytes())
    os.truncate(path, frames * rows * columns * bits // 8)


def cine(path: Path, frames: int, shown: Pixels) -> None:
    """Write a sparse file: the first frames, and only the headers of the others."""
    rows, columns = shown.shape[1:]
    setup = bytearray(2000)
    struct.pack_into("<H", setup, 142, len(setup))
    struct.pack_into("<I", setup, 896, 8)
    images_at, size = 84 + len(setup), rows * columns + 8
    first = images_at + 8 * frames
    head = struct.pack("<2sHHHiIiIIII8x", b"CI", 44, 0, 1, 0, frames, 0, frames, 44, 84, images_at)
    bitmap = struct.pack("<IiiHHIIiiII", 40, columns, rows, 1, 8, 0, rows * columns, 0, 0, 0, 0)
    with path.open("wb") as out:
        out.write(head + bitmap + bytes(setup))
        out.write((first + size * np.arange(frames, dtype="<i8")).tobytes())
        for n in range(frames):
            out.seek(first + n * size)
            out.write(struct.pack("<II", 8, rows * columns) + (shown[n].tobytes() if n < len(shown) else b""))
        out.truncate(first + frames * size)


def stack(path: Path, frames: int, shown: Pixels) -> None:
    """Write a sparse file with one page that represents all."""
    pages = tifffile.memmap(path, shape=(frames, *shown.shape[1:]), dtype=np.uint8, bigtiff=True)
    pages[: len(shown)] = shown
    del pages


def compressed_stack(path: Path, frames: int, shown: Pixels) -> None:
    """Write one compressed page for every frame."""
    with tifffile.TiffWriter(path, bigtiff=True) as out:
        for n in range(frames):
            out.write(shown[n % len(shown)], compression="zlib", photometric="minisblack", metadata=None)


def images(path: Path, frames: int, shown: Pixels) -> None:
    """Write a folder of PNG files, most of which are links to the same file."""
    path.mkdir()
    for n in range(frames):
        file = path / f"a_{n:06d}.png"
        if n < len(shown):
            cv2.imwrite(str(file), shown[n])
        else:
            os.link(path / f"a_{n % len(shown):06d}.png", file)


def encoded(path: Path, frames: int, shown: Pixels, codec: str, pixel_format: str) -> None:
    """Encode a few frames and write their packets repeatedly."""
    options = {"g": str(GOP), "preset": "veryfast"} if codec == "libx264" else {}
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=100, options=options)
        stream.height, stream.width, stream.pix_fmt = *shown.shape[1:], pixel_format
        stream.codec_context.gop_size = GOP
        packets = []
        for picture in (*shown, None):
            frame = None if picture is None else av.VideoFrame.from_ndarray(picture, format="gray")
            packets += list(stream.encode(frame))
        step = int(1 / (stream.time_base * 100)) if stream.time_base else 1
        shifts = {id(packet): (packet.pts, packet.dts) for packet in packets}
        for turn, packet in itertools.product(range(-(-frames // len(shown))), packets):
            pts, dts = shifts[id(packet)]
            again = av.Packet(bytes(packet))
            again.stream, again.is_keyframe, again.time_base = stream, packet.is_keyframe, packet.time_base
            again.pts, again.dts = (None if t is None else t + turn * len(shown) * step for t in (pts, dts))
            out.mux(again)


FORMATS: dict[str, tuple[str, Callable[[Path, int, Pixels], None], int]] = {
    "raw AVI": ("a.avi", raw_avi, 1),
    "cine": ("a.cine", cine, 1),
    "mraw, 8 bit": ("a.mraw", lambda *given: mraw(*given, 8), 1),
    "mraw, 12 bit packed": ("a.mraw", lambda *given: mraw(*given, 12), 1),
    "TIFF stack": ("a.tif", stack, 1),
    "TIFF pages, deflate": ("a.tif", compressed_stack, 8),
    "folder of PNG": ("images", images, 8),
    "MJPEG in AVI": ("a.avi", lambda *given: encoded(*given, "mjpeg", "yuvj420p"), 1),
    "H.264 in MKV": ("a.mkv", lambda *given: encoded(*given, "libx264", "yuv420p"), 8),
    "FFV1 in MKV": ("a.mkv", lambda *given: encoded(*given, "ffv1", "gray"), 8),
}
"""File, writer, and the factor by which fewer frames than of raw film are read, since decoding is slow."""


def read(path: Path) -> tuple[int, int, int, int]:
    """Return frames, bytes of I(x, t) in memory, and the peak memory before and after reading, bytes."""
    task = json.dumps([str(path), *STRIP])
    done = subprocess.run(
        [sys.executable, "-c", PEAK + CHILD, task], capture_output=True, text=True, check=True
    )
    frames, profile, before, after = json.loads(done.stdout)
    return frames, profile, before, after


def formats(folder: Path, most: int) -> list[str]:
    """Return a row per format and number of frames."""
    shown, rows = pictures(), []
    for name, (file, write, fewer) in FORMATS.items():
        peaks = []
        for frames in (most // 16 // fewer, most // 4 // fewer, most // fewer):
            write(folder / file, frames, shown)
            found, profile, before, after = read(folder / file)
            peaks.append((found, (after - before - profile) / MIB))
            shutil.rmtree(folder / file) if (folder / file).is_dir() else (folder / file).unlink()
        rows.append(row([name, *(f"{beyond:.0f} MiB ({found})" for found, beyond in peaks)]))
        sys.stdout.write(rows[-1] + "\n")
        sys.stdout.flush()
    return rows


def force(path: Path, frames: int) -> None:
    """Write the force of a test in which the sheets slip every 20 frames, at 25 frames a second."""
    time_s = np.arange(0, frames / 25, 0.02)
    noise = np.random.default_rng(0).normal(0, 0.05, time_s.size)
    table = np.stack([0.01 * time_s, 20 + 5 * (time_s / 0.8 % 1) + noise, time_s], axis=1)
    head = "Crosshead\tLoad\tTime\nmm\tN\ts"
    np.savetxt(path, table, fmt="%.5f", delimiter="\t", header=head, comments="")


def noisy(frames: int) -> Iterator[Pixels]:
    """Yield frames (1, rows, columns) of sheets that slip every 20 frames, each with noise of its own, as a
    camera's have."""
    clean = frames_of(positions(frames=60, sheets=SHEETS), width_px=WIDTH, rows=1, noise=0).astype(np.int16)
    noise = np.random.default_rng(1).normal(0, 1.5, 1 << 25).round().astype(np.int16)
    for n in range(frames):
        start = 10_007 * n % (noise.size - HEIGHT * WIDTH)  # another one for each frame
        of_frame = noise[start : start + HEIGHT * WIDTH].reshape(HEIGHT, WIDTH)
        yield (clean[n % len(clean)] + of_frame).clip(0, 255).astype(np.uint8)[None]


def whole(folder: Path) -> list[str]:
    """Return the peak memory of the whole command with each of the options, imports included."""
    rows, load = [], folder / "force.txt"
    size = {
        "camera.width": WIDTH,
        "camera.height": HEIGHT,
        "camera.strip_rows": HEIGHT,
        "sheets.count": SHEETS,
    }
    for name, (container, lengths, options) in RUNS.items():
        for frames in lengths:
            test = with_settings(Experiment(), {**size, "camera.duration_s": frames / Camera.fps})
            film = write_video(folder, noisy(frames), test.camera, frame_times(test), container=container)
            force(load, frames)
            words = [str(film), "--quiet", "--overwrite", "--out", str(folder / "out")]
            words += [str(load) if word == "FORCE" else word for word in options.split()]
            child = [sys.executable, "-c", PEAK + COMMAND, *words]
            done = subprocess.run(child, capture_output=True, text=True, check=True)
            peak = json.loads(done.stdout.splitlines()[-1])[1] / MIB
            strip = 4 * WIDTH * frames / MIB * (5 if "--strips" in options else 1)
            cells = [name, frames, f"{peak:.0f} MiB", f"{strip:.0f} MiB"]
            rows.append(row(cells))
            sys.stdout.write(rows[-1] + "\n")
            sys.stdout.flush()
            film.unlink()
    return rows


def main() -> None:
    """Measure and write reports/memory.md."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--most", type=int, default=16_000)
    given = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="memory-", dir=given.folder))
    lines = [
        "# Memory",
        "",
        "Peak of the resident memory beyond that of the imports and, where it is in memory, of",
        f"I(x, t), for films of {COLUMNS} x {ROWS} px of which rows {STRIP[0]} to {STRIP[1]} are",
        f"averaged; in brackets the frames. {os.cpu_count()} cores, Python {platform.python_version()}.",
        "It fills what is read ahead, four blocks of 4 MiB and up to 32 whole frames, and stays there",
        "however long the film is.",
        "",
        *head(["format", "few frames", "four times as many", "sixteen times"]),
        *formats(folder, given.most),
        "",
        "I(x, t) itself, 4 bytes a column and frame, is in memory up to",
        f"{VideoSettings.spill_bytes // MIB} MiB (`VideoSettings.spill_bytes`) and, beyond, in a",
        "temporary file beside the run folder where `track` reads the film. Of the file, only the part in",
        "use is in memory.",
        "",
        f"The whole command, films of {WIDTH} x {HEIGHT} px with {SHEETS} sheets, whose frames have noise of",
        "their own; peak of all of the process, imports included. Where I(x, t) is in a temporary file, so",
        "are the tables of positions, of 4 or 8 bytes a frame and sheet, of which a few are in memory at a",
        "time. With `--force` the sheets slip every 20 frames, 5000 times in 100000.",
        "",
        *head(["film, options", "frames", "peak", "I(x, t), on disk"]),
        *whole(folder),
    ]
    shutil.rmtree(folder)
    write_report("memory", lines)


if __name__ == "__main__":
    main()

"""Small files of every kind that is read, made on the fly: what the mutations start from."""

import struct
from pathlib import Path

import cv2
import h5py
import numpy as np
import openpyxl
import tifffile
from scipy.io import savemat

from tests.scenes.films import comb, write_avi, write_encoded

FORCE_ROWS = 60


def write_seeds(folder: Path) -> dict[str, list[Path]]:
    """Files by the structure that mutations know."""
    frames = comb(8, 12, 50)
    return {
        "riff": _riff(folder, frames),
        "tiff": _tiff(folder, frames),
        "mp4": [_film(folder / f"h264{end}", frames, "libx264", "yuv420p") for end in (".mp4", ".mov")],
        "matroska": [
            _film(folder / "ffv1.mkv", frames, "ffv1", "gray"),
            _film(folder / "h264.mkv", frames, "libx264", "yuv420p"),
            _film(folder / "vp8.webm", frames, "libvpx", "yuv420p"),
        ],
        "png": [
            _image(folder / "a_0001.png", frames),
            _image(folder / "b_0001.png", frames.astype(np.uint16)),
        ],
        "bytes": [
            *(_image(folder / f"a_0001{end}", frames) for end in (".jpg", ".bmp")),
            _film(folder / "a.y4m", frames, "rawvideo", "gray"),
            _film(folder / "a.ts", frames, "mpeg2video", "yuv420p"),
            _film(folder / "a.gif", frames, "gif", "gray"),
            _film(folder / "a.flv", frames, "flv", "yuv420p"),
            _film(folder / "packed.nut", frames, "rawvideo", "yuyv422"),
        ],
        "photron": [_photron(folder / "photron", frames), _photron(folder / "photron_xml", frames, xml=True)],
        "images": [
            _images(folder / "images_png", frames, ".png"),
            _images(folder / "images_tif", frames, ".tif"),
        ],
        "cine": [_cine(folder / "a.cine", frames)],
        "mat": [_mat(folder / "v5.mat")],
        "hdf5": [_mat73(folder / "v73.mat")],
        "text": _text(folder),
        "xlsx": [_workbook(folder / "a.xlsx")],
        "times": [_times(folder / "times.txt", len(frames))],
    }


def _riff(folder: Path, frames) -> list[Path]:
    wide = np.arange(256, dtype=np.uint8)
    palette = np.stack([wide, wide, wide, wide * 0], axis=1).tobytes()
    raw = write_avi(folder / "y800.avi", frames, drop=(3,))
    plain = write_avi(
        folder / "palette.avi", frames, fourcc=bytes(4), palette=palette, bottom_up=True, pad=True, segments=2
    )
    colour = np.stack([frames, frames // 2, 255 - frames], axis=-1)
    bgr = write_avi(folder / "bgr.avi", colour, bits=24, fourcc=bytes(4), bottom_up=True, pad=True)
    return [raw, plain, bgr, _film(folder / "mjpeg.avi", frames, "mjpeg", "yuvj420p")]


def _tiff(folder: Path, frames) -> list[Path]:
    made = {
        "pages.tif": {},
        "lzw.tif": {"compression": "lzw"},
        "deflate.tif": {"compression": "zlib", "predictor": True},
        "big.tif": {"bigtiff": True},
        "tiles.tif": {"tile": (16, 16)},
        "motorola.tif": {"byteorder": ">"},
        "imagej.tif": {"imagej": True, "metadata": {"axes": "TYX", "finterval": 0.02}},
        "planes.tif": {"photometric": "rgb", "planarconfig": "separate"},
        "alpha.tif": {"planarconfig": "contig", "extrasamples": ["unassalpha"], "compression": "zlib"},
        "stack.ome.tif": {"ome": True, "metadata": {"axes": "TYX", "TimeIncrement": 0.02}},
    }
    deep = frames.astype(np.uint16)
    for name, more in made.items():
        channels = {"planes.tif": (3, 1), "alpha.tif": (2, -1)}.get(name)
        pixels = deep if channels is None else np.stack([deep] * channels[0], axis=channels[1])
        tifffile.imwrite(folder / name, pixels, **({"photometric": "minisblack"} | more))
    return [folder / name for name in made]


def _film(path: Path, frames, codec: str, pix_fmt: str) -> Path:
    return write_encoded(path, frames[:, :, :48], codec=codec, pix_fmt=pix_fmt, source="gray")


def _image(path: Path, frames) -> Path:
    cv2.imwrite(str(path), frames[0])
    return path


def _images(folder: Path, frames, end: str) -> Path:
    """The second of four images."""
    folder.mkdir(exist_ok=True)
    return [_image(folder / f"a_{n:04}{end}", frames[n : n + 1]) for n in range(4)][1]


def _photron(folder: Path, frames, *, xml: bool = False) -> Path:
    """The header of a recording, 12 bits packed or with a header in XML 8 bits; the pixels are beside it."""
    folder.mkdir(exist_ok=True)
    count, rows, columns = frames.shape
    bits = 8 if xml else 12
    (folder / "a.mraw").write_bytes(frames.tobytes() if xml else bytes(count * rows * columns * 3 // 2))
    if xml:
        path = folder / "a.cihx"
        text = (
            "<cih><recordInfo><recordRate>1000</recordRate></recordInfo>"
            f"<frameInfo><totalFrame>{count}</totalFrame><skipFrame>1</skipFrame></frameInfo>"
            f"<imageDataInfo><resolution><width>{columns}</width><height>{rows}</height></resolution>"
            f"<colorInfo><type>Mono</type><bit>{bits}</bit></colorInfo>"
            f"<effectiveBit><depth>{bits}</depth><side>Lower</side></effectiveBit></imageDataInfo></cih>"
        )
    else:
        path = folder / "a.cih"
        facts = {"Record Rate(fps)": 1000, "Total Frame": count, "Image Width": columns, "Image Height": rows}
        facts |= {
            "Color Type": "Mono",
            "Color Bit": bits,
            "EffectiveBit Depth": bits,
            "EffectiveBit Side": "Lower",
        }
        text = "#Camera Information Header\n" + "".join(
            f"{name} : {value}\n" for name, value in facts.items()
        )
    path.write_text(text)
    return path


def _cine(path: Path, frames) -> Path:
    count, rows, columns = frames.shape
    setup = bytearray(2000)
    struct.pack_into("<H", setup, 142, len(setup))
    struct.pack_into("<I", setup, 896, 8)
    times = struct.pack("<IHH", 8 + 8 * count, 1002, 0) + np.arange(count, dtype="<u8").tobytes()
    bitmap_at, setup_at = 44, 84
    images_at = setup_at + len(setup) + len(times)
    first = images_at + 8 * count
    size = rows * columns + 8
    head = struct.pack("<2sHHHiIiIIII8x", b"CI", 44, 0, 1, 0, count, 0, count, bitmap_at, setup_at, images_at)
    bitmap = struct.pack("<IiiHHIIiiII", 40, columns, rows, 1, 8, 0, rows * columns, 0, 0, 0, 0)
    places = np.array([first + n * size for n in range(count)], "<i8").tobytes()
    body = b"".join(struct.pack("<II", 8, rows * columns) + frame.tobytes() for frame in frames)
    path.write_bytes(head + bitmap + bytes(setup) + times + places + body)
    return path


def _columns() -> dict[str, np.ndarray]:
    t = np.arange(FORCE_ROWS) / 100
    return {"time_s": t, "load_N": 5 + (t * 7) % 1, "displacement_mm": t / 60}


def _mat(path: Path) -> Path:
    savemat(path, {**_columns(), "about": {"rate": 100.0, "name": "test"}}, do_compression=False)
    return path


def _mat73(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in _columns().items():
            file.create_dataset(name, data=values[np.newaxis], compression="gzip")
        file.create_group("about")["rate"] = 100.0
    return path


def _workbook(path: Path) -> Path:
    columns = _columns()
    book = openpyxl.Workbook()
    book.active.append(list(columns))
    for row in np.column_stack(list(columns.values())).tolist():
        book.active.append(row)
    book.save(path)
    return path


def _text(folder: Path) -> list[Path]:
    rows = np.column_stack(list(_columns().values()))
    made = []
    for name, separator, decimal in (
        ("c.csv", ",", "."),
        ("s.txt", ";", ","),
        ("t.txt", "\t", "."),
        ("w.txt", "  ", "."),
    ):
        cells = [separator.join(f"{value:8.4f}".replace(".", decimal) for value in row) for row in rows]
        header = [separator.join(("Time", "Load", "Position")), separator.join(("s", "N", "mm"))]
        made.append(folder / name)
        made[-1].write_text("\n".join(["Test: stick-slip", "", *header, *cells]) + "\n", encoding="utf-8")
    noted = [f"{line},ok" for line in made[0].read_text().splitlines()[2:]]
    made.append(folder / "words.csv")
    made[-1].write_text("\n".join(noted))
    return made


def _times(path: Path, frames: int) -> Path:
    path.write_text("frame;time (ms)\n" + "".join(f"{n};{20.0 * n}\n" for n in range(frames)))
    return path

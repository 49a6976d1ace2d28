"""Films that are damaged, cut short, changed meanwhile, or no files at all."""

import os
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from tests.scenes.films import comb, states, whole, write_avi, write_encoded
from vision.errors import InputError
from vision.files import MOST_PIXELS
from vision.video import encoded, open_video, read_timestamps, strip_profile


def pages(path, frames, **more):
    tifffile.imwrite(path, frames, photometric="minisblack", **more)
    return path


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return path


def index_first(path, frames):
    """A classic TIFF whose pages stand before all pixels, as some cameras write it."""
    count, rows, columns = frames.shape
    tags, head = 8, 8
    size = 2 + 12 * tags + 4
    first = head + count * size
    out = struct.pack("<2sHI", b"II", 42, head)
    for n in range(count):
        place = first + n * frames[0].nbytes
        values = ((256, 4, columns), (257, 4, rows), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, place))
        values += ((278, 4, rows), (279, 4, frames[0].nbytes))
        out += struct.pack("<H", tags) + b"".join(struct.pack("<HHII", t, k, 1, v) for t, k, v in values)
        out += struct.pack("<I", head + (n + 1) * size if n + 1 < count else 0)
    path.write_bytes(out + frames.tobytes())
    return path


# --- frames that are not there --------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.6, 0.999])
def test_frames_promised_by_an_index_are_counted(share, tmp_path):
    """A failure means "19 of 19" of 40: what is promised was counted after what is missing was left out."""
    video = open_video(cut(index_first(tmp_path / "a.tif", comb(40, 12, 300)), share))
    assert video.expected == 40
    strip = strip_profile(video)
    assert strip.attrs["frames_expected"] == 40
    assert strip.attrs["frames_read"] == {0.6: 23, 0.999: 39}[share]
    assert any("missing" in line for line in strip.attrs["warnings"])


def test_a_matroska_cut_near_its_start_is_reported(tmp_path):
    """A failure means that one frame of forty passes for a whole recording."""
    film = write_encoded(tmp_path / "a.mkv", comb(40, 12, 300), codec="ffv1", pix_fmt="gray", source="gray")
    assert open_video(film).warnings == ()
    assert any("cut short" in line for line in open_video(cut(film, 0.3)).warnings)


def test_a_png_that_announces_gigabytes_takes_none(tmp_path):
    """A failure means that one bit of a damaged picture takes all memory."""
    for n, frame in enumerate(comb(3)):
        cv2.imwrite(str(tmp_path / f"{n}.png"), frame)
    data = bytearray((tmp_path / "1.png").read_bytes())
    data[33:37] = struct.pack(">I", 0xCDFA9D93)  # the length of the chunk of pixels
    (tmp_path / "1.png").write_bytes(data)
    said = (  # getrusage would give the memory of the process that started this one
        "import sys; from vision.video import open_video; v = open_video(sys.argv[1])\n"
        "print(*(s for b in v.blocks() for s in b.status))\n"
        "print(next(int(line.split()[1]) >> 20 for line in open('/proc/self/status') if 'VmHWM' in line))"
    )
    done = subprocess.run([sys.executable, "-c", said, tmp_path], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["ok", "corrupt", "ok", "0"]  # GiB at most


def test_stacks_among_images_are_refused(tmp_path):
    """A failure means that of each file's ten frames one is read."""
    for n in range(3):
        pages(tmp_path / f"a_{n:04d}.tif", comb(10, 12, 60))
    with pytest.raises(InputError, match="one page per image"):
        open_video(tmp_path)


def test_pages_that_go_in_circles_are_refused(tmp_path):
    """A failure means a program that never ends."""
    file = index_first(tmp_path / "a.tif", comb(4, 12, 60))
    data = bytearray(file.read_bytes())
    size = 2 + 12 * 8 + 4
    struct.pack_into("<I", data, 8 + 4 * size - 4, 8 + size)
    file.write_bytes(data)
    with pytest.raises(InputError, match="page 4 is an earlier one"):
        open_video(file)


@pytest.mark.parametrize(("count", "found"), [(2, ["ok", "corrupt"]), (4, ["ok", "lost", "ok", "ok"])])
def test_a_page_whose_description_is_damaged_counts(tmp_path, count, found):
    """A failure means that later frames move up by one, or that a stack with one such page cannot be read."""
    file = pages(tmp_path / "a.tif", comb(count, 12, 60), compression="packbits", metadata=None)
    with tifffile.TiffFile(file, mode="r+b") as tif:
        tif.pages[1].tags["BitsPerSample"].overwrite(0)
    video = open_video(file)
    assert states(video) == found
    assert all(pixels.shape == (12, 60) for pixels in video.sample(4))


def test_a_page_whose_pixels_lie_beyond_the_end_is_lost(tmp_path):
    """A failure means that all later frames move up by one."""
    frames = comb(6, 12, 60)
    with tifffile.TiffFile(index_first(tmp_path / "a.tif", frames), mode="r+b") as tif:
        tif.pages[2].tags["StripOffsets"].overwrite(1 << 30)
    video = open_video(tmp_path / "a.tif")
    assert states(video) == ["ok", "ok", "lost", "ok", "ok", "ok"]
    assert np.array_equal(whole(video)[3:], frames[3:])


def test_a_page_of_another_height_is_corrupt(tmp_path):
    """A failure means that one damaged number makes a whole stack unreadable."""
    colour = np.stack([comb(6, 12, 60)] * 3, axis=1)
    tifffile.imwrite(tmp_path / "a.tif", colour, photometric="rgb", planarconfig="separate")
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+b") as tif:
        tif.pages[2].tags["ImageLength"].overwrite(30)
    video = open_video(tmp_path / "a.tif")
    assert states(video) == ["ok", "ok", "corrupt", "ok", "ok", "ok"]
    assert all(pixels.shape == (12, 60) for pixels in video.sample(6))


def test_frames_far_too_large_are_refused_before_memory_is_taken(tmp_path, monkeypatch):
    """A failure means that a picture of a few kilobytes takes gigabytes."""
    rows, columns = 30_000, 30_000
    assert rows * columns > MOST_PIXELS
    file = tmp_path / "a_0001.png"
    cv2.imwrite(str(file), np.zeros((4, 4), np.uint8))
    data = bytearray(file.read_bytes())
    data[16:24] = struct.pack(">II", columns, rows)
    file.write_bytes(data)
    with pytest.raises(InputError):
        open_video(file)
    monkeypatch.setattr("vision.files.MOST_PIXELS", 500)
    with pytest.raises(InputError, match="million pixels"):
        open_video(write_avi(tmp_path / "a.avi", comb(2, 12, 50)))


# --- what is opened, and under what name -----------------------------------------------------------


@pytest.mark.posix
@pytest.mark.parametrize("reader", [open_video, read_timestamps])
def test_pipes_and_devices_are_refused(reader, tmp_path):
    """A failure means that the program waits, or reads, for ever."""
    os.mkfifo(tmp_path / "pipe.avi")
    for path in (tmp_path / "pipe.avi", "/dev/zero"):
        with pytest.raises(InputError, match="device, pipe or socket"):
            reader(type(tmp_path)(path))


@pytest.mark.posix
@pytest.mark.parametrize(
    "name", ["2024-05-12T14:30:05.mkv", "concat:a.mkv", "a%20b?c#d.mkv", b"\xe9\xff.mkv"]
)
def test_any_name_of_a_file_will_do(name, tmp_path):
    """A failure means that a time in a name is taken for a protocol, or that an old name is none."""
    made = write_encoded(tmp_path / "a.mkv", comb(5), codec="ffv1", pix_fmt="gray", source="gray")
    path = tmp_path / os.fsdecode(name)
    made.rename(path)
    assert sum(len(block.status) for block in open_video(path).blocks()) == 5


@pytest.mark.parametrize(
    "text",
    ["ffconcat version 1.0\nfile secret.mkv\n", "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nsecret.mkv\n"],
)
def test_lists_of_other_files_are_not_followed(text, tmp_path):
    """A failure means that a file makes the program read others."""
    write_encoded(tmp_path / "secret.mkv", comb(5), codec="ffv1", pix_fmt="gray", source="gray")
    for name in ("a.mkv", "a.m3u8", "a.ffconcat"):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError):
            open_video(tmp_path / name)


# --- files that change meanwhile -------------------------------------------------------------------


def reading_while(path, happens):
    """Blocks of a film to which something happens after the first."""
    for n, block in enumerate(open_video(path).blocks()):
        if n == 0:
            happens()
        yield block


def big(path):
    return write_avi(path, comb(600, 12, 5000))


def test_a_file_that_shrinks_is_one_line(tmp_path):
    """A failure means that the process is killed (SIGBUS), or reads zeros."""
    file = big(tmp_path / "a.avi")
    with pytest.raises(InputError, match="shorter"):
        list(reading_while(file, lambda: os.truncate(file, 100_000)))


def test_a_file_that_is_replaced_is_one_line(tmp_path):
    """A failure means that frames of two films are mixed."""
    file, other = big(tmp_path / "a.avi"), big(tmp_path / "b.avi")
    with pytest.raises(InputError, match="replaced"):
        list(reading_while(file, lambda: other.replace(file)))


def test_a_file_that_grows_is_said(tmp_path):
    """A failure means that a film which a camera still writes passes for whole."""
    file = big(tmp_path / "a.avi")
    video = open_video(file)
    assert video.changes == ()
    with file.open("ab") as out:
        out.write(b"more")
    assert "grew" in video.changes[0]


@pytest.mark.parametrize("codec", ["mjpeg", "ffv1"])
def test_an_avi_that_grows_while_it_is_read_keeps_its_numbers(codec, tmp_path, monkeypatch):
    """FFmpeg finds the last packet cut off, and goes on in its middle. A failure means that all later frames
    have the numbers of earlier ones, and are called ok."""
    film = tmp_path / "a.avi"
    kind = "yuvj420p" if codec == "mjpeg" else "gray"
    write_encoded(film, comb(200, 12, 48).astype(np.uint8), codec=codec, pix_fmt=kind, source="gray")
    expected, data = whole(open_video(film)), film.read_bytes()
    packets = encoded._video_packets
    for cut in range(len(data) // 3, len(data) // 3 + 70, 7):
        film.write_bytes(data[:cut])
        held = sum(len(block.status) for block in open_video(film).blocks())
        video = open_video(film)

        def growing(stream, *size, held=held, cut=cut):
            for count, packet in enumerate(packets(stream, *size), 1):
                yield packet
                if count == held:
                    with film.open("ab") as out:
                        out.write(data[cut:])

        monkeypatch.setattr(encoded, "_video_packets", growing)
        blocks = list(video.blocks())
        monkeypatch.undo()
        status = np.concatenate([block.status for block in blocks])
        pixels = np.concatenate([block.pixels for block in blocks])
        assert 0 < len(status) <= held + 1
        ok = status == "ok"
        assert np.array_equal(pixels[ok], expected[: len(pixels)][ok])


def test_a_packed_film_that_shrinks_is_one_line(tmp_path):
    """A failure means that the process is killed (SIGBUS) by a film of 12 bits."""
    file = tmp_path / "a.mraw"
    rows, columns, count = 12, 500, 600
    file.write_bytes(bytes(rows * columns * 3 // 2 * count))
    text = f"Total Frame : {count}\nImage Width : {columns}\nImage Height : {rows}\nColor Bit : 12\n"
    file.with_suffix(".cih").write_text(text)
    with pytest.raises(InputError, match="shorter"):
        list(reading_while(file, lambda: os.truncate(file, 100_000)))


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "images"
    place.mkdir()
    for n, frame in enumerate(comb(300, 12, 500)):
        cv2.imwrite(str(place / f"a_{n:04d}.bmp"), frame)
    return place


@pytest.mark.parametrize("pattern", ["", "*.bmp"])
def test_images_that_are_removed_are_one_line(pattern, folder):
    """A failure means that images moved away meanwhile pass for damaged ones."""

    def remove():
        for n in range(250, 300):
            (folder / f"a_{n:04d}.bmp").unlink()

    with pytest.raises(InputError, match="exist while they are read"):
        list(reading_while(folder / pattern, remove))


@pytest.mark.parametrize("pattern", ["", "*.bmp"])
def test_images_that_come_or_change_meanwhile_are_said(pattern, folder):
    """A failure means that a folder which a camera still fills passes for whole."""
    video = open_video(folder / pattern)
    assert video.changes == ()
    shutil.copy(folder / "a_0000.bmp", folder / "a_0300.bmp")
    assert "grew" in video.changes[0]
    (folder / "a_0300.bmp").unlink()
    assert video.changes == ()
    os.utime(folder / "a_0007.bmp", (2e9, 2e9))
    assert "was changed" in video.changes[0]


def test_a_folder_that_is_removed_is_one_line(folder):
    """A failure means that a drive pulled out gives a film of damaged frames."""
    with pytest.raises(InputError, match="removed"):
        list(reading_while(folder, lambda: shutil.rmtree(folder)))


def test_a_film_without_its_beginning_says_so(tmp_path):
    """Failure: frames found in the remains of a film are taken for the whole film at its own rate."""
    film = Path(__file__).parents[2] / "fixtures" / "paper" / "video.avi"
    assert open_video(film).warnings == ()
    (tmp_path / "rest.avi").write_bytes(film.read_bytes()[100_000:])
    (line,) = open_video(tmp_path / "rest.avi").warnings
    assert "the beginning of the file is missing or damaged" in line


@pytest.mark.parametrize(("suffix", "codec"), [("avi", "rawvideo"), ("avi", "mjpeg"), ("mp4", "mpeg4")])
def test_a_second_recording_in_a_file_is_told(tmp_path, suffix, codec):
    """A failure means that two films joined byte by byte are one without a break, or the second is lost
    silently; or that the parts of a large AVI are taken for several recordings."""
    path, films = tmp_path / f"a.{suffix}", comb(20, 16, 64)
    if codec == "rawvideo":
        write_avi(path, films, segments=3)
    else:
        pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        write_encoded(path, films, codec=codec, pix_fmt=pix_fmt, source="gray")
    assert open_video(path).warnings == ()
    one = path.read_bytes()
    path.write_bytes(one + one)
    (line,) = open_video(path).warnings
    assert f"a second recording begins at byte {len(one)}" in line

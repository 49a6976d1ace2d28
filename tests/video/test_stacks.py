import struct

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from tests.scenes.films import comb, states, whole, write_avi
from vision.errors import InputError
from vision.video import open_video, strip_profile
from vision.video.reader import LOSSY, MappedReader

PYLON = "Basler_acA1300-200um__21927848__20200309_175055809_{:04d}.{}"


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"bigtiff": True},
        {"byteorder": ">"},
        {"compression": "zlib"},
        {"compression": "lzw", "predictor": True},
        {"rowsperstrip": 3},
        {"tile": (16, 16)},
        {"ome": True},
        {"imagej": True},
        {"metadata": None},
    ],
)
def test_tiff_is_read_exactly(tmp_path, dtype, options):
    """Failure: some flavour of TIFF loses depth, byte order or pages."""
    frames = comb(top=4095 if dtype != np.uint8 else 255, dtype=dtype)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, frames, photometric="minisblack", **options)
    video = open_video(path)
    assert np.array_equal(whole(video), frames)
    assert video.expected == 6
    assert next(video.blocks()).pixels.dtype.isnative
    assert np.array_equal(np.stack(list(video.sample(3)))[-1], frames[-1])
    if "compression" not in options and "tile" not in options:
        assert isinstance(video.reader, MappedReader)


def write_in_two_files(folder, frames, **options):
    """An OME recording of six frames, of which each file holds three."""
    uuids = [f"urn:uuid:00000000-0000-0000-0000-00000000000{n}" for n in range(2)]
    places = "".join(
        f'<TiffData FirstT="{n}" IFD="{n % 3}" PlaneCount="1">'
        f'<UUID FileName="a_{n // 3}.ome.tif">{uuids[n // 3]}</UUID></TiffData>'
        for n in range(6)
    )
    rows, columns = frames[0].shape
    for file, uuid in enumerate(uuids):
        xml = (
            f'<OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="{uuid}">'
            f'<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYCZT" Type="uint8" '
            f'SizeX="{columns}" SizeY="{rows}" SizeZ="1" SizeC="1" SizeT="6">{places}</Pixels></Image></OME>'
        )
        with tifffile.TiffWriter(folder / f"a_{file}.ome.tif", ome=False) as out:
            for n, frame in enumerate(frames[3 * file : 3 * file + 3]):
                about = xml if n == 0 else None
                out.write(frame, contiguous=False, metadata=None, description=about, **options)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
@pytest.mark.parametrize("given", ["a_0.ome.tif", "a_1.ome.tif"])
def test_a_recording_in_several_files_is_read_from_all(tmp_path, options, given):
    """Failure: frames in the other file are taken from the same place of this one, or left out unsaid."""
    frames = comb()
    write_in_two_files(tmp_path, frames, **options)
    assert np.array_equal(whole(open_video(tmp_path / given)), frames)


def test_the_frames_of_a_file_that_is_not_there_are_lost(tmp_path):
    """Failure: half of a recording in two files, of which one was copied, passes for all of it."""
    write_in_two_files(tmp_path, comb())
    (tmp_path / "a_1.ome.tif").unlink()
    assert states(open_video(tmp_path / "a_0.ome.tif")) == ["ok"] * 3 + ["lost"] * 3


def one_page(path, data, shape, *, bits, fill_order=1):
    """An uncompressed TIFF of one grey page, its bytes as given."""
    rows, columns = shape
    tags = [
        (256, columns),
        (257, rows),
        (258, bits),
        (259, 1),
        (262, 1),
        (266, fill_order),
        (273, 8),
        (277, 1),
    ]
    tags += [(278, rows), (279, len(data))]
    ifd = struct.pack("<H", len(tags)) + b"".join(struct.pack("<HHII", tag, 4, 1, n) for tag, n in tags)
    path.write_bytes(b"II*\0" + struct.pack("<I", 8 + len(data)) + data + ifd + bytes(4))


def test_packed_12_bits(tmp_path):
    """Failure: 12 bits packed in 12 are read as something else, or called 16 bits."""
    frame = comb(count=1, top=4095, dtype=np.uint16)[0]
    bits = np.unpackbits(frame.astype(">u2").view(np.uint8)).reshape(*frame.shape, 16)[..., 4:]
    data = np.packbits(bits.reshape(frame.shape[0], -1), axis=1).tobytes()
    one_page(tmp_path / "a.tif", data, frame.shape, bits=12)
    video = open_video(tmp_path / "a.tif")
    assert video.depth_bits == 12
    assert np.array_equal(whole(video)[0], frame)


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"planarconfig": "separate"}])
def test_colour_tiff_follows_the_luma_rule(tmp_path, options):
    """Failure: colour stacks become grey by another rule than the one stated, or as three frames."""
    colour = np.random.default_rng(3).integers(0, 256, (4, 12, 20, 3), dtype=np.uint8)
    data = np.moveaxis(colour, -1, 1) if options.get("planarconfig") else colour
    tifffile.imwrite(tmp_path / "a.tif", data, photometric="rgb", **options)
    video = open_video(tmp_path / "a.tif")
    assert np.abs(whole(video) - colour @ [0.299, 0.587, 0.114]).max() <= 0.51


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"planarconfig": "separate"}])
@pytest.mark.parametrize("kind", ["stack", "images"])
def test_grey_beside_alpha_is_grey(tmp_path, options, kind):
    """Failure: transparency is mixed with grey levels, or such a stack is called damaged."""
    frames = comb()
    pair = np.stack([frames, 255 - frames], axis=1 if "planarconfig" in options else -1)
    more = {"photometric": "minisblack", "planarconfig": "contig", "extrasamples": ["unassalpha"], **options}
    if kind == "stack":
        tifffile.imwrite(tmp_path / "a.tif", pair, **more)
    else:
        for n, one in enumerate(pair):
            tifffile.imwrite(tmp_path / f"a_{n:02}.tif", one, **more)
    assert np.array_equal(whole(open_video(tmp_path / "a.tif" if kind == "stack" else tmp_path)), frames)


@pytest.mark.parametrize("width", [3, 4])
def test_narrow_planes_of_colour_are_no_colours_of_a_pixel(tmp_path, width):
    """Failure: three columns of separate planes are taken for red, green and blue."""
    colour = np.random.default_rng(3).integers(0, 256, (4, 7, width, 3), dtype=np.uint8)
    for n, one in enumerate(np.moveaxis(colour, -1, 1)):
        tifffile.imwrite(tmp_path / f"a_{n}.tif", one, photometric="rgb", planarconfig="separate")
    assert np.abs(whole(open_video(tmp_path)) - colour @ [0.299, 0.587, 0.114]).max() <= 0.51


def test_values_with_the_lowest_bit_first(tmp_path):
    """Failure: each byte of a fax-like TIFF ("FillOrder" 2) is read backwards, all grey levels wrong."""
    frame = comb(count=1)[0]
    backwards = np.packbits(np.unpackbits(frame[..., None], axis=-1)[..., ::-1], axis=-1)
    one_page(tmp_path / "a.tif", backwards.tobytes(), frame.shape, bits=8, fill_order=2)
    assert np.array_equal(whole(open_video(tmp_path / "a.tif"))[0], frame)


def test_lab_gives_lightness_and_inks_are_refused(tmp_path):
    """Failure: the luma rule is applied to what is not red, green and blue, without a word."""
    pixels = np.random.default_rng(3).integers(0, 256, (4, 12, 20, 4), dtype=np.uint8)
    tifffile.imwrite(tmp_path / "lab.tif", pixels[..., :3], photometric="cielab")
    assert np.array_equal(whole(open_video(tmp_path / "lab.tif")), pixels[..., 0])
    tifffile.imwrite(tmp_path / "ink.tif", pixels, photometric="separated")
    with pytest.raises(InputError, match="CMYK"):
        open_video(tmp_path / "ink.tif")


@pytest.mark.parametrize(("orientation", "turned_deg"), [(1, 0), (3, 180), (6, 90), (8, 270)])
def test_photographs_are_seen_as_viewers_show_them(tmp_path, orientation, turned_deg):
    """Failure: photographs of a phone held upright lie on their side, although every viewer turns them."""
    frames = comb()
    asked = Image.Exif()
    asked[274] = orientation
    for n, frame in enumerate(frames):
        Image.fromarray(frame).save(tmp_path / f"a_{n}.png", exif=asked)
    assert np.array_equal(whole(open_video(tmp_path)), np.rot90(frames, -turned_deg // 90, axes=(1, 2)))


def test_cut_imagej_stack_gives_what_it_holds(tmp_path):
    """Failure: one page is read of a stack whose metadata announce many, without a warning."""
    frames = comb(count=10, dtype=np.uint16, top=60000).astype(">u2")
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, frames, imagej=True, metadata={"finterval": 0.04})
    data = path.read_bytes()
    path.write_bytes(data[: data.index(frames[6].tobytes()[:40]) + 100])
    strip = strip_profile(open_video(path), slice(0, 12))
    assert (strip.frames_expected, strip.frames_read, strip.frames_lost) == (10, 6, 4)
    assert np.allclose(strip, frames[:6].mean(axis=1), rtol=1e-6)
    assert "4 are missing" in strip.warnings[1]


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}])
def test_cut_multi_page_tiff(tmp_path, options):
    """Failure: a stack cut by a full disk is refused, or read as if it were whole."""
    frames = comb(count=10)
    path = tmp_path / "a.tif"
    with tifffile.TiffWriter(path) as out:
        for frame in frames:
            out.write(frame, contiguous=False, metadata=None, **options)
    whole_file = path.read_bytes()
    path.write_bytes(whole_file[: int(0.65 * len(whole_file))])
    strip = strip_profile(open_video(path), slice(0, 12))
    good = strip[(strip.status == "ok").values]
    assert 4 <= good.sizes["frame"] <= 7
    assert np.allclose(good, frames[: len(good)].mean(axis=1), rtol=1e-6)
    assert "more pages were to follow" in strip.warnings[0]


@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"contiguous": True}])
def test_stack_written_page_by_page(tmp_path, options):
    """Failure: a stack written in a loop, which has one series a page, is refused or read as one frame."""
    frames = comb(count=10)
    with tifffile.TiffWriter(tmp_path / "a.tif") as out:
        for frame in frames:
            out.write(frame, **options)
    assert np.array_equal(whole(open_video(tmp_path / "a.tif")), frames)


def test_pages_of_several_sizes_are_refused_by_their_sizes(tmp_path):
    """Failure: the message names no sizes, or the page that differs is read as noise."""
    with tifffile.TiffWriter(tmp_path / "a.tif") as out:
        for n, frame in enumerate(comb(count=6)):
            out.write(frame if n != 4 else frame[:, :30])
    with pytest.raises(InputError, match="50 x 12 and 30 x 12"):
        open_video(tmp_path / "a.tif")


def test_cut_plain_stack_gives_what_it_holds(tmp_path):
    """Failure: of a stack whose page list stood at its lost end, only the first frame is read."""
    frames = comb(count=10)
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, frames)
    data = path.read_bytes()
    path.write_bytes(data[: data.index(frames[6].tobytes()[:40]) + 100])
    strip = strip_profile(open_video(path), slice(0, 12))
    assert (strip.frames_expected, strip.frames_read, strip.frames_lost) == (10, 6, 4)
    assert np.allclose(strip, frames[:6].mean(axis=1), rtol=1e-6)


@pytest.mark.parametrize("planarconfig", ["contig", "separate"])
def test_colours_of_an_ome_stack_are_no_frames(tmp_path, planarconfig):
    """Failure: two frames in three of a whole colour stack are said to be missing."""
    colour = np.stack([comb()] * 3, axis=-1 if planarconfig == "contig" else 1)
    tifffile.imwrite(tmp_path / "a.ome.tif", colour, photometric="rgb", planarconfig=planarconfig)
    video = open_video(tmp_path / "a.ome.tif")
    assert video.expected == 6
    assert np.array_equal(whole(video), comb())


@pytest.mark.filterwarnings("error")
def test_infinite_pixels_are_corrupt(tmp_path):
    """Failure: infinity spreads into the recording's contrast and from there into other frames."""
    frames = comb(dtype=np.float32)
    frames[2, 5, 7] = np.inf
    tifffile.imwrite(tmp_path / "a.tif", frames)
    strip = strip_profile(open_video(tmp_path / "a.tif"), slice(0, 12))
    assert strip.status.values.tolist() == ["ok", "ok", "corrupt", "ok", "ok", "ok"]


def test_times_of_stacks(tmp_path):
    """Failure: ImageJ's and OME's frame interval is ignored, taken in the wrong unit, or
    makes the film unreadable if it is no number."""
    tifffile.imwrite(tmp_path / "ij.tif", comb(), imagej=True, metadata={"finterval": 0.04, "axes": "TYX"})
    ome = {"axes": "TYX", "TimeIncrement": 40.0, "TimeIncrementUnit": "ms"}
    tifffile.imwrite(tmp_path / "a.ome.tif", comb(), metadata=ome)
    tifffile.imwrite(tmp_path / "none.tif", comb())
    for name in ("ij.tif", "a.ome.tif"):
        video = open_video(tmp_path / name)
        assert video.clock.kind == "file"
        assert np.allclose(strip_profile(video, slice(0, 12)).time_s, np.arange(6) * 0.04)
    tifffile.imwrite(tmp_path / "comma.ome.tif", comb(), metadata=ome | {"TimeIncrement": "0,04"})
    for name in ("none.tif", "comma.ome.tif"):
        strip = strip_profile(open_video(tmp_path / name), slice(0, 12))
        assert strip.clock_kind == "playback"
        assert np.isnan(strip.time_s).all()


def test_nan_in_float_frames(tmp_path):
    """Failure: NaN spreads into positions; it must cost that frame only where it is inside the strip."""
    frames = comb(dtype=np.float32)
    frames[2, 5, 7] = np.nan
    tifffile.imwrite(tmp_path / "a.tif", frames)
    inside = strip_profile(open_video(tmp_path / "a.tif"), slice(4, 8))
    assert inside.status.values.tolist() == ["ok", "ok", "corrupt", "ok", "ok", "ok"]
    outside = strip_profile(open_video(tmp_path / "a.tif"), slice(6, 12))
    assert (outside.status == "ok").all()
    tifffile.imwrite(tmp_path / "b.tif", np.full_like(frames, np.nan))
    with pytest.raises(InputError, match="shows something"):
        strip_profile(open_video(tmp_path / "b.tif"), slice(0, 12))


def test_ambiguous_and_damaged_tiffs_are_refused(tmp_path):
    """Failure: channels are read as frames, or a torn header ends in a traceback."""
    tifffile.imwrite(tmp_path / "a.tif", comb().reshape(3, 2, 12, 50), imagej=True, metadata={"axes": "TCYX"})
    with pytest.raises(InputError, match="one dimension"):
        open_video(tmp_path / "a.tif")
    (tmp_path / "b.tif").write_bytes((tmp_path / "a.tif").read_bytes()[:60])
    (tmp_path / "c.tif").write_bytes(b"II*\0\x08\0\0\0")
    tifffile.imwrite(tmp_path / "d.tif", comb().astype(np.int16))
    for name in ("b.tif", "c.tif", "d.tif"):
        with pytest.raises(InputError):
            open_video(tmp_path / name)


def write_images(folder, frames, suffix="png", numbers=None):
    folder.mkdir(exist_ok=True)
    for number, frame in zip(numbers or range(1, len(frames) + 1), frames, strict=True):
        file = folder / PYLON.format(number, suffix)
        (tifffile.imwrite if suffix.startswith("tif") else cv2.imwrite)(str(file), frame)
    return folder


@pytest.mark.parametrize("suffix", ["png", "tiff", "bmp"])
@pytest.mark.parametrize("pattern", [False, True])
def test_image_sequences_are_read_exactly(tmp_path, suffix, pattern):
    """Failure: images come in the order 1, 10, 2, or lose depth."""
    frames = comb(
        count=12, top=255 if suffix == "bmp" else 60000, dtype=np.uint8 if suffix == "bmp" else np.uint16
    )
    folder = write_images(tmp_path / "f", frames, suffix, [*range(9995, 10007)])
    (folder / "settings.txt").write_text("exposure 3 ms")
    video = open_video(folder / f"*.{suffix}" if pattern else folder)
    assert np.array_equal(whole(video), frames)


def test_gaps_and_bad_images(tmp_path):
    """Failure: a missing file moves all later frames up in time, or an unreadable one stops the run."""
    frames = comb(count=7)
    folder = write_images(tmp_path / "f", frames, numbers=[3, 4, 7, 8, 9, 10, 11])
    (folder / PYLON.format(8, "png")).write_bytes(b"")
    strip = strip_profile(open_video(folder, fps=50), slice(0, 12))
    assert strip.status.values.tolist() == ["ok", "ok", "lost", "lost", "ok", "corrupt", "ok", "ok", "ok"]
    assert np.allclose(strip.time_s, np.arange(9) / 50)
    assert np.array_equal(strip[6], frames[4].mean(axis=0).astype(np.float32))
    assert (strip.frames_expected, strip.frames_read, strip.frames_lost) == (9, 6, 3)


def test_numbers_that_are_no_frame_count(tmp_path):
    """Failure: names made of clock times announce millions of lost frames."""
    folder = write_images(
        tmp_path / "f", comb(), numbers=[20200101, 20200357, 20210001, 20210777, 20230000, 20240000]
    )
    video = open_video(folder)
    assert states(video) == ["ok"] * 6
    first, last = sorted(file.name for file in folder.iterdir())[:: len(comb()) - 1]
    assert f"only their order is used, from {first} to {last}: check" in video.warnings[0]


def test_numbers_without_zeros_in_front(tmp_path):
    """Failure: frame_10 is read before frame_2, as names are sorted."""
    frames = comb(count=12)
    folder = write_images(tmp_path / "f", frames, numbers=[*range(12)])
    for file in folder.iterdir():
        file.rename(file.with_stem(f"frame_{int(file.stem.split('_')[-1])}"))
    assert sorted(file.name for file in folder.iterdir())[2].startswith("frame_10.")
    assert np.array_equal(whole(open_video(folder)), frames)


def test_every_tenth_image(tmp_path):
    """Failure: a thinned series reads as nine lost frames in ten."""
    video = open_video(write_images(tmp_path / "f", comb(count=12), numbers=[*range(0, 120, 10)]))
    assert states(video) == ["ok"] * 12
    assert "steps of 10" in video.warnings[0]


def test_mixed_folders_are_refused(tmp_path):
    """Failure: two recordings in one folder are woven into one."""
    folder = write_images(tmp_path / "f", comb())
    cv2.imwrite(str(folder / "other_0003.png"), comb()[0])
    with pytest.raises(InputError, match="one image per frame number"):
        open_video(folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="numbered images"):
        open_video(tmp_path / "empty")
    write_images(tmp_path / "g", comb())
    cv2.imwrite(str(tmp_path / "g" / PYLON.format(9, "png")), comb(rows=20)[0])
    with pytest.raises(InputError, match="50 x 12"):
        strip_profile(open_video(tmp_path / "g"), slice(0, 12))


def test_a_folder_without_images_is_told_what_it_holds(tmp_path):
    """Failure: folders are counted as files, films in them seem to be looked for, or who gives the folder of
    a film is not told which file to give."""
    (tmp_path / "notes.txt").write_text("3 mm/min")
    for name in ("test", "later"):
        (tmp_path / name).mkdir()
    film = write_avi(tmp_path / "test" / "video.avi", comb())
    with pytest.raises(InputError, match=r"none among 1 file and 2 folders; .* not looked for"):
        open_video(tmp_path)
    with pytest.raises(InputError, match=r"a folder of 1 film\(s\); give a film in it, such as ") as refused:
        open_video(tmp_path / "test")
    assert str(refused.value).endswith(str(film))


def test_jpeg_images(tmp_path):
    """Failure: JPEG series cannot be read, or far from what went in."""
    frames = comb(rows=32, columns=64)
    video = open_video(write_images(tmp_path / "f", frames, "jpg"))
    assert np.abs(whole(video).astype(int) - frames).mean() < 2


@pytest.mark.parametrize("kind", ["jpg images", "jpeg images", "tiff images", "stack"])
def test_jpeg_counts_as_lossy_wherever_it_stands(tmp_path, kind):
    """Failure: errors of a JPEG sequence are stated as if its noise were the camera's."""
    frames = comb(rows=32, columns=64)
    if kind == "stack":
        path = tmp_path / "a.tif"
        tifffile.imwrite(path, frames, compression="jpeg", photometric="minisblack")
    else:
        path = tmp_path / "a"
        path.mkdir()
        suffix = kind.partition(" ")[0]
        for n, frame in enumerate(frames):
            if suffix == "tiff":
                tifffile.imwrite(path / f"{n}.tiff", frame, compression="jpeg")
            else:
                cv2.imwrite(str(path / f"{n}.{suffix}"), frame)
    assert open_video(path).facts.codec in LOSSY
    tifffile.imwrite(tmp_path / "b.tif", frames, compression="zlib")
    assert open_video(tmp_path / "b.tif").facts.codec not in LOSSY
    tifffile.imwrite(tmp_path / "c.tif", frames)
    tifffile.imwrite(tmp_path / "d.tif", frames[0], rowsperstrip=3)
    assert {open_video(tmp_path / name).facts.codec for name in ("c.tif", "d.tif")} == {"uncompressed"}


def test_pixel_size_of_stacks(tmp_path):
    """Failure: Fiji's and OME's scale is ignored or misread, or that of a print (72 dpi) is believed."""

    def facts(unit, across=0.1, down=0.1):
        metadata, resolution = {"unit": unit, "axes": "TYX"}, (across, down)
        tifffile.imwrite(tmp_path / "ij.tif", comb(), imagej=True, resolution=resolution, metadata=metadata)
        return open_video(tmp_path / "ij.tif").facts

    def stated(unit, across=0.1, down=0.1):
        return facts(unit, across, down).pixel_size_um

    assert stated("micron") == stated("um") == stated("\\u00B5m") == pytest.approx(10.0)
    assert stated("mm", 100.0, 100.0) == pytest.approx(10.0)
    assert stated("pixel") is stated("inch", 72.0, 72.0) is stated("micron", 0.1, 0.2) is None
    assert stated("micron", 0, 0) is None
    assert facts("inch", 72.0, 72.0).scale_unused == "72 px per inch, mostly the size of a print"
    assert facts("micron", 0.1, 0.2).scale_unused == "10 x 5 µm per px, not square"
    assert facts("micron").scale_unused == facts("pixel").scale_unused == ""
    tifffile.imwrite(tmp_path / "cm.tif", comb(), resolution=(1000.0, 1000.0), resolutionunit="CENTIMETER")
    plain = open_video(tmp_path / "cm.tif").facts
    assert (plain.pixel_size_um, plain.scale_unused) == (None, "1000 px per cm, mostly the size of a print")
    ome = {"axes": "TYX", "PhysicalSizeX": 0.01, "PhysicalSizeXUnit": "mm", "PhysicalSizeY": 10.0}
    tifffile.imwrite(tmp_path / "a.ome.tif", comb(), metadata=ome)
    assert open_video(tmp_path / "a.ome.tif").facts.pixel_size_um == pytest.approx(10.0)
    ome |= {"PhysicalSizeX": "0,01"}
    tifffile.imwrite(tmp_path / "b.ome.tif", comb(), metadata=ome)
    assert open_video(tmp_path / "b.ome.tif").facts.pixel_size_um is None
    tifffile.imwrite(tmp_path / "none.tif", comb())
    none = open_video(tmp_path / "none.tif").facts
    assert (none.pixel_size_um, none.scale_unused) == (None, "")

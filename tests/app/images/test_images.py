"""EXR and PNG files: whole or refused, found again as written, replaced at once."""

import struct
import subprocess
import sys
from contextlib import closing

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest

from stss.images import read_write as images
from stss.images.encode import encode_exr
from stss.images.headers import read_header
from stss.images.windows import PixelWindow
from stss.quality.metrics import to_8bit
from stss_ground.errors import InputError
from tests.app.conftest import write_parts, write_raw


def planes(*names, size=(9, 7), seed=0):
    random = np.random.default_rng(seed)
    return {name: random.normal(size=size).astype(np.float32) for name in names}


def test_channels_come_back_by_their_full_name(tmp_path):
    path = tmp_path / "a.exr"
    pixels = planes("R", "G", "B", "motion.X", "motion.Y", "depth.Z", "A.b.c.R")
    images.write_channels(path, pixels, half=("R", "G"), metadata={"stss:key": 'é {"a": 1}\nb'})

    header = images.read_header(path)
    assert set(header.channels) == set(pixels)
    assert {name for name, kind in header.formats.items() if kind == "half"} == {"R", "G"}
    assert set(header.compression.values()) == {"zip"}
    assert header.attributes["stss:key"] == 'é {"a": 1}\nb'
    assert header.size == (9, 7)
    assert set(header.windows.values()) == {header.display} == {(0, 0, 7, 9)}
    with pytest.raises(InputError, match=r"a\.exr: no channel depth\.V; it has R, G, B, .*, motion\.Y"):
        images.read_channels(path, ["depth.V"])
    channels = images.read_channels(path, ["depth.Z", "R", "motion.Y"])
    assert list(channels) == ["depth.Z", "R", "motion.Y"]
    for name, plane in channels.items():
        assert plane.dtype == np.float32
        want = pixels[name].astype(np.float16) if name == "R" else pixels[name]
        np.testing.assert_array_equal(plane, want.astype(np.float32))


@pytest.mark.parametrize("kind", ["none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa:45", "dwab", "htj2k32"])
@pytest.mark.parametrize("number_type", ["half", "float", "uint"])
def test_what_a_compression_changes_is_known(tmp_path, kind, number_type):
    """By the pixels that come back: of channels that are named as colours, and of others."""
    names = ("R", "light.B", "motion.X", "motion.Y", "normal.Z", "depth.V", "a.RY", "y", "red")
    pixels = np.abs(100 * np.random.default_rng(0).standard_normal((32, 32, len(names))))
    pixels = pixels.astype(np.uint32 if number_type == "uint" else np.float32)
    for path, compression in (("a.exr", kind), ("b.exr", "none")):
        write_parts(tmp_path / path, (pixels, names, {"compression": (compression,)}), number_type=number_type)
    header = images.read_header(tmp_path / "a.exr")
    channels, expected = (images.read_channels(tmp_path / path, names) for path in ("a.exr", "b.exr"))
    changes = [name for name in names if not np.array_equal(channels[name], expected[name])]
    assert [name for name in names if header.lossy(name)] == changes


@pytest.mark.parametrize("order", ["increasingY", "decreasingY"])
@pytest.mark.parametrize("tile", [0, 16])
@pytest.mark.parametrize("kind", ["none", "zips", "zip", "piz", "dwaa:45", "dwab", "htj2k256"])
def test_blocks_of_lines_are_the_whole_image(tmp_path, kind, tile, order):
    """Channels of several formats, whose number of lines is no multiple of a block's, and that begin above the first line."""
    random, path = np.random.default_rng(0), tmp_path / "a.exr"
    pixels = random.random((300, 9, 7), np.float32)
    spec = oiio.ImageSpec(9, 300, 7, "float")
    spec.channelnames = tuple("RGBAdez")
    spec.channelformats = tuple(map(oiio.TypeDesc, ("half",) * 4 + ("float",) * 3))
    spec.x, spec.y, spec.tile_width, spec.tile_height = -3, -37, tile, tile
    spec.attribute("compression", kind)
    spec.attribute("openexr:lineOrder", order)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(pixels), output.geterror()
    output.close()
    with closing(oiio.ImageInput.open(str(path))) as file:
        want = dict(zip(file.spec().channelnames, np.moveaxis(file.read_image(0, 0, 0, 7, "float"), -1, 0), strict=True))
    window = read_header(path).windows["R"]
    assert (window.x, window.y) == (-3, -37)
    got = images.read_channels(path, ["z", "R", "d", "A"], window)
    for name, plane in got.items():
        np.testing.assert_array_equal(plane, want[name])


def test_several_arrays_are_one_image(tmp_path):
    """As encoded in blocks of lines, into a data window that begins above the first line."""
    random, path = np.random.default_rng(0), tmp_path / "a.exr"
    parts = [random.random((150, 5, n)).astype(np.float32) for n in (3, 1, 2)]
    parts[2][149, 4, 1] = 1e6  # beyond half's range
    window = PixelWindow(-2, -70, 5, 150)
    names = tuple("RGBAuv")
    path.write_bytes(encode_exr(path, names, parts, names, {}, (window, window)))
    header, whole = read_header(path), np.concatenate(parts, axis=-1)
    assert [name for name in names if header.formats[name] == "float"] == ["v"]
    for i, (name, plane) in enumerate(images.read_channels(path, names).items()):
        np.testing.assert_array_equal(plane, whole[..., i].astype(np.float32 if name == "v" else np.float16))
    parts[2][7, 3, 0] = np.nan
    with pytest.raises(ValueError, match=r"a\.exr: channel u: 1 non-finite values, first at \(y=7, x=3\)"):
        encode_exr(path, names, parts, names, {})


def test_a_signalling_nan_is_read_as_a_quiet_one(tmp_path):
    """Before a cast, at which NumPy warns of one."""
    plane = np.ones((3, 5), np.float32)
    plane.view(np.uint32)[1, 2] = 0x7FA00000
    write_raw(tmp_path / "a.exr", {"depth.Z": plane, "R": np.ones((3, 5), np.float32)})
    read = images.read_channels(tmp_path / "a.exr", ["depth.Z"])["depth.Z"]
    assert np.isnan(read).sum() == 1
    assert np.isnan(read[1, 2])
    assert read.copy().view(np.uint32)[1, 2] & 0x400000


def test_whole_numbers_keep_their_value(tmp_path):
    ids = np.arange(12, dtype=np.uint32).reshape(3, 4, 1) * 1000
    write_parts(tmp_path / "a.exr", (ids, ("id",), {}))
    np.testing.assert_array_equal(images.read_channels(tmp_path / "a.exr", ["id"])["id"], ids[..., 0])


def test_whole_numbers_that_run_together_are_refused(tmp_path):
    ids = np.full((3, 4, 1), 2**24, np.uint32)
    write_parts(tmp_path / "a.exr", (ids, ("id",), {}))
    assert images.read_channels(tmp_path / "a.exr", ["id"])["id"].max() == 2**24
    ids = np.repeat(ids, 20, axis=0)
    ids[37, 2] += 1
    ids[59, 1] += 1
    write_parts(tmp_path / "a.exr", (ids, ("id",), {}))
    with pytest.raises(
        InputError, match=r"channel id: expected whole numbers up to 16777216, .*; found 16777217 at \(y=37, x=2\)"
    ):
        images.read_channels(tmp_path / "a.exr", ["id"])


@pytest.mark.parametrize("suffix", [".exr", ".png"])
def test_no_truncated_file_is_read_and_nothing_is_printed(tmp_path, suffix):
    """At any length, also where only the last pixels are gone."""
    whole = tmp_path / f"a{suffix}"
    images.write_rgb(whole, np.random.default_rng(0).random((40, 30, 3)))
    data = whole.read_bytes()
    lengths = sorted({*range(0, len(data), 61), *range(len(data) - 20, len(data))})
    for length in lengths:
        (tmp_path / f"cut{length}{suffix}").write_bytes(data[:length])
    code = (
        "import sys, pathlib\nfrom stss_ground.errors import InputError\nfrom stss.images.read_write import read_rgb\n"
        "for path in pathlib.Path(sys.argv[1]).glob('cut*'):\n"
        "    try:\n        read_rgb(path)\n        print('read', path)\n    except InputError as error:\n"
        "        assert str(error).startswith(str(path)) and '\\n' not in str(error), error\n"
    )
    process = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False)
    assert (process.stdout, process.stderr, process.returncode) == ("", "", 0)
    assert len(lengths) > 50


@pytest.mark.parametrize("order", ["increasingY", "decreasingY", "randomY"])
@pytest.mark.parametrize("tile", [0, 16])
def test_a_file_that_ends_early_is_seen_by_its_header(tmp_path, order, tile):
    """In whatever order its chunks lie, so that no pixel need be read; a whole file is none."""
    path, spec = tmp_path / "a.exr", oiio.ImageSpec(70, 90, 3, "half")
    spec.attribute("openexr:lineOrder", order)
    spec.tile_width = spec.tile_height = tile
    with closing(oiio.ImageOutput.create(str(path))) as file:
        assert file.open(str(path), spec)
        assert file.write_image(np.random.default_rng(0).random((90, 70, 3), np.float32))
    assert read_header(path).size == (90, 70)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"a\.exr: truncated or corrupt: pixels are missing behind its"):
        read_header(path)
    path.write_bytes(whole[:100])  # within the header, which tells nothing of pixels
    with pytest.raises(InputError, match=r"a\.exr: header cannot be read"):
        read_header(path)


def test_a_part_of_a_picture_has_nothing_around_it(tmp_path):
    path = tmp_path / "a.exr"
    images.write_rgb(path, np.ones((3, 4, 3)))
    window = struct.pack("<4i", 0, 0, 3, 2)
    path.write_bytes(
        path.read_bytes().replace(
            b"displayWindow\0box2i\0\x10\0\0\0" + window,
            b"displayWindow\0box2i\0\x10\0\0\0" + window[:8] + struct.pack("<2i", 9, 9),
        )
    )
    assert images.read_header(path).size == (10, 10)
    image = images.read_rgb(path)
    assert image.shape == (10, 10, 3)
    assert (image[:3, :4] == 1).all()
    assert image.sum() == 3 * 3 * 4


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.exr", None, "No such file"),
        ("a.exr", b"\x89PNG\r\n\x1a\n", "expected an EXR, found a PNG"),
        ("a.png", b"\xff\xd8\xff\xe0" + bytes(99), "expected a PNG, found a JPEG"),
        ("a.exr", b"", "expected an EXR, found 0 bytes"),
        ("a.exr", b"<html>404</html>", "expected an EXR, found another kind of file"),
        ("a.exr", b"\x76\x2f\x31\x01\2\0\0\0channels\0chlist\0\xa2\1\0\0R\0", "its header goes on behind its 30 bytes"),
        ("a.tif", b"II*\0", r"expected an \.exr or \.png file"),
    ],
)
def test_other_files_are_refused(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        images.read_header(tmp_path / name)


def test_png_holds_display_values_and_texts(tmp_path):
    path = tmp_path / "a.png"
    picture = (np.arange(256, dtype=np.float32) / 255).reshape(16, 16)[..., None] * np.ones(3, dtype=np.float32)
    texts = {"stss:key": 'é {"a": 1}\nb', "Software": "stss", "stss:long": "z" * 100_000}
    images.write_rgb(path, picture, metadata=texts)
    image = images.read_rgb(path)
    np.testing.assert_array_equal(np.rint(image * 255), np.rint(picture * 255))
    assert texts.items() <= images.read_header(path).attributes.items()
    images.write_rgb(path, image)
    np.testing.assert_array_equal(images.read_rgb(path), image)
    values = np.array([-1, 0.49 / 255, 0.51 / 255, 254.51 / 255, 7])
    images.write_rgb(path, np.broadcast_to(values[None, :, None], (1, 5, 3)))
    np.testing.assert_array_equal(np.rint(images.read_rgb(path)[0, :, 0] * 255), [0, 0, 1, 255, 255])


def test_transparency_does_not_darken(tmp_path):
    """OpenImageIO would multiply by alpha."""
    pixels = np.full((2, 2, 4), (255, 51, 0, 51), np.uint8)
    write_parts(tmp_path / "a.png", (pixels, tuple("RGBA"), {"oiio:UnassociatedAlpha": (1,)}))
    np.testing.assert_array_equal(np.rint(images.read_rgb(tmp_path / "a.png") * 255), pixels[..., :3])


def test_rgb_comes_from_one_layer(tmp_path):
    path = tmp_path / "a.exr"
    pixels = planes("X.Combined.R", "X.Combined.G", "X.Combined.B", "X.base.R", "X.base.G", "X.base.B")
    images.write_channels(path, pixels)
    np.testing.assert_array_equal(images.read_rgb(path)[..., 2], pixels["X.Combined.B"])
    images.write_channels(path, planes("a.R", "a.G", "a.B", "b.R", "b.G", "b.B"))
    with pytest.raises(InputError, match="expected channels R, G, B or one layer"):
        images.read_rgb(path)


@pytest.mark.parametrize("layer", ["", "X."])
def test_rgb_may_be_in_lower_case(tmp_path, layer):
    """A matte beside the picture, which Cryptomatte writes in lower case, is none."""
    path = tmp_path / "a.exr"
    pixels = planes(*(layer + letter for letter in "rgb"))
    images.write_channels(path, pixels)
    np.testing.assert_array_equal(images.read_rgb(path)[..., 2], pixels[layer + "b"])
    pixels = planes(*(layer + letter for letter in "RGB"), "matte.r", "matte.g", "matte.b")
    images.write_channels(path, pixels)
    np.testing.assert_array_equal(images.read_rgb(path)[..., 2], pixels[layer + "B"])


def test_parts_are_one_file(tmp_path):
    """A channel whose name another part has too goes by its part's name."""
    path, parts = tmp_path / "a.exr", (("rgb", "RGB", 0.5), ("depth", "Z", 1.5), ("normal", "RGB", 2.5))
    write_parts(
        path, *((np.full((4, 5, len(n)), x, np.float32), tuple(n), {"oiio:subimagename": (part,)}) for part, n, x in parts)
    )
    assert images.read_header(path).channels == ("R", "G", "B", "Z", "normal.R", "normal.G", "normal.B")
    channels = images.read_channels(path, ["normal.G", "R", "Z"])
    assert [plane[0, 0] for plane in channels.values()] == [2.5, 0.5, 1.5]


@pytest.mark.parametrize(
    ("parts", "picture"),
    [
        (("N", "albedo", "C"), "C"),
        (("CryptoObject00", "rgba"), "rgba"),
        (("depth_main", "rgba_main"), "rgba_main"),
        (("ViewLayer.Normal", "ViewLayer.Combined"), "ViewLayer.Combined"),
        (("N", "albedo"), None),
    ],
)
def test_the_picture_is_the_part_of_its_name_not_the_first(tmp_path, parts, picture):
    """Houdini names the channels of every part R, G, B, and the picture's part C, the last one."""
    path = tmp_path / "a.exr"
    filled = [np.full((2, 3, 3), x, np.float32) for x in range(len(parts))]
    write_parts(path, *((p, tuple("RGB"), {"oiio:subimagename": (name,)}) for p, name in zip(filled, parts, strict=True)))
    others = {f"{part}.{c}" for part in parts if part != picture for c in "RGB"}
    assert {*images.read_header(path).channels} == others | ({*"RGB"} if picture else set())
    if picture:
        assert (images.read_rgb(path) == parts.index(picture)).all()
    else:
        with pytest.raises(InputError, match=r"expected channels R, G, B or one layer with them; it has N\.R, N\.G"):
            images.read_rgb(path)


def test_sixteen_bits_have_the_levels_of_eight(tmp_path):
    levels = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, axis=2)
    write_parts(tmp_path / "a.png", (levels, tuple("RGB"), {}))
    write_parts(tmp_path / "b.png", (levels.astype(np.uint16) * 257, tuple("RGB"), {}))
    for name in ("a.png", "b.png"):
        np.testing.assert_array_equal(to_8bit(images.read_rgb(tmp_path / name)), levels)


@pytest.mark.parametrize("name", ["a.exr", "a.png"])
def test_equal_pictures_are_equal_files(tmp_path, name):
    picture = np.random.default_rng(0).random((8, 8, 3))
    images.write_rgb(tmp_path / name, picture, metadata={"a": "b"})
    (tmp_path / "b").mkdir()
    images.write_rgb(tmp_path / "b" / name, picture, metadata={"a": "b"})
    assert (tmp_path / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert not images.read_header(tmp_path / name).attributes.get("DateTime")


@pytest.mark.parametrize(("name", "value"), [("a.exr", np.nan), ("a.png", np.inf)])
def test_nothing_non_finite_is_written(tmp_path, name, value):
    picture = np.zeros((2, 3, 3))
    images.write_rgb(tmp_path / name, picture)
    before = (tmp_path / name).read_bytes()
    picture[1, 2, 1] = value
    with pytest.raises(ValueError, match=r"a\.\w+: channel G: 1 non-finite values, first at \(y=1, x=2\)"):
        images.write_rgb(tmp_path / name, picture)
    assert (tmp_path / name).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_half_does_not_overflow(tmp_path):
    """Where half would become infinite, the channel is float."""
    picture = np.full((2, 2, 3), 1.5)
    picture[0, 0, 0], picture[1, 0, 2] = 1e6, -1e6
    images.write_rgb(tmp_path / "a.exr", picture)
    assert images.read_header(tmp_path / "a.exr").formats == {"R": "float", "G": "half", "B": "float"}
    np.testing.assert_array_equal(images.read_rgb(tmp_path / "a.exr"), picture)


def write_with_fog(path, *names):
    """Parts of these names, of which OpenImageIO writes flat ones alone: "fog" is made deep in the header."""
    pixels = np.full((3, 4, 3), 0.25, np.float32)
    write_parts(
        path, *((pixels, ("R", "G", "B"), {"oiio:subimagename": ("string", n), "compression": ("string", "zips")}) for n in names)
    )
    data = bytearray(path.read_bytes())
    data[5] |= 0x08  # the version's flag for files with deep parts
    at = data.index(b"\3\0\0\0fog")
    for old, new in (
        (b"\r\0\0\0scanlineimage", b"\x0c\0\0\0deepscanline"),
        (b"\3\0\0\0fog", b"\4\0\0\0fog2"),
    ):  # as long as before
        place = data.index(old, at)
        data[place : place + len(old)] = new
    path.write_bytes(data)


@pytest.mark.parametrize("names", [("flat", "fog"), ("fog", "flat")], ids=" ".join)
def test_a_deep_part_beside_flat_ones_is_passed_over(tmp_path, names):
    """Nothing here reads the depths of several surfaces in one pixel."""
    write_with_fog(tmp_path / "a.exr", *names)
    assert read_header(tmp_path / "a.exr").channels == ("R", "G", "B")
    assert (images.read_rgb(tmp_path / "a.exr") == 0.25).all()


def test_a_file_that_is_deep_alone_is_refused(tmp_path):
    spec, deep = oiio.ImageSpec(4, 3, 1, "float"), oiio.DeepData()
    spec.deep = True
    deep.init(12, 1, (oiio.TypeDesc("float"),), ("Z",))
    output = oiio.ImageOutput.create(str(tmp_path / "a.exr"))
    assert output.open(str(tmp_path / "a.exr"), spec)
    assert output.write_deep_image(deep)
    output.close()
    with pytest.raises(InputError, match=r"a\.exr: deep image; expected flat channels"):
        read_header(tmp_path / "a.exr")

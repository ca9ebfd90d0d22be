"""Image files of every format and depth: masks by threshold, colours on black, headers before pixels."""

import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from gsim3d.data import Scene
from gsim3d.data.check import check_scene
from gsim3d.data.headers import read_header
from gsim3d.data.images import as_color, as_labels, as_mask, read_image
from gsim3d.data.recording import MOVING, Problems
from gsim3d.errors import InputError
from tests.data.made_scenes import edit_json, make_scene, write_genesis, write_transforms, write_videos

SIZE = (64, 48)


def discs(value=255, dtype=np.uint8) -> np.ndarray:
    mask = np.zeros(SIZE[::-1], dtype)
    for x, y, radius in ((32, 24, 9), (10, 40, 4)):
        cv2.circle(mask, (x, y), radius, value, -1)
    return mask


def stored(folder, name, image, *options) -> np.ndarray:
    """The pixels of an image that was written and read."""
    assert cv2.imwrite(str(folder / name), image, options)
    return read_image(folder / name, SIZE, "camera a, frame 0", Problems())


def moving(image, file) -> np.ndarray:
    return as_mask(image, file, "camera a, frame 0", Problems()) == MOVING


MASKS = {
    "jpeg 95": ("m.jpg", lambda m: m, (cv2.IMWRITE_JPEG_QUALITY, 95)),
    "jpeg 75": ("m.jpg", lambda m: m, (cv2.IMWRITE_JPEG_QUALITY, 75)),
    "jpeg 90, red": ("m.jpg", lambda m: cv2.merge([m * 0, m * 0, m]), (cv2.IMWRITE_JPEG_QUALITY, 90)),
    "jpeg 30, colour": ("m.jpg", lambda m: cv2.merge([m] * 3), (cv2.IMWRITE_JPEG_QUALITY, 30)),
    "webp 80": ("m.webp", lambda m: cv2.merge([m] * 3), (cv2.IMWRITE_WEBP_QUALITY, 80)),
    "png": ("m.png", lambda m: m, ()),
    "png of 0 and 1": ("m.png", lambda m: m // 255, ()),
    "png, red": ("m.png", lambda m: cv2.merge([m * 0, m * 0, m // 255 * 200]), ()),
    "png, 16 bits": ("m.png", lambda m: m.astype(np.uint16) * 257, ()),
    "png, white with alpha": ("m.png", lambda m: cv2.merge([m * 0 + 255] * 3 + [m]), ()),
    "tif": ("m.tif", lambda m: m, ()),
    "tiff, 16 bits": ("m.tiff", lambda m: m.astype(np.uint16) * 257, ()),
    "the range of video": ("m.png", lambda m: 16 + m // 255 * 219, ()),
}


@pytest.mark.parametrize("kind", MASKS)
def test_as_mask_thresholds_two_values_at_half(tmp_path, kind):
    name, convert, options = MASKS[kind]
    got = moving(stored(tmp_path, name, convert(discs()), *options), tmp_path / name)
    wrong = (got != (discs() > 0)).sum()
    assert wrong <= (16 if "red" in kind and "jpeg" in kind else 6 if "30" in kind or "webp" in kind else 0)


@pytest.mark.parametrize("quality", [100, 95, 75, 50])
def test_as_mask_ignores_compression_noise(tmp_path, quality):
    noisy = stored(tmp_path, "m.jpg", discs(), cv2.IMWRITE_JPEG_QUALITY, quality)
    for image in (noisy, noisy.astype(np.uint16) * 257):
        np.testing.assert_array_equal(moving(stored(tmp_path, "m.png", image), tmp_path / "m.png"), discs() > 0)


def test_as_mask_cuts_soft_borders_at_half(tmp_path):
    soft = cv2.GaussianBlur(discs(), (0, 0), 0.7)
    np.testing.assert_array_equal(moving(soft, tmp_path / "m.png"), soft > 127)


@pytest.mark.parametrize("ids", [(1, 2), (1, 3), (7, 15), (85, 170), (128, 255), (1, 255), (300, 400)])
def test_as_mask_sets_labels_other_than_zero(tmp_path, ids):
    labels = discs(ids[0], np.uint16 if max(ids) > 255 else np.uint8)
    cv2.rectangle(labels, (40, 5), (60, 15), ids[1], -1)
    cv2.rectangle(labels, (2, 2), (9, 9), max(ids) // 2 + 1, -1)
    np.testing.assert_array_equal(moving(stored(tmp_path, "m.png", labels), tmp_path / "m.png"), labels > 0)


def test_as_mask_refuses_photos(tmp_path):
    ramp = np.tile(np.linspace(0, 255, 64).astype(np.uint8), (48, 1))
    noise = np.random.default_rng(0).integers(0, 256, SIZE[::-1]).astype(np.uint8)
    three = discs()
    cv2.rectangle(three, (40, 5), (60, 15), 120, -1)
    three_lossy = stored(tmp_path, "m.jpg", three)
    for image, name in ((ramp, "m.png"), (noise, "m.png"), (three_lossy, "m.jpg"), (three_lossy, "m.png"),
                        (discs(100), "m.jpg"), (discs(2), "m.jpg"),
                        (three // 40, "m.jpg"), (np.full_like(ramp, 120), "m.png")):  # fmt: skip
        with pytest.raises(InputError, match=rf"{name} \(camera a, frame 0\) is not a mask"):
            moving(image, tmp_path / name)
    assert not moving(np.zeros_like(ramp), tmp_path / "m.jpg").any()
    assert moving(np.full_like(ramp, 255), tmp_path / "m.jpg").all()


@pytest.mark.parametrize(
    "name, quality", [("m.jpg", 95), ("m.jpg", 80), ("m.webp", 80), ("m.webp", 101), ("m.png", 95)]
)
@pytest.mark.parametrize("ids", [(40, 200), (60, 255), (30, 250)])
def test_as_mask_refuses_lossy_labels(tmp_path, name, quality, ids):
    """Thresholded at half, the smaller label would be lost."""
    labels = discs(ids[1])
    cv2.circle(labels, (50, 8), 7, ids[0], -1)
    kind = cv2.IMWRITE_WEBP_QUALITY if name == "m.webp" else cv2.IMWRITE_JPEG_QUALITY
    image = stored(tmp_path, "m.jpg" if name == "m.png" else name, labels, kind, quality)
    with pytest.raises(InputError, match=rf"{name} \(camera a, frame 0\) is not a mask"):
        moving(image, tmp_path / name)


def test_scene_with_jpeg_masks(tmp_path):
    folder, made = write_videos(tmp_path, make_scene(width=64, height=48)), make_scene(width=64, height=48)
    (folder / "labels").rename(folder / "masks")
    for file in list((folder / "masks").rglob("*.png")):
        mask = (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) == 3).astype(np.uint8) * 255
        assert cv2.imwrite(str(file.with_suffix(".jpg")), mask)
        file.unlink()
    scene = Scene.open(folder)
    np.testing.assert_array_equal(scene.segmentation(range(3), range(4)) == MOVING, made.labels == MOVING)
    file = folder / "masks" / "cam_1" / "004.jpg"
    cv2.imwrite(str(file), np.tile(np.linspace(0, 255, 64).astype(np.uint8), (48, 1)))
    assert any("004.jpg (camera cam_1, frame 4) is not a mask" in line for line in check_scene(folder).problems)


COLOUR = np.random.default_rng(1).integers(0, 256, (*SIZE[::-1], 3), dtype=np.uint8)
ALPHA = np.random.default_rng(2).integers(0, 256, SIZE[::-1], dtype=np.uint8)


@pytest.mark.parametrize("name", ["a.png", "a.tif", "a.tiff", "a.webp"])
@pytest.mark.parametrize("deep", [False, True])
def test_as_color_of_8_and_16_bits_with_and_without_alpha(tmp_path, name, deep):
    if deep and name == "a.webp":
        pytest.skip("WebP has 8 bits")
    scale = 257 if deep else 1
    rgba = np.concatenate([COLOUR, ALPHA[..., None]], -1)
    for image in (COLOUR, rgba, COLOUR[..., 1]):
        bgr = image if image.ndim == 2 else image[..., [2, 1, 0, 3][: image.shape[2]]]
        wide = (bgr.astype(np.uint16) * scale) if deep else np.ascontiguousarray(bgr)
        got = as_color(stored(tmp_path, name, wide, cv2.IMWRITE_WEBP_QUALITY, 101), tmp_path / name, "", Problems())
        wanted = np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image[..., :3]
        if image is rgba:
            wanted = wanted * (ALPHA[..., None] / 255)
        seen = ALPHA > 0 if image is rgba else np.ones_like(ALPHA, bool)  # WebP drops invisible colours
        assert got.dtype == np.uint8 and np.abs(got.astype(float) - wanted)[seen].max() <= 0.51
        assert not got[~seen].any() or image is not rgba


@pytest.mark.parametrize("layout, pattern", [("transforms", "images/**/*.png"), ("videos", "cam_*/*.png")])
@pytest.mark.parametrize("deep", [False, True])
def test_alpha_is_the_mask_of_scenes_without_masks(tmp_path, layout, pattern, deep):
    made = make_scene()
    folder = {"transforms": write_transforms, "videos": write_videos}[layout](tmp_path, made)
    for file in folder.glob(pattern):
        image = cv2.imread(str(file))
        cut = (image == [20, 90, 250]).all(-1)
        image[~cut] = (40, 30, 20)  # colours under alpha 0
        rgba = np.concatenate([image, cut[..., None] * np.uint8(255)], -1)
        cv2.imwrite(str(file), rgba.astype(np.uint16) * 257 if deep else rgba)
    (folder / "labels").rename(folder / "elsewhere")
    if layout == "transforms":
        edit_json(folder / "transforms.json", lambda content: [f.pop("label_path") for f in content["frames"]])
    scene = Scene.open(folder)
    labels = scene.segmentation(range(3), range(4)).numpy()
    np.testing.assert_array_equal(labels, np.where(made.labels == MOVING, MOVING, 0))
    video = scene.recorded_images(range(3), range(4)).permute(0, 1, 3, 4, 2).numpy()
    np.testing.assert_array_equal(video, np.where((made.labels == MOVING)[..., None], made.rgb, 0))


def test_opaque_videos_have_no_mask(tmp_path):
    folder = write_videos(tmp_path, make_scene())
    (folder / "labels").rename(folder / "elsewhere")
    for file in folder.glob("cam_*/*.png"):
        cv2.imwrite(str(file), cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2BGRA))
    assert not Scene.open(folder).has_segmentation()


def test_read_header_of_every_format(tmp_path):
    rgba = np.concatenate([COLOUR, ALPHA[..., None]], -1)
    for name, image, alpha, options in (
        ("a.png", COLOUR, False, ()), ("a.png", rgba, True, ()), ("a.jpg", COLOUR, False, ()),
        ("a.webp", COLOUR, False, ()), ("a.webp", rgba, True, ()), ("a.webp", rgba, True, (64, 101)),
        ("a.webp", COLOUR, False, (64, 101)), ("a.tif", COLOUR, False, ()), ("a.tif", rgba, True, ()),
        ("a.tif", COLOUR, False, (cv2.IMWRITE_TIFF_COMPRESSION, 1)),
    ):  # fmt: skip
        assert cv2.imwrite(str(tmp_path / name), image, options)
        data = (tmp_path / name).read_bytes()
        header = read_header(data)
        assert (header.size, header.whole, header.alpha, header.refused) == (SIZE, True, alpha, ""), name
        for cut in (5, 20, 30, len(data) // 2, len(data) - 13):
            short = read_header(data[:cut])
            assert short is None or not short.whole or name == "a.tif", (name, cut)


@pytest.mark.parametrize("chunk", [8, 33])
def test_read_header_refuses_png_chunks_beyond_the_file(chunk, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), COLOUR)
    data = bytearray((tmp_path / "a.png").read_bytes())
    for claimed in (len(data), 2**31 - 1, 2**32 - 1):
        data[chunk : chunk + 4] = struct.pack(">I", claimed)
        (tmp_path / "a.png").write_bytes(data)
        assert not read_header(bytes(data)).whole
        with pytest.raises(InputError, match="it is truncated"):
            read_image(tmp_path / "a.png", SIZE, "camera a, frame 0", Problems())


def big_endian_tiff() -> bytes:
    entries = [(256, 3, SIZE[0]), (257, 3, SIZE[1]), (258, 3, 8), (259, 3, 1), (262, 3, 1), (273, 4, 8),
               (277, 3, 1), (278, 3, SIZE[1]), (279, 4, SIZE[0] * SIZE[1])]  # fmt: skip
    pixels = discs().tobytes()
    tags = b"".join(
        struct.pack(">HHI", tag, kind, 1) + (struct.pack(">HH", value, 0) if kind == 3 else struct.pack(">I", value))
        for tag, kind, value in entries
    )
    return b"MM\0*" + struct.pack(">I", 8 + len(pixels)) + pixels + struct.pack(">H", len(entries)) + tags + bytes(4)


def test_read_header_of_tiff_byte_orders_and_pages(tmp_path):
    file = tmp_path / "a.tif"
    file.write_bytes(big_endian_tiff())
    np.testing.assert_array_equal(read_image(file, SIZE, "", Problems()), discs())
    file.write_bytes(big_endian_tiff()[:-60])
    with pytest.raises(InputError, match="cannot be decoded"):
        read_image(file, SIZE, "", Problems())
    rows, orientation = struct.pack(">HHI", 278, 3, 1), struct.pack(">HHI", 274, 3, 1)  # optional here
    file.write_bytes(big_endian_tiff().replace(rows, orientation))
    with pytest.raises(InputError, match="rotated by its orientation tag"):
        read_image(file, SIZE, "", Problems())
    white_is_zero = big_endian_tiff().replace(struct.pack(">HHIH", 262, 3, 1, 1), struct.pack(">HHIH", 262, 3, 1, 0))
    file.write_bytes(white_is_zero)
    with pytest.raises(InputError, match="inverted"):
        read_image(file, SIZE, "", Problems())
    assert cv2.imwritemulti(str(file), [COLOUR, COLOUR])
    with pytest.raises(InputError, match="several pages"):
        read_image(file, SIZE, "", Problems())
    assert cv2.imwrite(str(file), COLOUR.astype(np.float32))
    with pytest.raises(InputError, match="8 or 16 bits per channel; got float32"):
        read_image(file, SIZE, "", Problems())


def test_as_labels_refuses_lossy_files(tmp_path):
    labels = discs(3)
    for name in ("a.png", "a.tif"):
        for dtype in (np.uint8, np.uint16):
            got = as_labels(stored(tmp_path, name, labels.astype(dtype)), tmp_path / name, "", Problems())
            assert got.dtype == np.uint8 and (got == labels).all()
    for name, image in (("a.jpg", labels), ("a.png", labels.astype(np.uint16) * 100)):
        with pytest.raises(InputError, match="lossless"):
            as_labels(stored(tmp_path, name, image), tmp_path / name, "", Problems())


def test_genesis_rgba_is_composed_on_black(tmp_path):
    folder, made = write_genesis(tmp_path, make_scene()), make_scene()
    for file in folder.rglob("rgb_*.png"):
        image = cv2.imread(str(file))
        cv2.imwrite(str(file), np.concatenate([image, np.full((*image.shape[:2], 1), 51, np.uint8)], -1))
    got = Scene.open(folder).images(range(3), range(4)).permute(0, 1, 3, 4, 2).numpy()
    assert np.abs(got - made.rgb * 0.2).max() <= 0.51


@pytest.mark.parametrize("color", [0, 90, 255])
def test_as_mask_of_one_colour_is_its_alpha(tmp_path, color):
    mask = discs()
    image = cv2.merge([np.full_like(mask, color)] * 3 + [mask])
    assert (moving(stored(tmp_path, "m.png", image), tmp_path / "m.png") == (mask > 0)).all()
    image[..., 3] = 255  # opaque: the colour says it
    if color == 90:
        pytest.raises(InputError, moving, stored(tmp_path, "m.png", image), tmp_path / "m.png")
        return
    assert moving(stored(tmp_path, "m.png", image), tmp_path / "m.png").all() == (color > 0)


def test_as_mask_keeps_small_bodies_beside_large_ones(tmp_path):
    mask = discs()
    mask[5:7, 20:40], mask[40:42, 50:52] = 90, 17
    assert (moving(stored(tmp_path, "m.png", mask), tmp_path / "m.png") == (mask > 0)).all()


def test_transparent_labels_are_background(tmp_path):
    labels = np.full(SIZE[::-1], MOVING, np.uint8)
    image = stored(tmp_path, "m.png", cv2.merge([labels] * 3 + [discs()]))
    read = as_labels(image, tmp_path / "m.png", "", Problems())
    assert ((read == MOVING) == (discs() > 0)).all() and not read[discs() == 0].any()


def test_cmyk_and_animated_images_are_refused(tmp_path):
    picture = Image.fromarray(discs())
    picture.convert("CMYK").save(tmp_path / "a.jpg")
    picture.save(tmp_path / "a.png", save_all=True, append_images=[Image.fromarray(255 - discs())])
    picture.convert("RGB").save(tmp_path / "a.webp", save_all=True, append_images=[Image.new("RGB", SIZE)])
    for name, message in (("a.jpg", "is CMYK"), ("a.png", "is animated"), ("a.webp", "is animated")):
        with pytest.raises(InputError, match=f"{name} .*{message}"):
            read_image(tmp_path / name, SIZE, "", Problems())


@pytest.mark.parametrize("values", [1, 255, 1023, 4095])
def test_16_bit_images_of_8_to_12_bit_values_are_refused(tmp_path, values):
    image = stored(tmp_path, "m.png", discs(values, np.uint16))
    with pytest.raises(InputError, match=f"m.png .*no value above {values}; scale"):
        as_color(image, tmp_path / "m.png", "camera a, frame 0", Problems())
    assert not as_color(image * 0, tmp_path / "m.png", "", Problems()).any()

"""Formats of Gaussians: bounds of every field, golden bytes, foreign readers, sequences, damage."""

import dataclasses
import gzip
import json
import re
import struct
import tracemalloc

import numpy as np
import pytest
import torch

from gsim3d.cameras import Cameras
from gsim3d.cli.main import main
from gsim3d.compat.gsplat import rasterization
from gsim3d.errors import FitWarning, InputError
from gsim3d.io import FORMATS, orbit, read_splats, write_ply, write_splats
from gsim3d.io.arrays import Y_TO_Z_UP, Z_TO_Y_UP, splats_of, turned
from gsim3d.io.orbit import camera_around, orbit_frames
from gsim3d.io.sequence import open_sequence, write_about
from gsim3d.ops import rasterize_gaussians
from gsim3d.state import Gaussians
from tests.io.spz_files import spz_4

WITHOUT_USD = [suffix for suffix in FORMATS if not suffix.startswith(".usd")]
COUNTS = (1, 255, 256, 257)
# Largest errors: position [m, of a scene of about 5 m], angle, log-scale, opacity, constant and other coefficients.
BOUNDS = {
    ".ply": (0, 3e-3, 1e-6, 1e-6, 0, 0),
    ".splat": (0, 3e-2, 0, 2e-3, 7e-3, None),
    ".compressed.ply": (2.5e-3, 5e-3, 2e-3, 2e-3, 6e-3, 1.6e-2),
    ".spz": (1.3e-4, 5e-3, 3.2e-2, 2e-3, 1.31e-2, 7e-2),
    ".glb": (0, 3e-3, 0, 0, 0, 1e-6),
    ".usdc": (0, 3e-3, 0, 0, 0, 0),
    ".usda": (0, 3e-3, 0, 0, 0, 0),
}


def make(count, degree, seed=0):
    g = torch.Generator().manual_seed(seed)
    constant = torch.rand(count, 1, 3, generator=g) * 3 - 1.5  # colours in [0, 1]: .splat clamps others
    rest = (torch.rand(count, (degree + 1) ** 2 - 1, 3, generator=g) - 0.5) * 1.8
    return Gaussians(
        means=torch.rand(count, 3, generator=g) * 5 - 2.5,
        quats=torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1),
        scales=torch.exp(torch.rand(count, 3, generator=g) * 4 - 6),
        opacities=torch.rand(count, generator=g) * 0.98 + 0.01,
        sh=torch.cat([constant, rest], 1),
        cu_rows=torch.tensor([0, count]),
    )


def needs(suffix):
    if suffix.startswith(".usd"):
        pytest.importorskip("pxr", reason="usd-core is not installed")


def partners(read, given):
    """Row of ``given`` of each row read: some formats sort."""
    return torch.cdist(read.means.double(), given.means.double()).argmin(1)


def assert_within_bounds(suffix, read, given):
    position, angle, scale, opacity, constant, rest = BOUNDS[suffix]
    of = partners(read, given)
    assert sorted(of.tolist()) == list(range(len(given.means)))
    n_kept = min(given.sh.shape[1], (FORMATS[suffix].most_degree + 1) ** 2)
    assert read.sh.shape == (len(given.means), n_kept, 3)
    assert (read.means - given.means[of]).abs().max() <= position
    turn = (read.quats.double() * given.quats[of].double()).sum(1).abs().clamp(max=1).arccos() * 2
    assert turn.max() <= angle
    assert (read.scales.log() - given.scales[of].log()).abs().max() <= scale
    assert (read.opacities - given.opacities[of]).abs().max() <= opacity
    errors = (read.sh - given.sh[of, :n_kept]).abs()
    assert errors[:, 0].max() <= constant
    assert n_kept == 1 or errors[:, 1:].max() <= rest


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("suffix", FORMATS)
def test_formats_round_trip_within_their_bounds(suffix, degree, tmp_path):
    needs(suffix)
    for count in COUNTS:
        given, file = make(count, degree), tmp_path / f"{count}{suffix}"
        axes = {"up": "z"} if suffix == ".spz" else {}  # bounds hold in the axes of the file
        write_splats(file, given, **axes)
        assert_within_bounds(suffix, read_splats(file, **axes), given)


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix != ".glb"])
def test_formats_hold_zero_gaussians(suffix, tmp_path):
    needs(suffix)
    write_splats(tmp_path / f"none{suffix}", make(0, 1))
    assert read_splats(tmp_path / f"none{suffix}").means.shape == (0, 3)


GOLDEN = (
    "4e4753500300000002000000000c0000000800" "00ecff002000fcffff000000003c00" "80e1" "80a659cc6c89"
    "606850807c78" "de50aac4521e9d19"
)  # fmt: skip


def test_spz_has_golden_bytes(tmp_path):
    quats = torch.tensor([[0.9, 0.1, -0.2, 0.3], [-0.1, 0.6, 0.5, -0.4]])
    given = Gaussians(
        means=torch.tensor([[0.5, -1.25, 2], [-0.001, 0, 3.75]]),
        quats=quats / quats.norm(dim=1, keepdim=True),
        scales=torch.tensor([[-4, -3.5, -5], [-2, -2.25, -2.5]]).exp(),
        opacities=torch.sigmoid(torch.tensor([0.0, 2])),
        sh=torch.tensor([[[0.0, 1, -1]], [[2, -0.5, 0.25]]]),
        cu_rows=torch.tensor([0, 2]),
    )
    write_splats(tmp_path / "two.spz", given, up="z")
    assert gzip.decompress((tmp_path / "two.spz").read_bytes()).hex() == GOLDEN
    read = read_splats(tmp_path / "two.spz", up="z")
    assert read.means[1].tolist() == pytest.approx([-0.0009766, 0, 3.75], abs=1e-7)
    assert read.quats.flatten().tolist() == pytest.approx(
        [0.9237, 0.1024, -0.2048, 0.3072, -0.1135, 0.6798, 0.5660, -0.4525], abs=1e-4
    )
    assert torch.logit(read.opacities).tolist() == pytest.approx([0.0078, 2.0149], abs=1e-4)
    assert read.sh.flatten().tolist() == pytest.approx([0.0131, 1.0065, -1.0065, 2.0, -0.5098, 0.2484], abs=1e-4)


def spz(version=3, count=1, degree=0, body=b"", packed=True):
    content = struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, 12, 0, 0) + body
    return gzip.compress(content) if packed else content


def test_spz_of_version_2_is_read(tmp_path):
    body = bytes([0, 16, 0, 0, 240, 255, 0, 0, 0]) + bytes([255]) + bytes([128] * 3) + bytes([160] * 3)
    (tmp_path / "old.spz").write_bytes(spz(2, body=body + bytes([127, 127, 255])))
    read = read_splats(tmp_path / "old.spz", up="z")
    assert read.means.tolist() == [[1.0, -1.0, 0.0]] and read.opacities.tolist() == [1.0]
    assert read.scales.tolist() == [[1.0] * 3] and read.quats[0, 3] == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("suffix", [".splat", ".compressed.ply", ".spz", ".glb"])
def test_formats_without_world_offset_warn(suffix, tmp_path):
    offset = torch.tensor([[5e5, 4e6, 0.0]], dtype=torch.float64)
    gaussians = dataclasses.replace(make(3, 1), world_offset=offset)
    with pytest.warns(FitWarning, match=r"count from \(500000.00, 4000000.00, 0.00\) m .* not kept"):
        write_splats(tmp_path / f"a{suffix}", gaussians)


@pytest.mark.parametrize("up", [None, "y"])
def test_ply_keeps_world_offset_when_turned(up, tmp_path, recwarn):
    offset = torch.tensor([[5e5, 4e6, 0.0]], dtype=torch.float64)
    given = dataclasses.replace(make(3, 1), world_offset=offset)
    write_splats(tmp_path / "a.ply", given, up=up)
    read = read_splats(tmp_path / "a.ply", up=up)
    assert read.means.abs().max() < 10 and not recwarn.list
    torch.testing.assert_close(read.means + read.world_offset, given.means + offset, rtol=0, atol=2e-6)


@pytest.mark.parametrize("suffix", [".splat", ".glb", ".ply"])
def test_float32_positions_far_away_count_from_a_world_offset(suffix, tmp_path):
    given = make(3, 0)
    given = dataclasses.replace(given, means=(given.means + torch.tensor([500000.0, 4649776.0, 100.0])))
    write_splats(tmp_path / f"a{suffix}", given)
    read = read_splats(tmp_path / f"a{suffix}")
    assert read.means.abs().max() < 10 and read.world_offset is not None
    order = read.means[:, 0].argsort(), given.means[:, 0].argsort()  # .splat sorts by size
    torch.testing.assert_close((read.means + read.world_offset)[order[0]], given.means.double()[order[1]])


@pytest.mark.parametrize("degree, streams", [(0, 5), (1, 6)])
def test_spz_of_version_4_is_read(degree, streams, tmp_path):
    pytest.importorskip("zstandard", reason="zstandard is not installed")
    given = make(10, degree)
    write_splats(tmp_path / "three.spz", given)
    content = gzip.decompress((tmp_path / "three.spz").read_bytes())
    extension = struct.pack("<II", 0xADBE0002, 5) + b"orbit"
    (tmp_path / "four.spz").write_bytes(spz_4(content, extension=extension))
    three, four = read_splats(tmp_path / "three.spz"), read_splats(tmp_path / "four.spz")
    assert all(torch.equal(getattr(three, name), getattr(four, name)) for name in ("means", "quats", "scales", "sh"))
    (tmp_path / "four.spz").write_bytes(spz_4(content, 11 - streams))
    with pytest.raises(InputError, match="streams"):
        read_splats(tmp_path / "four.spz")


def test_spz_of_version_4_that_unpacks_to_too_much_is_refused(tmp_path):
    zstandard = pytest.importorskip("zstandard", reason="zstandard is not installed")
    write_splats(tmp_path / "a.spz", make(1, 0))
    good = spz_4(gzip.decompress((tmp_path / "a.spz").read_bytes()))
    bomb = zstandard.ZstdCompressor().compress(bytes(2**28))  # 256 MiB in 8 KiB
    size = struct.unpack_from("<Q", good, 32)[0]
    (tmp_path / "a.spz").write_bytes(
        good[:32] + struct.pack("<Q", len(bomb)) + good[40:112] + bomb + good[112 + size :]
    )
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="stream 0 holds more than 9 bytes"):
            read_splats(tmp_path / "a.spz")
        assert tracemalloc.get_traced_memory()[1] < 2**24
    finally:
        tracemalloc.stop()


def test_splat_record_by_hand(tmp_path):
    record = struct.pack("<6f", 1, 2, 3, 0.1, 0.2, 0.3) + bytes([255, 0, 51, 102]) + bytes([128, 255, 128, 128])
    (tmp_path / "one.splat").write_bytes(record)
    read = read_splats(tmp_path / "one.splat")
    assert read.means.tolist() == [[1, 2, 3]] and read.scales[0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    assert read.opacities.tolist() == pytest.approx([0.4]) and read.quats.tolist() == [[0, 1, 0, 0]]
    assert (0.5 + 0.28209479 * read.sh[0, 0]).tolist() == pytest.approx([1, 0, 0.2], abs=1e-6)


@pytest.mark.parametrize(
    "position, scale, says",
    [(np.nan, 0.1, "means holds values that are not finite"), (1, -0.1, "a scale is negative")],
)
def test_unusable_values_are_refused(position, scale, says, tmp_path):
    (tmp_path / "a.splat").write_bytes(struct.pack("<6f", position, 2, 3, 0.1, scale, 0.3) + bytes(8))
    with pytest.raises(InputError, match=f"a.splat: {says}"):
        read_splats(tmp_path / "a.splat")


@pytest.mark.parametrize("suffix", FORMATS)
def test_formats_render_alike(suffix, tmp_path):
    """At the degree of the shipped simulators: steps of .spz are twice as large above it."""
    needs(suffix)
    given = make(300, 0 if suffix == ".splat" else 1)
    write_splats(tmp_path / f"a{suffix}", given)
    view = torch.eye(4)
    view[2, 3] = 6
    first, second = (picture(splats_of(g, None, "a"), view) for g in (given, read_splats(tmp_path / f"a{suffix}")))
    psnr = -10 * np.log10(float((first - second).clamp(-1, 1).square().mean()) + 1e-12)
    assert psnr > (45 if suffix in (".spz", ".compressed.ply", ".splat") else 60), psnr


@pytest.mark.parametrize("degree", range(4))
def test_turned_splats_render_alike(degree):
    given = make(40, degree)
    splats = splats_of(given, None, "scene")
    other = turned(splats, Z_TO_Y_UP)
    assert other.means[:, 1] == pytest.approx(splats.means[:, 2], abs=1e-6)  # up stays up
    back = turned(other, Y_TO_Z_UP)
    for name in ("means", "sh"):
        assert np.abs(getattr(back, name) - getattr(splats, name)).max() < 1e-5
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    viewmat[2, 3] = 8
    turn = torch.eye(4)
    turn[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
    images = [picture(one, view) for one, view in ((splats, viewmat), (other, viewmat @ turn.T))]
    assert images[0].max() > 0.2 and (images[0] - images[1]).abs().max() < 1e-3


def picture(splats, viewmat):
    K, one = torch.tensor([[[60.0, 0, 32], [0, 60, 32], [0, 0, 1]]]), torch.ones(1)
    camera = Cameras(viewmat[None], K, one * 0.1, one * 20, torch.tensor([0]), 64, 64)
    fields = (torch.from_numpy(getattr(splats, name)) for name in ("means", "quats", "scales", "opacities"))
    return rasterize_gaussians(*fields, camera, sh=torch.from_numpy(splats.sh)).color


@pytest.mark.parametrize("suffix", WITHOUT_USD)
def test_truncated_files_are_refused_by_name(suffix, tmp_path):
    file = tmp_path / f"cut{suffix}"
    write_splats(file, make(3, 1))
    content = file.read_bytes()
    for length in range(0, len(content) - 1, 7):
        if suffix == ".splat" and length % 32 == 0:
            continue
        file.write_bytes(content[:length])
        with pytest.raises(InputError, match="cut"):
            read_splats(file)


@pytest.mark.parametrize(
    "content, says",
    [
        (spz(9, body=bytes(99)), "version 9"),
        (spz(3, count=2**31), "cannot lie in"),
        (spz(3, degree=7), "degree 7"),
        (spz(3, body=bytes(5)), "truncated"),
        (b"NGSP" + bytes(8), "truncated"),
        (b"\x1f\x8bnothing", "damaged"),
        (b"PLY", "not a .spz"),
    ],
    ids=["version", "count", "degree", "short", "short header", "not gzip", "not spz"],
)
def test_damaged_spz_is_refused(content, says, tmp_path):
    (tmp_path / "bad.spz").write_bytes(content)
    with pytest.raises(InputError, match=says):
        read_splats(tmp_path / "bad.spz")


def edited_glb(tmp_path, change):
    file = tmp_path / "a.glb"
    write_splats(file, make(3, 0))
    content = file.read_bytes()
    (length,) = struct.unpack_from("<I", content, 12)
    document = json.loads(content[20 : 20 + length])
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    head = struct.pack("<5I", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    file.write_bytes(head + text + rest)
    return file


def how(document):
    return document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]


@pytest.mark.parametrize(
    "change, says",
    [
        (lambda d: d["accessors"][0].update(count=10**9), "behind the file"),
        (lambda d: d["accessors"][0].update(count=2), "different counts"),
        (lambda d: d["accessors"][0].update(componentType=5123), "packed floats"),
        (lambda d: d["bufferViews"][0].update(byteOffset=-4), "an offset"),
        (lambda d: d["meshes"][0]["primitives"][0].pop("extensions"), "no primitive"),
        (lambda d: d["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "damaged"),
        (lambda d: d["nodes"][0].update(matrix=[1] * 16), "scale alike"),
        (lambda d: d["nodes"][0].update(matrix=[1]), "damaged"),
        (lambda d: d["nodes"][0].update(scale=[1, 2, 3]), "scale alike"),
        (lambda d: d["nodes"][0].update(scale=[-1, -1, -1]), "scale alike"),
        (lambda d: d["nodes"][0].update(rotation=[1, 1, 0, 0]), "no unit quaternion"),
        (lambda d: d["nodes"][0].update(translation=[float("nan"), 0, 0]), "scale alike"),
        (lambda d: d["nodes"][0].update(children=[0]), "no primitive"),
        (lambda d: d["scenes"].append({}), "several scenes"),
        (lambda d: how(d).update(colorSpace="lin_rec709_display"), "colorSpace 'lin"),
        (lambda d: how(d).update(kernel="box"), "kernel 'box'"),
        (lambda d: d.update(meshes=7), "damaged"),
    ],
)
def test_damaged_glb_is_refused(change, says, tmp_path):
    with pytest.raises(InputError, match=says):
        read_splats(edited_glb(tmp_path, change))


def test_glb_node_transform_is_applied(tmp_path):
    move = {"translation": [0, 5, 0], "scale": [2, 2, 2]}  # up in glTF's axes
    read = read_splats(edited_glb(tmp_path, lambda d: d["nodes"][0].update(move)))
    given = make(3, 0)
    torch.testing.assert_close(read.means, 2 * given.means + torch.tensor([0.0, 0, 5]))
    torch.testing.assert_close(read.scales, 2 * given.scales)


MATRIX = [2, 0, 0, 0, 0, 0, -2, 0, 0, 2, 0, 0, 0, 5, 0, 1]
GLB_PLACES = {
    "a parent": (lambda d: d["nodes"].append({"children": [0], "translation": [0, 5, 0]}), 1, (0, 0, 5)),
    "a matrix": (
        lambda d: d["nodes"][0].update(matrix=[2, 0, 0, 0, 0, 0, -2, 0, 0, 2, 0, 0, 0, 5, 0, 1]),
        2,
        (0, 0, 5),
    ),
    "far away": (lambda d: d["nodes"][0].update(translation=[5e5, 100, -4e6]), 1, (5e5, 4e6, 100)),
}


@pytest.mark.parametrize("kind", GLB_PLACES)
def test_glb_transforms_are_composed(kind, tmp_path):
    change, size, move = GLB_PLACES[kind]
    read, given = read_splats(edited_glb(tmp_path, change)), make(3, 0)
    world = read.means + (0 if read.world_offset is None else read.world_offset)
    expected = size * given.means.double() + torch.tensor(move, dtype=torch.float64)
    torch.testing.assert_close(world.double(), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(read.scales, size * given.scales)


@pytest.mark.parametrize("part", ["primitive", "node"])
def test_glb_reads_all_gaussians(part, tmp_path):
    def change(document):
        if part == "node":
            document["nodes"].append({**document["nodes"][0], "translation": [0, 5, 0]})
        else:
            document["meshes"][0]["primitives"] *= 2

    means = read_splats(edited_glb(tmp_path, change)).means.sort(0).values
    move = torch.tensor([0, 0, 5.0 if part == "node" else 0.0])
    torch.testing.assert_close(means, torch.cat([make(3, 0).means, make(3, 0).means + move]).sort(0).values)


def test_compressed_ply_is_recognised_by_content(tmp_path):
    write_splats(tmp_path / "a.compressed.ply", make(5, 0))
    (tmp_path / "a.compressed.ply").rename(tmp_path / "b.ply")
    assert read_splats(tmp_path / "b.ply").means.shape == (5, 3)


@pytest.mark.parametrize("name", [b"f_rest_0", b"f_rest_8"])
def test_compressed_ply_names_missing_harmonics(name, tmp_path):
    write_splats(tmp_path / "a.compressed.ply", make(5, 1))
    content = (tmp_path / "a.compressed.ply").read_bytes()
    (tmp_path / "a.compressed.ply").write_bytes(content.replace(name, b"f_rest_9", 1))
    with pytest.raises(InputError, match=f"lacks {name.decode()}"):
        read_splats(tmp_path / "a.compressed.ply")


def moving(n_frames):
    """Frames in which 20 of 60 Gaussians move."""
    first = make(60, 1)
    shift = torch.zeros(60, 3)
    shift[:20, 2] = 0.1
    return [dataclasses.replace(first, means=first.means + step * shift) for step in range(n_frames)]


def test_usd_stores_static_gaussians_once(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd

    frames = moving(4)
    write_splats(tmp_path / "a.usdc", frames, fps=42)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert stage.GetTimeCodesPerSecond() == 42 and stage.GetEndTimeCode() == 3
    prims = {prim.GetName(): prim for prim in stage.Traverse() if prim.GetTypeName().startswith("Particle")}
    positions = {name: prim.GetAttribute("positions") for name, prim in prims.items()}
    assert not positions["still_0"].GetTimeSamples() and len(positions["still_0"].Get()) == 40
    assert positions["moving_0"].GetTimeSamples() == [0, 1, 2, 3]
    for step, frame in enumerate(frames):
        assert np.array_equal(np.array(positions["moving_0"].Get(step)), frame.means[:20].numpy())
    assert not prims["moving_0"].GetAttribute("opacities").GetTimeSamples()


def test_sequence_reads_its_rate(tmp_path):
    folder = tmp_path / "run" / "gaussians"
    folder.mkdir(parents=True)
    for step, frame in enumerate(moving(3)):
        write_ply(folder / f"step_{step:04d}.ply", frame)
    assert open_sequence(tmp_path / "run").fps is None
    write_about(folder, 42.0)
    sequence = open_sequence(tmp_path / "run")
    assert sequence.fps == 42 and len(sequence) == 3 and torch.equal(sequence[2].means, moving(3)[2].means)
    for wrong in ('"fast"', "1" + "0" * 400, "-1"):
        (folder / "sequence.json").write_text(f'{{"fps": {wrong}}}')
        with pytest.raises(InputError, match="sequence.json"):
            open_sequence(folder)
    write_splats(folder / "other.splat", make(2, 0))
    with pytest.raises(InputError, match="several formats"):
        open_sequence(folder)


@pytest.mark.parametrize("suffix", FORMATS)
def test_formats_keep_antialiased_or_warn(suffix, tmp_path, recwarn):
    needs(suffix)
    file = tmp_path / f"a{suffix}"
    write_splats(file, dataclasses.replace(make(3, 1), antialiased=True))
    said = [str(warning.message) for warning in recwarn.list if "antialiased" in str(warning.message)]
    assert read_splats(file).antialiased is (suffix in (".ply", ".compressed.ply", ".spz"))
    assert len(said) == (not read_splats(file).antialiased)
    if suffix == ".ply":
        assert read_splats(file, up="y").antialiased


def test_pictures_of_antialiased_gaussians_are_compensated():
    small = make(60, 2)
    small = dataclasses.replace(small, scales=small.scales / 4, antialiased=True)
    camera = camera_around(small, 0.3, 48)
    fields = (small.means, small.quats, small.scales, small.opacities, small.sh)
    options = {"sh_degree": 2, "rasterize_mode": "antialiased"}
    expected = rasterization(*fields, camera.viewmats, camera.Ks, 48, 48, **options)[0][0]
    found, plain = (orbit.picture(g, camera) for g in (small, dataclasses.replace(small, antialiased=False)))
    assert np.abs(found - 255.0 * expected.clamp(0, 1).numpy()).max() <= 1
    assert plain.mean() > 2 * found.mean() > 0


def test_orbit_frames_show_the_scene():
    frames = list(orbit_frames(moving(3), 3, 64, 0.5))
    assert len(frames) == 3 and frames[0].shape == (64, 64, 3) and frames[0].dtype == np.uint8
    assert all((frame.max(2) > 20).mean() > 0.02 for frame in frames) and not np.array_equal(frames[0], frames[2])


def test_export_command_writes_files_and_videos(tmp_path, capsys):
    folder = tmp_path / "gaussians"
    folder.mkdir()
    for step, frame in enumerate(moving(3)):
        write_ply(folder / f"step_{step:04d}.ply", frame)
    write_about(folder, 12.0)
    assert main(["export", str(folder), "--frame", "-1", "--to", str(tmp_path / "last.spz")]) == 0
    assert "60 Gaussians" in capsys.readouterr().out
    assert main(["export", str(tmp_path), "--to", str(tmp_path / "a.mp4"), "--size", "64"]) == 0
    assert "3 frames, 12 a second" in capsys.readouterr().out
    assert main(["export", str(tmp_path), "--to", str(tmp_path / "a.html")]) == 0
    assert "any browser" in capsys.readouterr().out and "<canvas" in (tmp_path / "a.html").read_text()
    assert main(["export", str(tmp_path / "last.spz"), "--to", str(tmp_path / "last.splat")]) == 0
    assert "not kept" in capsys.readouterr().out
    for arguments, says in (
        ([str(folder), "--to", str(tmp_path / "b.spz")], "--frame"),
        ([str(folder), "--to", str(tmp_path / "last.spz")], "--to: .*exists already"),
        ([str(folder), "--frame", "3", "--to", str(tmp_path / "b.spz")], "3 frames"),
        ([str(folder), "--to", str(tmp_path / "b.obj")], "suffix"),
        ([str(tmp_path / "none"), "--to", str(tmp_path / "b.spz")], "no such file"),
        ([str(folder), "--to", str(tmp_path / "b.mp4"), "--size", "33"], "--size"),
    ):
        assert main(["export", *arguments]) == 2
        assert re.search(says, capsys.readouterr().err)
    assert main(["export", str(folder), "--frame", "0", "--to", str(tmp_path / "new" / "folder" / "b.splat")]) == 0


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".glb"])
def test_large_foreign_files_are_not_read(suffix, tmp_path):
    with open(tmp_path / f"a{suffix}", "wb") as file:
        file.truncate(2**30)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="not a "):
            read_splats(tmp_path / f"a{suffix}")
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()

"""3DGS .ply: what is written can be read back, by us and by others; broken files are refused in one line."""

import dataclasses
import struct
import tracemalloc

import numpy as np
import pytest
import torch
import trimesh

from gsim3d.errors import InputError
from gsim3d.io import read_ply, write_ply
from gsim3d.math.spherical_harmonics import SH_0
from gsim3d.state import Gaussians


def gaussians(n=7, degree=3, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    return Gaussians(
        means=rand(n, 3) - 0.5,
        quats=torch.nn.functional.normalize(rand(n, 4) - 0.5, dim=1),
        scales=0.001 + rand(n, 3),
        opacities=0.01 + 0.98 * rand(n),
        sh=rand(n, (degree + 1) ** 2, 3) - 0.5,
        cu_rows=torch.tensor([0, n // 2, n]),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_write_ply_round_trip(tmp_path, degree):
    before = gaussians(degree=degree)
    write_ply(tmp_path / "a.ply", before)
    after = read_ply(tmp_path / "a.ply")
    for name in ("means", "quats", "sh"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=0, atol=2e-7)
    torch.testing.assert_close(after.scales, before.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=0, atol=1e-6)
    assert after.cu_rows.tolist() == [0, 7]


def test_write_ply_selects_a_cloud(tmp_path):
    before = gaussians()
    write_ply(tmp_path / "a.ply", before, cloud=1)
    torch.testing.assert_close(read_ply(tmp_path / "a.ply").means, before.means[3:])


def test_write_ply_layout_of_viewers(tmp_path):
    before = gaussians(degree=1)
    write_ply(tmp_path / "a.ply", before)
    loaded = trimesh.load(tmp_path / "a.ply", process=False)
    assert np.allclose(loaded.vertices, before.means.numpy(), atol=1e-7)
    table = loaded.metadata["_ply_raw"]["vertex"]["data"]
    assert list(table.dtype.names) == (
        "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2".split() + [f"f_rest_{i}" for i in range(9)]
        + "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
    )  # fmt: skip
    # All red coefficients come first: f_rest_1 is coefficient 2 of red, f_rest_3 is coefficient 1 of green.
    assert np.allclose(np.ravel(table["f_rest_1"]), before.sh[:, 2, 0].numpy())
    assert np.allclose(np.ravel(table["f_rest_3"]), before.sh[:, 1, 1].numpy())
    assert np.allclose(1 / (1 + np.exp(-np.ravel(table["opacity"]))), before.opacities.numpy(), atol=1e-6)
    assert np.allclose(np.exp(np.ravel(table["scale_2"])), before.scales[:, 2].numpy(), rtol=1e-5)
    assert np.allclose(np.ravel(table["rot_0"]), before.quats[:, 0].numpy())


def test_write_ply_clamps_extreme_values(tmp_path):
    before = gaussians()
    before.scales[0] = 0.0
    before.opacities[0], before.opacities[1] = 0.0, 1.0
    write_ply(tmp_path / "a.ply", before)
    after = read_ply(tmp_path / "a.ply")
    assert 0 < after.opacities[0] < 1e-5 and 1 - 1e-5 < after.opacities[1] < 1
    assert after.scales[0].max() < 1e-8


def test_ply_of_no_gaussians(tmp_path):
    write_ply(tmp_path / "a.ply", gaussians(0))
    assert read_ply(tmp_path / "a.ply").means.shape == (0, 3)


def test_read_ply_text_in_any_order(tmp_path):
    names = "opacity x y z scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 f_dc_0 f_dc_1 f_dc_2 extra".split()
    header = ["ply", "format ascii 1.0", "comment text", "element vertex 1", *(f"property float {n}" for n in names)]
    (tmp_path / "a.ply").write_text("\n".join([*header, "end_header", "0 1 2 3 -1 -1 -1 2 0 0 0 0.1 0.2 0.3 9", ""]))
    read = read_ply(tmp_path / "a.ply")
    assert read.means.tolist() == [[1, 2, 3]] and read.quats.tolist() == [[1, 0, 0, 0]] and read.opacities.item() == 0.5


def broken_files(good: bytes):
    yield "not a ply", b"hello", "not a .ply"
    yield "truncated", good[:-5], "truncated"
    yield "no scales", good.replace(b"scale_1", b"skale_1"), "scale_1 is missing"
    yield "other format", good.replace(b"binary_little_endian", b"binary_middle_endian"), "unknown format"
    yield "list", good.replace(b"property float nx", b"property list uchar int nx"), "truncated"


def test_read_ply_refuses_broken_files(tmp_path):
    write_ply(tmp_path / "good.ply", gaussians(degree=1))
    for what, content, message in broken_files((tmp_path / "good.ply").read_bytes()):
        (tmp_path / "bad.ply").write_bytes(content)
        with pytest.raises(InputError, match=message):
            read_ply(tmp_path / "bad.ply")
            pytest.fail(what)
    with pytest.raises(InputError, match="cannot be read"):
        read_ply(tmp_path / "missing.ply")


def test_write_ply_refuses_values_that_are_not_finite(tmp_path):
    before = gaussians()
    before.means[2, 1] = float("nan")
    with pytest.raises(InputError, match="means"):
        write_ply(tmp_path / "a.ply", before)
    assert list(tmp_path.iterdir()) == []


def rows_of(properties, values, form="binary_little_endian", before=(), comments=(), after=()):
    """A .ply of one element vertex. properties: (type, name) or (length type, type, name) of a list; values: rows."""
    codes = {"float": "f", "double": "d", "uchar": "B", "int": "i", "ushort": "H"}
    order = ">" if form == "binary_big_endian" else "<"

    def packed(properties, row):
        out = b""
        for (*kinds, _), value in zip(properties, row, strict=True):
            numbers = [(kinds[0], value)]
            if len(kinds) == 2:
                numbers = [(kinds[0], len(value)), *((kinds[1], v) for v in value)]
            if form == "ascii":
                out += b" ".join(str(v).encode() for _, v in numbers) + b" "
            else:
                out += b"".join(struct.pack(order + codes[kind], v) for kind, v in numbers)
        return out + (b"\n" if form == "ascii" else b"")

    header, body = ["ply", f"format {form} 1.0", *(f"comment {text}" for text in comments)], b""
    for name, fields, rows in (*before, ("vertex", properties, values), *after):
        header.append(f"element {name} {len(rows)}")
        header += [f"property {'list ' * (len(field) == 3)}{' '.join(field)}" for field in fields]
        body += b"".join(packed(fields, row) for row in rows)
    return "\n".join([*header, "end_header\n"]).encode() + body


XYZ = [("float", name) for name in "xyz"]
DC = [("float", f"f_dc_{i}") for i in range(3)]
REST = [("float", name) for name in "opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()]
SHAPE = [0.0, -1.0, -2.0, -3.0, 1.0, 0.0, 0.0, 0.0]
FORMS = ("binary_little_endian", "binary_big_endian", "ascii")


def read(folder, content):
    (folder / "a.ply").write_bytes(content)
    return read_ply(folder / "a.ply")


@pytest.mark.parametrize("form", FORMS)
def test_read_ply_of_2dgs(form, tmp_path):
    flat = [p for p in REST if p[1] != "scale_2"]
    row = [1, 2, 3, 0.1, 0.2, 0.3, 0.0, -1.0, -2.0, 1.0, 0.0, 0.0, 0.0]
    got = read(tmp_path, rows_of(XYZ + DC + flat, [row], form))
    assert got.scales[0].tolist() == pytest.approx([np.exp(-1), np.exp(-2), 1e-9], rel=1e-6)
    write_ply(tmp_path / "b.ply", got)
    torch.testing.assert_close(read_ply(tmp_path / "b.ply").scales, got.scales, rtol=1e-5, atol=0)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("kind", "names", "values", "colors"),
    [
        ("uchar", ("red", "green", "blue"), (255, 0, 51), (1, 0, 0.2)),
        ("ushort", ("red", "green", "blue"), (65535, 0, 13107), (1, 0, 0.2)),
        ("float", ("r", "g", "b"), (1.0, 0.0, 0.2), (1, 0, 0.2)),
    ],
)
def test_read_ply_colours_without_harmonics(kind, names, values, colors, form, tmp_path):
    properties = XYZ + [(kind, name) for name in names] + REST
    got = read(tmp_path, rows_of(properties, [[1, 2, 3, *values, *SHAPE]], form))
    assert (got.sh[0, 0] * SH_0 + 0.5).tolist() == pytest.approx(colors, abs=1e-6)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("int", (255, 0, 51)),
        ("ushort", (255, 0, 51)),
        ("int", (9, 9, 9)),
        ("float", (255.0, 0, 51)),
    ],
)
def test_read_ply_refuses_colours_of_unclear_range(kind, values, form, tmp_path):
    properties = XYZ + [(kind, name) for name in ("red", "green", "blue")] + REST
    with pytest.raises(InputError, match="red, green, blue must be uchar, ushort .* got .*int|got float.* up to 255"):
        read(tmp_path, rows_of(properties, [[1, 2, 3, *values, *SHAPE]], form))


def test_read_ply_prefers_harmonics_to_colours(tmp_path):
    properties = XYZ + DC + [("uchar", name) for name in ("red", "green", "blue")] + REST
    got = read(tmp_path, rows_of(properties, [[1, 2, 3, 0.1, 0.2, 0.3, 255, 0, 0, *SHAPE]]))
    assert got.sh[0, 0].tolist() == pytest.approx([0.1, 0.2, 0.3])
    properties = XYZ + [("float", name) for name in ("red", "green", "blue")] + REST
    with pytest.raises(InputError, match="red, green, blue must be"):
        read(tmp_path, rows_of(properties, [[1, 2, 3, 255.0, 0.0, 0.0, *SHAPE]]))


def test_read_ply_warns_of_degree_4(tmp_path):
    rest = [("float", f"f_rest_{i}") for i in range(72)]
    content = rows_of(XYZ + DC + rest + REST, [[1, 2, 3, 9, 9, 9, *range(72), *SHAPE]])
    with pytest.warns(UserWarning, match="degree 4 are dropped"):
        got = read(tmp_path, content)
    assert got.sh.shape == (1, 16, 3)
    assert got.sh[0, 1:, 1].tolist() == list(range(24, 39))  # of green


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("lists", [[[7, 8], [9, 10]], [[7], [8, 9, 10]], [[], []]])
def test_read_ply_with_lists_and_other_elements(lists, form, tmp_path):
    properties = [*XYZ, ("uchar", "int", "tags"), *DC, *REST]
    rows = [[i, 2, 3, tags, 0.1, 0.2, 0.3, *SHAPE] for i, tags in enumerate(lists)]
    before = [("camera", [("float", "f"), ("uchar", "double", "matrix")], [[1.0, [0.5] * len(tags)] for tags in lists])]
    after = [("face", [("uchar", "int", "vertex_indices")], [[[0, 1, 0]]])]
    got = read(tmp_path, rows_of(properties, rows, form, before, after=after))
    assert got.means.tolist() == [[0, 2, 3], [1, 2, 3]] and got.scales[1, 2].item() == pytest.approx(np.exp(-3))
    broken = rows_of(properties, rows, form, before)
    with pytest.raises(InputError, match="truncated"):
        read(tmp_path, broken[: -(len(broken) // 5)])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            rows_of([("int", "packed_position")], [[1]], before=[("chunk", [("float", "min_x")], [[1.0]])]),
            "a compressed .ply",
        ),
        (b"\x1f\x8b" + bytes(40), "compressed with gzip"),
        (b"ply\nformat ascii 1.0\nelement vertex " + b"9" * 5000 + b"\nproperty float x\nend_header\n", "unusable"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nproperty float x\nend_header\n", "unusable line"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty quad x\nend_header\n1", "unsupported line"),
        (b"ply\nformat ascii 1.0\nelement face 1\nproperty float x\nend_header\n1", "no usable element vertex"),
        (rows_of([*XYZ, ("uchar", "red")], [[1, 2, 3, 4]]), "is missing"),
        (
            b"ply\nformat binary_little_endian 1.0\nelement a 99999999\nproperty list uint int l\nelement vertex 1\n"
            b"property float x\nend_header\n" + b"\xff" * 64,
            "have lists",
        ),
    ],
)
def test_read_ply_refuses_other_files(content, message, tmp_path):
    with pytest.raises(InputError, match=message) as caught:
        read(tmp_path, content)
    assert len(str(caught.value)) < 400 and "\n" not in str(caught.value)


def test_read_ply_bounds_rows_with_lists(tmp_path, monkeypatch):
    monkeypatch.setattr("gsim3d.io.ply_format.MAX_LIST_ROWS", 3)
    faces = [[[0] * (1 + i % 2)] for i in range(4)]
    content = rows_of(XYZ + DC + REST, [[1, 2, 3, 0, 0, 0, *SHAPE]], before=[("face", [("uchar", "int", "v")], faces)])
    with pytest.raises(InputError, match="have lists"):
        read(tmp_path, content)


@pytest.mark.parametrize(
    ("properties", "comments"),
    [
        ([("float", "filter_3D")], ()),
        ([], ("SplatRenderMode: mip",)),
        ([], ("splatrendermode:mip-splatting",)),
        ([], ("antialiased 1",)),
    ],
)
def test_read_ply_knows_antialiased_training(properties, comments, tmp_path):
    row = [1, 2, 3, 0, 0, 0, *SHAPE, *([0.5] * len(properties))]
    found = read(tmp_path, rows_of(XYZ + DC + REST + properties, [row], comments=comments))
    assert found.antialiased
    write_ply(tmp_path / "b.ply", found)
    again = read_ply(tmp_path / "b.ply")
    assert again.antialiased and torch.allclose(again.scales, found.scales)


def test_filter_3d_is_part_of_scales_and_opacities(tmp_path):
    """A Gaussian convolved with one of standard deviation f keeps its integral."""
    row, f = [1, 2, 3, 0, 0, 0, *SHAPE], 0.5
    plain = read(tmp_path, rows_of(XYZ + DC + REST, [row]))
    found = read(tmp_path, rows_of([*XYZ, *DC, *REST, ("float", "filter_3D")], [[*row, f]]))
    assert torch.allclose(found.scales, (plain.scales**2 + f**2).sqrt())
    integrals = [gaussians.opacities * gaussians.scales.prod(1) for gaussians in (plain, found)]
    assert torch.allclose(*integrals) and found.opacities < plain.opacities


def test_read_ply_of_classic_training(tmp_path, recwarn):
    row = [1, 2, 3, 0, 0, 0, *SHAPE]
    found = read(tmp_path, rows_of(XYZ + DC + REST, [row], comments=("SplatRenderMode: default", "antialiased 0")))
    assert not recwarn.list and not found.antialiased


def test_write_ply_refuses_gaussians_without_colours(tmp_path):
    with pytest.raises(InputError, match="sh is None"):
        write_ply(tmp_path / "a.ply", dataclasses.replace(gaussians(), sh=None))
    assert list(tmp_path.iterdir()) == []


POSITIONS = [(500000.25, 4649776.5, 100.125), (-1e7, 3.5, 0.0), (12345.678, -2.0, 8e5)]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("position", POSITIONS)
def test_ply_survey_positions_keep_their_digits(position, form, tmp_path):
    world = np.array(position) + np.array([[0.0, 0.001, 0.002], [3.0, -2.0, 1.25], [-1.0, 0.1, 0.0]])
    properties = [("double", name) for name in "xyz"] + DC + REST
    got = read(tmp_path, rows_of(properties, [[*p, 0.1, 0.2, 0.3, *SHAPE] for p in world.tolist()], form))
    assert got.world_offset.shape == (1, 3) and got.means.abs().max() < 5
    np.testing.assert_allclose(got.means.double() + got.world_offset, world, rtol=0, atol=1e-6)
    write_ply(tmp_path / "b.ply", got)
    again = read_ply(tmp_path / "b.ply")
    np.testing.assert_allclose(again.means.double() + again.world_offset, world, rtol=0, atol=2e-6)
    table = trimesh.load(tmp_path / "b.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]
    assert table.dtype["x"] == np.float64 and table.dtype["opacity"] == np.float32


def test_read_ply_offset_is_none_near_the_origin(tmp_path):
    for kind, position in (("double", (1.5, 2.5, 1e3)), ("float", (500.0, -999.0, 1.0)), ("double", (0.1, 0.2, 0.3))):
        got = read(tmp_path, rows_of([(kind, n) for n in "xyz"] + DC + REST, [[*position, 0, 0, 0, *SHAPE]]))
        assert got.world_offset is None and got.means[0].tolist() == pytest.approx(position)


def test_write_ply_applies_offsets_of_clouds(tmp_path):
    offsets = torch.tensor([[1e6, 0, 0], [0, 2e6, 0]], dtype=torch.float64)
    before = dataclasses.replace(gaussians(), world_offset=offsets)
    for cloud in (0, 1):
        write_ply(tmp_path / "a.ply", before, cloud)
        after = read_ply(tmp_path / "a.ply")
        rows = slice(*before.cu_rows[cloud : cloud + 2].tolist())
        expected = before.means[rows].double() + offsets[cloud]
        torch.testing.assert_close(after.means.double() + after.world_offset, expected, rtol=0, atol=1e-6)


def test_read_ply_leaves_large_foreign_files_unread(tmp_path):
    with open(tmp_path / "a.ply", "wb") as file:
        file.truncate(2**30)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="not a .ply file"):
            read_ply(tmp_path / "a.ply")
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()

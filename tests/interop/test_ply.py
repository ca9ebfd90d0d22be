"""3DGS .ply: what is written can be read back, by us and by others; broken files are refused in one line."""

import numpy as np
import pytest
import torch
import trimesh

from gsim3d.errors import InputError
from gsim3d.interop import read_ply, write_ply
from gsim3d.types import Gaussians


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
def test_round_trip(tmp_path, degree):
    before = gaussians(degree=degree)
    write_ply(tmp_path / "a.ply", before)
    after = read_ply(tmp_path / "a.ply")
    for name in ("means", "quats", "sh"):
        torch.testing.assert_close(getattr(after, name), getattr(before, name), rtol=0, atol=2e-7)
    torch.testing.assert_close(after.scales, before.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(after.opacities, before.opacities, rtol=0, atol=1e-6)
    assert after.cu_rows.tolist() == [0, 7]


def test_one_cloud_is_selected(tmp_path):
    before = gaussians()
    write_ply(tmp_path / "a.ply", before, cloud=1)
    torch.testing.assert_close(read_ply(tmp_path / "a.ply").means, before.means[3:])


def test_the_layout_that_viewers_expect(tmp_path):
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


def test_extreme_values_stay_finite(tmp_path):
    before = gaussians()
    before.scales[0] = 0.0
    before.opacities[0], before.opacities[1] = 0.0, 1.0
    write_ply(tmp_path / "a.ply", before)
    after = read_ply(tmp_path / "a.ply")
    assert 0 < after.opacities[0] < 1e-5 and 1 - 1e-5 < after.opacities[1] < 1
    assert after.scales[0].max() < 1e-8


def test_no_gaussians(tmp_path):
    write_ply(tmp_path / "a.ply", gaussians(0))
    assert read_ply(tmp_path / "a.ply").means.shape == (0, 3)


def test_text_and_other_orders_are_read(tmp_path):
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
    yield "list", good.replace(b"property float nx", b"property list uchar int nx"), "unsupported line"


def test_broken_files_are_refused(tmp_path):
    write_ply(tmp_path / "good.ply", gaussians(degree=1))
    for what, content, message in broken_files((tmp_path / "good.ply").read_bytes()):
        (tmp_path / "bad.ply").write_bytes(content)
        with pytest.raises(InputError, match=message):
            read_ply(tmp_path / "bad.ply")
            pytest.fail(what)
    with pytest.raises(InputError, match="cannot be read"):
        read_ply(tmp_path / "missing.ply")


def test_values_that_are_not_finite_are_not_written(tmp_path):
    before = gaussians()
    before.means[2, 1] = float("nan")
    with pytest.raises(InputError, match="means"):
        write_ply(tmp_path / "a.ply", before)
    assert list(tmp_path.iterdir()) == []

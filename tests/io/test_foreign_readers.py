"""Files that are written here, read by others where installed: gsply, usd-core, trimesh, the validator of Khronos."""

import dataclasses
import json
import os
import shutil
import subprocess

import numpy as np
import pytest
import torch
import trimesh

from gsim3d.errors import FitWarning, InputError
from gsim3d.io import read_splats, write_splats
from tests.io.test_formats import assert_within_bounds, make, moving

VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1]))).then((r) => console.log(JSON.stringify(r)));
"""


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz"])
def test_gsply_reads_the_same(suffix, degree, tmp_path):
    gsply = pytest.importorskip("gsply", reason="gsply is not installed")
    file = tmp_path / f"a{suffix}"
    write_splats(file, make(300, degree), up="z")
    theirs = gsply.read_spz(str(file)) if suffix == ".spz" else gsply.plyread(str(file))
    ours = read_splats(file, up="z")
    assert np.abs(theirs.means - ours.means.numpy()).max() < 1e-5
    assert np.abs(theirs.scales - ours.scales.log().numpy()).max() < 1e-4
    seen = 1 / (1 + np.exp(-np.float64(theirs.opacities)))
    assert np.abs(seen - ours.opacities.numpy()).max() < 1e-3
    quats = torch.nn.functional.normalize(torch.from_numpy(np.array(theirs.quats)).double(), dim=1)
    assert (quats * ours.quats).sum(1).abs().min() > 1 - 1e-5
    assert np.abs(theirs.sh0 - ours.sh[:, 0].numpy()).max() < 1e-2
    if degree:
        assert np.abs(np.array(theirs.shN).reshape(300, -1, 3) - ours.sh[:, 1:].numpy()).max() < 2e-2


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("suffix, version", [(".ply", None), (".compressed.ply", None), (".spz", 3), (".spz", 4)])
def test_what_gsply_writes_is_read(suffix, version, degree, tmp_path):
    gsply = pytest.importorskip("gsply", reason="gsply is not installed")
    given, file = make(300, degree), tmp_path / f"a{suffix}"
    values = (given.means, given.scales.log(), given.quats, given.opacities.logit(), given.sh[:, 0], given.sh[:, 1:])
    data = gsply.GSData(*(value.contiguous().numpy() for value in values))
    if version:
        pytest.importorskip("zstandard", reason="zstandard is not installed")
        gsply.write_spz(str(file), data, version=version)
    else:
        gsply.plywrite(str(file), data)
    assert_within_bounds(suffix, read_splats(file, up="z"), given)


def test_trimesh_reads_positions_of_glb_with_y_up(tmp_path):
    given = make(50, 1)
    write_splats(tmp_path / "a.glb", given)
    scene = trimesh.load(tmp_path / "a.glb")
    (name,) = scene.graph.nodes_geometry
    place, geometry = scene.graph[name]
    points = trimesh.transform_points(scene.geometry[geometry].vertices, place)
    x, y, z = given.means.numpy().T
    np.testing.assert_allclose(points, np.stack([x, z, -y], 1), atol=1e-5)


@pytest.mark.parametrize("degree", [0, 3])
def test_khronos_validator_knows_all_but_the_extension(degree, tmp_path):
    """It may not know the names of the extension and of its attributes; all else must be right."""
    if not shutil.which("node"):
        pytest.skip("Node.js is not installed")
    modules = (
        os.environ.get("NODE_PATH") or subprocess.run(["npm", "root", "-g"], capture_output=True, text=True).stdout
    )
    environment = {**os.environ, "NODE_PATH": modules.strip()}
    found = subprocess.run(["node", "-e", "require('gltf-validator')"], env=environment, capture_output=True)
    if found.returncode:
        pytest.skip("gltf-validator is not installed (npm install -g gltf-validator)")
    write_splats(tmp_path / "a.glb", make(257, degree))
    command = ["node", "-e", VALIDATE, str(tmp_path / "a.glb")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    known = {"UNSUPPORTED_EXTENSION", "MESH_PRIMITIVE_ATTRIBUTE_UNUSED", "MESH_PRIMITIVE_INVALID_ATTRIBUTE"}
    others = [
        message
        for message in report["issues"]["messages"]
        if message["code"] not in known or "KHR_gaussian_splatting" not in json.dumps(message)
    ]
    assert not others and report["info"]["totalVertexCount"] == 257, others[:5]


def test_usd_keeps_rate_axis_and_unit(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    write_splats(tmp_path / "a.usdc", moving(3), fps=12.5)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    assert (stage.GetTimeCodesPerSecond(), stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (12.5, 0, 2)
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    first = {prim.GetName(): prim for prim in stage.Traverse()}["moving_0"]
    assert np.array_equal(np.array(first.GetAttribute("extent").Get(2)).shape, (2, 3))


def test_usd_stores_all_where_all_moves(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd

    first = make(20, 0)
    frames = [dataclasses.replace(first, means=first.means + 0.1 * step) for step in range(2)]
    write_splats(tmp_path / "a.usda", frames, fps=10)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    names = {prim.GetName() for prim in stage.Traverse()}
    assert names == {"Gaussians", "moving_0"}


def test_usd_of_changing_counts_stores_what_rests_once(tmp_path):
    """As a rollout has them: clouds of the encoded steps differ, predicted ones are the same particles."""
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    frames = [make(30, 1), make(25, 1), *moving(3)]
    write_splats(tmp_path / "a.usdc", frames, fps=10)
    with pytest.warns(FitWarning, match="a.usdc: only the first frame is read"):
        assert torch.equal(read_splats(tmp_path / "a.usdc").means, frames[0].means)
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    prims = [prim for prim in stage.Traverse() if prim.GetName() != "Gaussians"]
    assert {prim.GetName() for prim in prims} == {"still_0", "still_1", "still_2", "moving_2"}
    for time, frame in enumerate(frames):
        shown = [prim for prim in prims if UsdGeom.Imageable(prim).ComputeVisibility(time) == "inherited"]
        positions = np.concatenate([np.array(prim.GetAttribute("positions").Get(time)) for prim in shown])
        assert np.array_equal(np.sort(positions, 0), np.sort(frame.means.numpy(), 0)), time
    assert [len(prim.GetAttribute("positions").GetTimeSamples()) for prim in prims] == [0, 0, 0, 3]


def test_usd_transforms_are_applied(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Gf, Usd, UsdGeom

    given = make(5, 1)
    write_splats(tmp_path / "a.usda", given)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    place = UsdGeom.Xformable(stage.GetPrimAtPath("/Gaussians"))
    place.AddTranslateOp().Set(Gf.Vec3d(5e5, 4e6, 100))
    size = place.AddScaleOp()
    size.Set(Gf.Vec3f(2, 2, 2))
    stage.GetRootLayer().Save()
    read = read_splats(tmp_path / "a.usda")
    expected = 2 * given.means.double() + torch.tensor([5e5, 4e6, 100])
    torch.testing.assert_close(read.means + read.world_offset, expected, rtol=0, atol=1e-5)
    torch.testing.assert_close(read.scales, 2 * given.scales)
    size.Set(Gf.Vec3f(2, 1, 2))
    stage.GetRootLayer().Save()
    with pytest.raises(InputError, match="scale alike"):
        read_splats(tmp_path / "a.usda")


def test_usd_of_half_precision_with_y_up_in_centimetres_is_read(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Sdf, Usd, UsdGeom, Vt

    given, types = make(20, 1), Sdf.ValueTypeNames
    write_splats(tmp_path / "a.usda", given)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    prim = stage.GetPrimAtPath("/Gaussians/still_0")
    halves = {"positions": (types.Point3hArray, Vt.Vec3hArray), "orientations": (types.QuathArray, Vt.QuathArray)}
    halves |= {"scales": (types.Half3Array, Vt.Vec3hArray), "opacities": (types.HalfArray, Vt.HalfArray)}
    for name, (kind, array) in halves.items():
        values = np.array(prim.GetAttribute(name).Get()).astype(np.float16)
        prim.RemoveProperty(name)
        prim.CreateAttribute(f"{name}h", kind, False).Set(array.FromNumpy(values))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.GetRootLayer().Save()
    read, (x, y, z) = read_splats(tmp_path / "a.usda"), 0.01 * given.means.T
    torch.testing.assert_close(read.means, torch.stack([x, -z, y], 1), rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(read.scales, 0.01 * given.scales, rtol=1e-3, atol=0)
    torch.testing.assert_close(read.opacities, given.opacities, rtol=1e-3, atol=0)


def damaged(text):
    return [
        (text[: len(text) // 2], "not a USD file"),
        (text.replace(b"point3f[]", b"string[]", 1), "not a USD file"),
        (text.replace(b"metersPerUnit = 1", b"metersPerUnit = 0"), "metersPerUnit must be positive"),
        (text.replace(b"ParticleField3DGaussianSplat", b"Mesh"), "no visible prim is a Particle"),
        (b"#usda 1.0\n\xff\xfe", "not a USD file"),
        (b"", "not a USD file"),
    ]


def test_damaged_usd_is_refused(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    file = tmp_path / "a.usda"
    write_splats(file, make(3, 1))
    for number, (content, says) in enumerate(damaged(file.read_bytes())):
        other = tmp_path / f"{number}.usda"
        other.write_bytes(content)
        with pytest.raises(InputError, match=says):
            read_splats(other)
    os.mkfifo(tmp_path / "pipe.usda")
    with pytest.raises(InputError, match="not a file"):
        read_splats(tmp_path / "pipe.usda")


def test_usd_that_cannot_be_written_is_named(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="a.usda: OpenUSD cannot write it: "):
        write_splats(tmp_path / "file" / "a.usda", make(3, 0))


def test_usd_that_crashes_its_library_is_refused(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    file = tmp_path / "a.usdc"
    write_splats(file, make(1, 1))
    content = bytearray(file.read_bytes())
    content[25:89] = b"\xff" * 64
    file.write_bytes(content)
    with pytest.raises(InputError, match="a.usdc: damaged, .* was ended by SIGSEGV"):
        read_splats(file)

"""Bodies: closed, outward facing, of unit size, coloured; mesh files and their errors."""

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gsim3d.errors import InputError
from gsim3d.synth import bodies, mesh_files, meshes, shapes
from gsim3d.synth.worlds import build_world

CUBE = """v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 2\nv 1 0 2\nv 1 1 2\nv 0 1 2
f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 2 3 7\nf 2 7 6\nf 3 4 8\nf 3 8 7\nf 4 1 5\nf 4 5 8\n"""


def body_of(name, seed=0):
    return shapes.procedural_body(name, np.random.default_rng(seed))


@pytest.mark.parametrize("name", shapes.SHAPES)
def test_procedural_bodies_are_closed_and_face_outwards(name):
    body = body_of(name)
    for vertices, faces in ((body.vertices, body.faces), (body.collision_vertices, body.collision_faces)):
        positions, label = np.unique(vertices, axis=0, return_inverse=True)
        mesh = trimesh.Trimesh(positions, label.reshape(-1)[faces], process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    radius = np.linalg.norm(body.vertices, axis=1).max()
    np.testing.assert_allclose(radius, 0.5, atol=1e-12)
    np.testing.assert_allclose(body.vertices.min(0) + body.vertices.max(0), 0, atol=1e-12)
    # The mesh that collides is coarser, and keeps the shape to a twentieth of its size.
    assert len(body.collision_vertices) < len(body.vertices) / 4
    np.testing.assert_allclose(np.ptp(body.collision_vertices, 0), np.ptp(body.vertices, 0), atol=0.05)


@pytest.mark.parametrize("pattern", shapes.PATTERNS)
def test_patterns_have_several_colours(pattern):
    points = body_of("ball").vertices
    painted = shapes.PATTERNS[pattern](points, shapes.PALETTE[:3])
    _, counts = np.unique(painted, axis=0, return_counts=True)
    assert len(counts) >= 2 and counts.min() > 0.02 * len(points)


def test_procedural_paint_depends_on_the_seed():
    colours = [body_of("ball", seed).paint(body_of("ball").vertices) for seed in range(4)]
    assert not any(np.array_equal(colours[0], other) for other in colours[1:])


def test_unknown_object_is_refused():
    with pytest.raises(InputError, match="cube.*choose from ball"):
        body_of("cube")


def test_load_body_turns_and_scales(tmp_path):
    (tmp_path / "tower.obj").write_text(CUBE)
    for up, axis in (("z", 2), ("y", 1)):
        body = meshes.load_body(tmp_path / "tower.obj", up)
        size = np.ptp(body.vertices, axis=0)
        np.testing.assert_allclose(size[axis] / np.delete(size, axis), 2, rtol=1e-12)
        assert trimesh.Trimesh(body.vertices, body.faces).volume > 0
        assert body.name == "tower" and len(body.vertices) == 8


def test_obj_texture_coordinates_start_at_the_lower_left(tmp_path):
    """The lower left corner of the image has uv (0, 0)."""
    from PIL import Image

    image = np.zeros((8, 8, 3), dtype=np.uint8)
    image[4:, :4] = [255, 0, 0]
    image[:4, 4:] = [0, 0, 255]
    Image.fromarray(image).save(tmp_path / "skin.png")
    (tmp_path / "skin.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    faces = "f 1/1 3/3 2/2\nf 1/1 2/2 4/4\nf 2/2 3/3 4/4\nf 3/3 1/1 4/4\n"
    text = "mtllib skin.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    text += "vt .25 .25\nvt .75 .75\nvt .25 .75\nvt .75 .25\nusemtl skin\n" + faces
    (tmp_path / "skin.obj").write_text(text)
    body = meshes.load_body(tmp_path / "skin.obj", "z")
    assert body.corners.shape == (4, 3, 2)
    colours = body.paint(np.array([[0.25, 0.25], [0.75, 0.75], [0.25, 0.75], [1.25, -0.75]]))
    np.testing.assert_allclose(colours, [[1, 0, 0], [0, 0, 1], [0, 0, 0], [1, 0, 0]], atol=1e-12)
    seen = body.paint(body.corners.reshape(-1, 2)).reshape(4, 3, 3)
    by_vertex = {tuple(np.round(body.vertices[v] - body.vertices.min(0), 6)): seen[f, k]
                 for f, face in enumerate(body.faces) for k, v in enumerate(face)}  # fmt: skip
    assert len(by_vertex) == 4
    np.testing.assert_allclose(by_vertex[(0.0, 0.0, 0.0)], [1, 0, 0], atol=1e-12)


def test_load_body_clusters_large_collision_meshes(tmp_path):
    trimesh.creation.icosphere(subdivisions=4).export(tmp_path / "fine.ply")
    body = meshes.load_body(tmp_path / "fine.ply", "z")
    assert len(body.vertices) == 2562
    assert 50 < len(body.collision_vertices) <= meshes.COLLISION_VERTICES
    np.testing.assert_allclose(np.ptp(body.collision_vertices, axis=0), 1, atol=0.1)


@pytest.mark.parametrize("text", [None, "", "no mesh\n", "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n"])
def test_load_body_refuses_unusable_meshes(tmp_path, text):
    path = Path(tmp_path / "bad.obj")
    if text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match="bad.obj"):
        meshes.load_body(path)


@pytest.mark.parametrize("suffix", [".off", ".stl", ".ply", ".glb"])
def test_load_body_refuses_faces_of_missing_vertices(suffix, tmp_path):
    mesh = trimesh.creation.box()
    mesh.export(tmp_path / f"bad{suffix}")
    data = (tmp_path / f"bad{suffix}").read_bytes()
    if suffix == ".off":
        data = data.replace(b"\n3 ", b"\n3 9", 1)
    elif suffix == ".ply":
        data = data[:-4] + (99).to_bytes(4, "little")
    else:
        data = data[: len(data) // 2]
    (tmp_path / f"bad{suffix}").write_bytes(data)
    with pytest.raises(InputError, match=f"bad{suffix}"):
        meshes.load_body(tmp_path / f"bad{suffix}")


def test_load_body_refuses_large_files_unread(tmp_path):
    with open(tmp_path / "large.stl", "wb") as file:
        file.truncate(mesh_files.MAX_MESH + 1)
    with pytest.raises(InputError, match="large.stl .*it has .* bytes; more than .* are refused"):
        meshes.load_body(tmp_path / "large.stl")


def test_genesis_meshes_are_found_without_import(tmp_path, monkeypatch):
    folder = tmp_path / "genesis" / "assets" / "meshes"
    (folder / "duck").mkdir(parents=True)
    (tmp_path / "genesis" / "__init__.py").write_text("raise RuntimeError('imported')")
    (folder / "duck" / "body.obj").write_text(CUBE.replace("f 4 5 8\n", "").replace("f 4 1 5\n", ""))  # open
    (folder / "duck.obj").write_text(CUBE)
    (folder / "worm").mkdir()
    (folder / "worm" / "worm.obj").write_text("mtllib absent.mtl\nusemtl skin\n" + CUBE)
    (folder / "worm.obj").write_text(CUBE)
    (folder / "broken.stl").write_text("")
    monkeypatch.setattr(bodies, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="genesis:duck.*pip install --no-deps genesis-world"):
        bodies.load_mesh("genesis:duck")
    monkeypatch.undo()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "genesis", raising=False)
    duck = bodies.load_mesh("genesis:duck")
    assert duck.name == "duck" and len(duck.vertices) == 9 and len(duck.faces) == 14  # of the folder, closed by a fan
    assert trimesh.Trimesh(duck.vertices, duck.faces, process=False).is_watertight
    assert bodies.mesh_bytes("genesis:worm") == CUBE.encode()  # the other one lacks its colours
    with pytest.raises(InputError, match="genesis:pig does not exist; choose from broken, duck, worm"):
        bodies.load_mesh("genesis:pig")
    with pytest.raises(InputError, match="genesis:broken.*broken.stl"):
        bodies.load_mesh("genesis:broken")
    settings = build_world("elastic", "published", {"meshes": ("genesis:worm",)})
    assert settings.object_names()[-1] == "worm" and settings.fingerprint("worm") != settings.fingerprint("spot")
    assert settings.draw("worm", 0, 0).bodies[0].facts["object"] == "worm"
    assert "genesis" not in sys.modules


def test_fill_holes_uses_colours_of_borders(tmp_path):
    """Two holes of a painted body, each closed by a fan whose corners have the colours of the edges beside it."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    colours = np.clip(mesh.vertices * 0.4 + 0.5, 0, 1)
    kept = np.abs(mesh.triangles_center[:, 2]) < 0.9
    lines = [f"v {' '.join(map(str, (*v, *c)))}" for v, c in zip(mesh.vertices, colours)]
    faces = [f"f {' '.join(str(k + 1) for k in face)}" for face in mesh.faces[kept]]
    (tmp_path / "cut.obj").write_text("\n".join([*lines, *faces]))
    with pytest.raises(InputError, match="cut.obj is not closed"):
        meshes.load_body(tmp_path / "cut.obj")
    body = meshes.load_body(tmp_path / "cut.obj", "z", fill_holes=True)
    surface = trimesh.Trimesh(body.vertices, body.faces, process=False)
    assert surface.is_watertight and surface.is_winding_consistent and surface.volume > 0
    added = body.corners[kept.sum() :]
    heights = body.vertices[body.faces[kept.sum() :]][..., 2]
    assert len(added) >= 10 and (np.sign(added[..., 2] - 0.5) == np.sign(heights)).all()
    assert (np.abs(added[..., 2] - 0.5) > 0.3).all()

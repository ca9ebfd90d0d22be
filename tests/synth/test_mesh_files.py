"""Mesh files: all objects, materials and colours are read, or the file is refused."""

import json
import struct

import numpy as np
import pytest
import trimesh
from PIL import Image

from gsim3d.errors import InputError
from gsim3d.synth.meshes import load_body

CORNERS = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
SIDES = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
INWARDS = [side[::-1] for side in SIDES]  # also cut into other triangles
RED, GREEN, BLUE = (1, 0, 0), (0, 1, 0), (0, 0, 1)


def vertices(at=0, colour=None):
    more = "" if colour is None else " " + " ".join(map(str, colour))
    return "".join(f"v {x + at} {y} {z}{more}\n" for x, y, z in CORNERS)


def sides(before, chosen=SIDES):
    return "".join("f " + " ".join(str(k + before) for k in side) + "\n" for side in chosen)


def write(folder, text, name="body.obj"):
    (folder / "two.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl deep blue\nKd 0 0 1\nnewmtl none\n")
    (folder / name).write_text(text)
    return folder / name


def seen(body, at):
    """Colours in the middle of the faces of the left or right half."""
    middle = body.vertices[body.faces].mean(1)[:, 0] < 0
    colours = body.paint(body.corners.mean(1))
    assert ((colours >= 0) & (colours <= 1)).all()
    return colours[middle if at == "left" else ~middle]


def volume(body):
    return trimesh.Trimesh(body.vertices, body.faces, process=False).volume


TWO = {
    "forwards": vertices() + sides(1) + vertices(3) + sides(9),
    "backwards": vertices() + sides(-8) + vertices(3) + sides(-8),
    "all before": vertices() + vertices(3) + "o a\n" + sides(1) + "o b\n" + sides(9),
    "backwards, all before": vertices() + vertices(3) + "o a\n" + sides(-16) + "g b\n" + sides(-8),
    "one inside out": vertices() + sides(1) + vertices(3) + sides(9, INWARDS),
    "both inside out": vertices() + sides(1, INWARDS) + vertices(3) + sides(9, INWARDS),
}


@pytest.mark.parametrize("name", TWO)
def test_load_body_reads_all_objects(tmp_path, name):
    body = load_body(write(tmp_path, TWO[name]), "z")
    assert len(body.vertices) == 16 and len(body.faces) == 24
    assert len(np.unique(np.sort(body.faces, 1), axis=0)) == 24
    size = np.ptp(body.vertices, axis=0)
    np.testing.assert_allclose(size / size[1], [4, 1, 1])
    np.testing.assert_allclose(volume(body) / size[1] ** 3, 2)
    assert np.ptp(body.collision_vertices, axis=0)[0] > 0.9 * size[0]


def test_load_body_keeps_cavities(tmp_path):
    inner = "".join(f"v {0.25 + x / 2} {0.25 + y / 2} {0.25 + z / 2}\n" for x, y, z in CORNERS)
    for outer, hole in ((SIDES, INWARDS), (INWARDS, SIDES)):
        body = load_body(write(tmp_path, vertices() + sides(1, outer) + inner + sides(9, hole)), "z")
        np.testing.assert_allclose(volume(body) / np.ptp(body.vertices[:, 0]) ** 3, 7 / 8)


MATERIALS = {
    "two bodies": "usemtl red\n" + vertices() + sides(1) + "usemtl deep blue\n" + vertices(3) + sides(9),
    "back and forth": vertices() + vertices(3) + "usemtl red\n" + sides(1, SIDES[:3]) + "usemtl deep blue\n" + sides(9)
    + "usemtl red\n" + sides(1, SIDES[3:]),
    "continued lines": "usemtl red\n" + vertices() + sides(1).replace(" 5 7", " 5 \\\n 7") + "usemtl deep blue\n"
    + vertices(3) + sides(9) + "# f 1 2 99\n",
}  # fmt: skip


@pytest.mark.parametrize("name", MATERIALS)
def test_obj_materials_keep_their_colours(tmp_path, name):
    body = load_body(write(tmp_path, "mtllib two.mtl\n" + MATERIALS[name]), "z")
    assert len(body.faces) == 24
    np.testing.assert_allclose(seen(body, "left"), np.tile(RED, (12, 1)))
    np.testing.assert_allclose(seen(body, "right"), np.tile(BLUE, (12, 1)))


def test_obj_body_of_several_materials_and_files(tmp_path):
    (tmp_path / "more.mtl").write_text("newmtl leaf\nKd 0 1 0\n")
    text = "mtllib two.mtl\nmtllib more.mtl\n" + vertices() + "usemtl red\n" + sides(1, SIDES[:1]) + "usemtl leaf\n"
    body = load_body(write(tmp_path, text + sides(1, SIDES[1:])), "z")
    colours = body.paint(body.corners.mean(1))
    low = body.vertices[body.faces][:, :, 2].max(1) < 0
    np.testing.assert_allclose(colours[low], [RED] * 2)
    np.testing.assert_allclose(colours[~low], [GREEN] * 10)
    (one := write(tmp_path, "mtllib two.mtl more.mtl\nusemtl leaf\n" + vertices() + sides(1)))
    np.testing.assert_allclose(load_body(one).paint(load_body(one).corners[:, 0]), [GREEN] * 12)


def test_obj_texture_beside_colour_and_pattern(tmp_path):
    Image.fromarray(np.full((2, 2, 3), [0, 255, 0], np.uint8)).save(tmp_path / "skin.png")
    (tmp_path / "skin.mtl").write_text("newmtl skin\nKd 0.8 0.8 0.8\nmap_Kd -s 1 1 1 skin.png\n")
    textured = "".join("f " + " ".join(f"{k + 1}/1" for k in side) + "\n" for side in SIDES)
    text = "mtllib skin.mtl\nmtllib two.mtl\nvt 0.5 0.5\nusemtl skin\n" + vertices() + textured + "usemtl {}\n"
    body = load_body(write(tmp_path, text.format("red") + vertices(3) + sides(9)), "z")
    np.testing.assert_allclose(seen(body, "left"), np.tile(GREEN, (12, 1)))
    np.testing.assert_allclose(seen(body, "right"), np.tile(RED, (12, 1)))
    body = load_body(write(tmp_path, text.format("none") + vertices(3) + sides(9)), "z")
    np.testing.assert_allclose(seen(body, "left"), np.tile(GREEN, (12, 1)))
    assert len(np.unique(seen(body, "right"), axis=0)) > 1


@pytest.mark.parametrize("colours", [(RED, BLUE), ((255, 0, 0), (0, 0, 255))])
def test_obj_vertex_colours(tmp_path, colours):
    text = vertices(0, colours[0]) + sides(1) + vertices(3, colours[1]) + sides(9)
    body = load_body(write(tmp_path, text), "z")
    np.testing.assert_allclose(seen(body, "left"), np.tile(RED, (12, 1)))
    np.testing.assert_allclose(seen(body, "right"), np.tile(BLUE, (12, 1)))


def box(at, colour=None):
    mesh = trimesh.creation.box().apply_translation([at, 0, 0])
    if colour is not None:
        mesh.visual.vertex_colors = [*(255 * np.array(colour)), 255]
    return mesh


def pbr(mesh, **options):
    uv = mesh.vertices[:, :2] if "baseColorTexture" in options else None
    material = trimesh.visual.material.PBRMaterial(**options)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return mesh


def test_glb_pieces_keep_their_colours(tmp_path):
    blue = Image.fromarray(np.full((2, 2, 3), [0, 0, 255], np.uint8))
    lefts = (box(0, RED), pbr(box(0), baseColorFactor=[255, 0, 0, 255]))
    rights = (box(3, BLUE), pbr(box(3), baseColorTexture=blue), pbr(box(3), baseColorFactor=[0, 0, 255, 255]))
    for left in lefts:
        for right in rights:
            trimesh.Scene([left, right]).export(tmp_path / "two.glb")
            body = load_body(tmp_path / "two.glb")
            assert len(body.faces) == 24
            np.testing.assert_allclose(seen(body, "left"), np.tile(RED, (12, 1)))
            np.testing.assert_allclose(seen(body, "right"), np.tile(BLUE, (12, 1)))


def test_glb_instances_are_transformed(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(box(0, RED), geom_name="box")
    scene.graph.update("again", matrix=trimesh.transformations.translation_matrix([3, 0, 0]), geometry="box")
    scene.export(tmp_path / "two.glb")
    body = load_body(tmp_path / "two.glb")
    size = np.ptp(body.vertices, axis=0)
    assert len(body.faces) == 24 and size[0] / size[1] == pytest.approx(4)


def ply(folder, vertex_type, colours_of):
    """Two boxes; ``colours_of`` "vertex" or "face"."""
    points = [(x + at, y, z) for at in (0, 3) for x, y, z in CORNERS]
    faces = [tuple(k + b for k in t) for b in (0, 8) for s in SIDES for t in ((s[0], s[1], s[2]), (s[0], s[2], s[3]))]
    one = 255 if vertex_type == "uchar" else 1
    paint = [" ".join(str(one * c) for c in (RED if i < n // 2 else BLUE)) for n in (16, 24) for i in range(n)]
    names = "".join(f"property {vertex_type} {name}\n" for name in ("red", "green", "blue"))
    own = {part: names if part == colours_of else "" for part in ("vertex", "face")}
    text = "ply\nformat ascii 1.0\nelement vertex 16\nproperty float x\nproperty float y\nproperty float z\n"
    text += own["vertex"] + "element face 24\nproperty list uchar int vertex_indices\n" + own["face"] + "end_header\n"
    for i, point in enumerate(points):
        text += " ".join(map(str, point)) + (f" {paint[i]}" if own["vertex"] else "") + "\n"
    for i, face in enumerate(faces):
        text += "3 " + " ".join(map(str, face)) + (f" {paint[16 + i]}" if own["face"] else "") + "\n"
    (folder / "two.ply").write_text(text)
    return folder / "two.ply"


@pytest.mark.parametrize("kind", [("uchar", "vertex"), ("float", "vertex"), ("uchar", "face")])
def test_ply_vertex_and_face_colours(tmp_path, kind):
    body = load_body(ply(tmp_path, *kind), "z")
    assert len(body.faces) == 24
    np.testing.assert_allclose(seen(body, "left"), np.tile(RED, (12, 1)))
    np.testing.assert_allclose(seen(body, "right"), np.tile(BLUE, (12, 1)))


def test_stl_and_off_of_several_bodies(tmp_path):
    both = trimesh.util.concatenate([box(0), box(3)])
    both.export(tmp_path / "two.off")
    both.export(tmp_path / "two.stl")
    ascii_stl = "\n".join(trimesh.exchange.stl.export_stl_ascii(box(at)) for at in (0, 3))
    (tmp_path / "solids.stl").write_text(ascii_stl)
    for name in ("two.off", "two.stl", "solids.stl"):
        body = load_body(tmp_path / name, "z")
        assert len(body.vertices) == 16 and len(body.faces) == 24


def off(folder, header, colours="", faces=""):
    points = "".join(f"{x} {y} {z}{colours}\n" for x, y, z in CORNERS)
    text = f"{header}\n8 6 0\n{points}" + "".join("4 " + " ".join(map(str, side)) + faces + "\n" for side in SIDES)
    (folder / "body.off").write_text(text)
    return folder / "body.off"


def prism():
    """An L-shaped prism, its ends polygons of six corners."""
    shape = [(2, 1), (1, 1), (1, 2), (0, 2), (0, 0), (2, 0)]
    text = "".join(f"v {x} {y} {z}\n" for z in (0, 1) for x, y in shape) + "f 6 5 4 3 2 1\nf 7 8 9 10 11 12\n"
    return text + "".join(f"f {k + 1} {(k + 1) % 6 + 1} {(k + 1) % 6 + 7} {k + 7}\n" for k in range(6))


def textured(folder, options):
    (folder / "skin.mtl").write_text(f"newmtl red\nmap_Kd {options}skin.png\n")
    return write(folder, "mtllib skin.mtl\nusemtl red\n" + vertices() + sides(1))


def coloured_ply(folder, of_vertices, of_faces):
    def colours(first):
        names = [first, *(first.replace("red", name) if "red" in first else name for name in ("green", "blue"))]
        return "".join(f"property uchar {name}\n" for name in names) if first else ""

    header = "ply\nformat ascii 1.0\nelement vertex 8\n" + "".join(f"property float {name}\n" for name in "xyz")
    header += f"{colours(of_vertices)}element face 6\nproperty list uchar int vertex_indices\n{colours(of_faces)}"
    rows = [[*corner, *([9, 9, 9] if of_vertices else [])] for corner in CORNERS]
    rows += [[4, *side, *([9, 9, 9] if of_faces else [])] for side in SIDES]
    body = "".join(" ".join(map(str, row)) + "\n" for row in rows)
    (folder / "body.ply").write_text(header + "end_header\n" + body)
    return folder / "body.ply"


def stl(folder):
    data = bytearray(trimesh.exchange.stl.export_stl(box(0)))
    data[84 + 48 : 84 + 50] = struct.pack("<H", 1 << 15 | 31)
    (folder / "body.stl").write_bytes(data)
    return folder / "body.stl"


def glb(folder, **keys):
    box(0).export(folder / "body.gltf")
    content = json.loads((folder / "body.gltf").read_text())
    (folder / "body.gltf").write_text(json.dumps({**content, **keys}))
    return folder / "body.gltf"


REFUSED = {
    "a face twice": (lambda d: write(d, vertices() + sides(1) + sides(1)), "has 12 duplicate faces"),
    "a side twice": (lambda d: write(d, vertices() + sides(1) + sides(1, [SIDES[0][::-1]] * 2)), "duplicate faces"),
    "no material file": (lambda d: write(d, "mtllib no.mtl\nusemtl red\n" + vertices() + sides(1)), "no.mtl is"),
    "no material": (lambda d: write(d, "mtllib two.mtl\nusemtl rde\n" + vertices() + sides(1)), "material 'rde'"),
    "a vertex too many": (lambda d: write(d, vertices() + sides(1) + "f 1 2 9\n"), "line 15: invalid index 9"),
    "an edge": (lambda d: write(d, vertices() + "f 1 2\n"), "line 9: a face needs three corners"),
    "vertex 0": (lambda d: write(d, vertices() + sides(0)), "line 9: invalid index 0: only 8"),
    "too far back": (lambda d: write(d, vertices() + sides(-9)), "only 8 are defined before"),
    "no number": (lambda d: write(d, "v 0 0 x\n"), "line 1: "),
    "colours out of range": (lambda d: write(d, vertices(0, (-1, 0, 0)) + sides(1)), "vertex colours must be in"),
    "an archive": (lambda d: write(d, "", "body.zip"), "the supported formats are .glb, .gltf, .obj"),
    "COFF": (lambda d: off(d, "COFF", " 255 0 0 255"), "colours, which are not supported in OFF"),
    "both sides of every face": (lambda d: write(d, vertices() + sides(1) + sides(1, INWARDS)), "or doubled faces"),
    "a second body on top": (lambda d: write(d, vertices() + sides(1) + vertices() + sides(9, INWARDS)), "or doubled"),
    "a concave polygon": (lambda d: write(d, prism()), "fold back onto others, as of concave polygons"),
    "a texture that repeats": (lambda d: textured(d, "-s 2 2 1 "), "option -s of map_Kd of material 'red'"),
    "a texture that is moved": (lambda d: textured(d, "-blendu on -o 1 0 0 "), "option -o of map_Kd"),
    "colours of some vertices": (lambda d: write(d, vertices(0, RED) + sides(1) + vertices(3) + sides(9)), "8 of 16"),
    "free-form geometry": (lambda d: write(d, vertices() + sides(1) + "surf 0 1 0 1 1 2 3 4\n"), "line 15: surf"),
    "other names of PLY colours": (
        lambda d: coloured_ply(d, "diffuse_red", ""),
        "has diffuse_red, which is not supported",
    ),
    "colours r, g, b of a PLY": (lambda d: coloured_ply(d, "r", ""), "has r, which is not supported"),
    "colours of PLY polygons": (lambda d: coloured_ply(d, "", "red"), "faces with colours must be triangles"),
    "colours of STL faces": (lambda d: stl(d), "colours, which are not supported in STL"),
    "a texture transform": (lambda d: glb(d, extensionsUsed=["KHR_texture_transform"]), "has KHR_texture_transform"),
    "compression": (lambda d: glb(d, extensionsRequired=["KHR_materials_unlit", "KHR_draco_x"]), "has KHR_draco_x"),
    "second coordinates": (lambda d: glb(d, x={"baseColorTexture": {"index": 0, "texCoord": 1}}), "has texCoord"),
    "colours of OFF faces": (lambda d: off(d, "OFF", faces=" 255 0 0"), "colours, which are not supported in OFF"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_load_body_refuses_what_it_would_lose(tmp_path, name):
    make, message = REFUSED[name]
    path = make(tmp_path)
    with pytest.raises(InputError, match=message) as error:
        load_body(path)
    assert str(path) in str(error.value)


def test_obj_missing_textures_are_named(tmp_path):
    path = write(tmp_path, "mtllib skin.mtl\nvt 0 0\nusemtl skin\n" + vertices() + sides(1))
    (tmp_path / "skin.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    with pytest.raises(InputError, match="texture skin.png of material 'skin' is missing, next to skin.mtl"):
        load_body(path)
    (tmp_path / "skin.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="texture skin.png cannot be decoded"):
        load_body(path)
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "skin.png")
    with pytest.raises(InputError, match="have a texture, but no texture coordinates"):
        load_body(path)
    (tmp_path / "skin.mtl").write_text("newmtl skin\nKd 1 red 0\n")
    with pytest.raises(InputError, match="Kd of material 'skin' must be three numbers"):
        load_body(path)


@pytest.mark.parametrize("start", [b"", b"\xef\xbb\xbf"])
def test_obj_words_may_be_apart_by_tabs(tmp_path, start):
    text = ("mtllib skin.mtl\nusemtl red\n" + vertices() + sides(1)).replace(" ", "\t")
    path = write(tmp_path, "")
    path.write_bytes(start + text.encode())
    (tmp_path / "skin.mtl").write_bytes(start + b"newmtl\tred\n\tKd\t1 0 0\n")
    body = load_body(path)
    np.testing.assert_allclose(body.paint(body.corners[0]), [RED] * 3)


def test_mtl_comments_and_single_material(tmp_path):
    path = write(tmp_path, "mtllib skin.mtl\nusemtl exported\n" + vertices() + sides(1))
    (tmp_path / "skin.mtl").write_text("newmtl skin # the one\nKd 0.25 0.5 1.000  # red, green, blue\n")
    body = load_body(path)
    np.testing.assert_allclose(body.paint(body.corners[0]), [[0.25, 0.5, 1.0]] * 3)
    (tmp_path / "skin.mtl").write_text("newmtl skin\nKd 1 1 1\nnewmtl other\nKd 0 0 0\n")
    with pytest.raises(InputError, match="material 'exported' is in none of"):
        load_body(path)


def test_stl_colours_are_refused(tmp_path):
    data = bytearray(trimesh.exchange.stl.export_stl(box(0)))
    data[:80] = b"COLOR=" + struct.pack("4B", 255, 0, 0, 255) + bytes(70)
    (tmp_path / "body.stl").write_bytes(bytes(data))
    with pytest.raises(InputError, match="not supported in STL"):
        load_body(tmp_path / "body.stl")

"""gsim3d check-data: every problem of every scene, exit codes, and what the contact sheet shows."""

import os
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from gsim3d.cli.main import main
from gsim3d.data import Scene
from gsim3d.data.check import check_scene, contact_sheet, moving_box
from tests.data.made_scenes import RADIUS, WRITERS, edit_json, make_scene, write_genesis, write_videos
from tests.tiny_scenes import write_scene


@pytest.fixture
def data(tmp_path):
    """Three sound scenes in three layouts."""
    for layout in ("genesis", "kubric", "videos"):
        WRITERS[layout](tmp_path / "data" / layout, make_scene())
    return tmp_path / "data"


def test_check_data_accepts_sound_scenes(data, capsys):
    out = data.parent / "sheet.png"
    assert main(["check-data", str(data), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "3 scenes read, no problem" in printed and "problem:" not in printed
    for layout in ("genesis", "kubric", "videos"):
        assert f"data/{layout}: {layout}, 4 steps at 12 fps, 3 cameras, 48x32 pixels" in printed
    assert [path.name for path in data.parent.iterdir() if path != data] == ["sheet.png"]


def test_check_data_lists_every_problem_of_every_scene(data, capsys):
    (data / "genesis/cam_0/rgb_0001.png").unlink()
    (data / "genesis/cam_2/rgb_0003.png").write_bytes(b"x")
    edit_json(data / "kubric/cam_1/metadata.json", lambda content: content["camera"]["positions"].pop())
    (data / "videos/cameras.json").write_text("{")
    out = data.parent / "sheet.png"
    assert main(["check-data", str(data), "--out", str(out)]) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  problem: ")]
    assert len(lines) >= 4
    expected = [
        "rgb_0001.png (camera cam_0, frame 1) is missing",
        "rgb_0003.png (camera cam_2, frame 3) cannot be decoded",
        "camera cam_1: camera.quaternions",
        "cameras.json cannot be read",
    ]
    assert all(any(text in line for line in lines) for text in expected)
    assert out.is_file()


def test_check_data_writes_nothing_without_out(data, capsys, monkeypatch):
    monkeypatch.chdir(data.parent)
    assert main(["check-data", "data"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "3 scenes read, no problem; use --out to draw a contact sheet"
    assert [path.name for path in data.parent.iterdir()] == ["data"]


def test_check_data_quiet_prints_problems_only(data, capsys):
    (data / "videos/cameras.json").write_text("{")
    assert main(["check-data", str(data), "--quiet"]) == 1
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert lines[0].startswith(f"{data / 'videos'}: ") and lines[1].startswith("  problem: ")
    assert all(line.startswith("  problem: ") for line in lines[1:-1]) and lines[-1].startswith("3 scenes read, ")
    assert printed.err == ""


def test_check_data_without_readable_scene_draws_nothing(tmp_path, capsys):
    (tmp_path / "cameras.json").write_text("[]")
    assert main(["check-data", str(tmp_path), "--out", str(tmp_path / "sheet.png")]) == 1
    assert "no scene could be opened" in capsys.readouterr().out and not (tmp_path / "sheet.png").exists()


@pytest.mark.parametrize(
    "arguments", [["{data}/absent"], ["{empty}"], ["{data}", "--out", "a.jpg"], ["{data}", "--out", "{file}/no/a.png"]]
)
def test_check_data_exit_code_where_it_cannot_run(data, tmp_path, capsys, arguments):
    (tmp_path / "empty").mkdir()
    paths = {"data": data, "empty": tmp_path / "empty", "file": data / "genesis" / "metadata.json"}
    words = [word.format(**paths) for word in arguments]
    assert main(["check-data", *words]) == 2
    assert capsys.readouterr().err.startswith("gsim3d: error: ")


def test_contact_sheet_draws_bounds_at_their_projection(tmp_path):
    """On black frames only the drawing is left: corners of the bounds are where a plain projection puts them."""
    made = make_scene()
    made.rgb[:], made.labels[:] = 0, 0
    scene = Scene.open(write_videos(tmp_path, made))
    sheet = contact_sheet([scene])
    rows = sheet[22:, :].astype(int)
    height = (len(sheet) - 2 * 22) // 3 - 6
    drawn = 0
    for cam in range(3):
        zoom, left = height / 32, cam * (round(48 * height / 32) + 6)
        for corner in np.stack(np.meshgrid(*scene.bounds.T, indexing="ij"), -1).reshape(-1, 3):
            local = made.viewmats[0, cam] @ [*corner, 1]
            x, y = (zoom * (made.Ks[0, cam] @ local[:3] / local[2])[:2]).round().astype(int)
            if 3 < x < 48 * zoom - 4 and 20 < y < height - 4:
                patch = rows[y - 2 : y + 3, left + x - 2 : left + x + 3]
                assert (np.abs(patch - [255, 220, 60]).sum(-1) < 150).any()
                drawn += 1
    assert drawn >= 6


def test_moving_box_encloses_the_ball(tmp_path):
    made = make_scene()
    scene = Scene.open(write_genesis(tmp_path, made))
    for step in range(4):
        box, n_cams = moving_box(scene, step)
        assert n_cams == 3 and np.abs(box.mean(0) - made.centers[step]).max() < RADIUS
        assert (box[0] < made.centers[step]).all() and (box[1] > made.centers[step]).all()
        assert (box[1] - box[0] > 1.5 * RADIUS).all() and (box[1] - box[0] < 6 * RADIUS).all()


def test_check_scene_reports_masks_without_common_position(tmp_path):
    made = make_scene()
    made.labels[:, 1:] = 0
    made.labels[:, 1, :4, :4], made.labels[:, 2, -4:, -4:] = 3, 3
    (problem,) = check_scene(write_genesis(tmp_path / "scene", made)).problems
    assert "no common position" in problem and "metadata.json" in problem


def test_contact_sheet_with_unreadable_frames(tmp_path):
    folder = write_genesis(tmp_path, make_scene())
    for file in folder.rglob("rgb_*.png"):
        file.unlink()
    sheet = contact_sheet([check_scene(folder).scene])
    assert (sheet == 190).all(-1).mean() > 0.3
    assert cv2.imwrite(str(tmp_path / "sheet.png"), sheet)


def test_check_data_escapes_names_that_are_not_utf8(tmp_path, capsys):
    """OpenCV ends the process at letters that no encoding has."""
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/sc\xff\x1bne"))
    write_scene(tmp_path / "scene", n_steps=2).rename(folder)
    assert main(["check-data", str(folder), "--out", str(tmp_path / "sheet.png")]) == 0
    assert "sc\\udcff\\x1bne" in capsys.readouterr().out
    assert cv2.imread(str(tmp_path / "sheet.png")) is not None


def test_check_data_shows_the_progress_of_one_scene(tmp_path, capsys, monkeypatch):
    write_genesis(tmp_path, make_scene())
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    for options, shown in (([], True), (["--quiet"], False)):
        assert main(["check-data", str(tmp_path), *options]) == 0
        assert ("24/24" in capsys.readouterr().err) == shown  # images and labels of 3 cameras, 4 steps

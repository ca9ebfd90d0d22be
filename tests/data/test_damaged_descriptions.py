"""Whatever stands in a description, opening and checking the scene end in a typed error or in a scene, nothing else."""

import copy
import json

import numpy as np
import pytest

from gsim3d.data import Scene
from gsim3d.data.check import check_scene
from gsim3d.errors import InputError
from tests.data.made_scenes import WRITERS, edit_json, make_scene

JUNK = [
    None,
    True,
    0,
    -1,
    3.5,
    1e308,
    float("nan"),
    float("inf"),
    "",
    "x",
    "../..",
    "\0",
    [],
    {},
    [[]],
    [1, "a"],
    [None] * 4,
]
JUNK += [10**30, "9" * 400, {"a": 1}, [[1, 2], [3]]]
FILES = {
    "genesis": "metadata.json",
    "kubric": "cam_1/metadata.json",
    "transforms": "transforms.json",
    "videos": "cameras.json",
}
N_CASES = 60


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("scenes")
    made = make_scene(moving=True, width=16, height=16, n_steps=2, n_cams=2)
    written = {layout: WRITERS[layout](root / layout, made) for layout in FILES}
    optional = {
        "videos": {"units": "m", "pixel_center": 0.5, "masks": "subtract"},
        "transforms": {"k1": 0.1, "p2": 0.01},
    }
    for layout, keys in optional.items():
        edit_json(written[layout] / FILES[layout], lambda content: content.update(keys))
    return written


def key_paths(content, path=()):
    """Paths to every value inside."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from key_paths(value, (*path, key))


def damaged(content, rng):
    """A copy with one to three values replaced or removed."""
    content = copy.deepcopy(content)
    for _ in range(rng.integers(1, 4)):
        known = list(key_paths(content))
        if not known:
            break
        *way, key = known[rng.integers(len(known))]
        parent = content
        for step in way:
            parent = parent[step]
        if rng.random() < 0.2:
            parent.pop(key)
        else:
            parent[key] = copy.deepcopy(JUNK[rng.integers(len(JUNK))])
    return content


@pytest.mark.parametrize("layout", FILES)
def test_damaged_descriptions_give_typed_errors(folders, layout):
    file = folders[layout] / FILES[layout]
    sound, rng, refused = json.loads(file.read_text()), np.random.default_rng(0), 0
    try:
        for _ in range(N_CASES):
            content = damaged(sound, rng)
            file.write_text(json.dumps(content))
            try:
                scene = Scene.open(folders[layout])
                scene.images([0], [0])
            except InputError as error:
                refused += 1
                assert len(str(error)) < 2000
                assert check_scene(folders[layout]).problems
            except Exception as error:
                raise AssertionError(f"{type(error).__name__}: {error} for {json.dumps(content)[:3000]}") from error
    finally:
        file.write_text(json.dumps(sound))
    assert refused > N_CASES / 3

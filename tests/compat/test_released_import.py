"""gsim3d import: published files become checkpoints, or a message that says what does not fit."""

import copy
import json

import pytest
import torch
import yaml

from gsim3d.cli.main import main
from gsim3d.compat.released import DYNAMICS, from_published, to_published
from gsim3d.compat.released_config import read_config
from gsim3d.compat.released_import import import_released, published_shapes, untrained_signs
from gsim3d.errors import InputError
from gsim3d.io.checkpoint import load
from gsim3d.simulator import Simulator
from gsim3d.train.restore import restore
from tests.compat.release import changed, full_config, random_weights, settings_of, small_config, write_release
from tests.tiny_scenes import write_scene

VARIANTS = {
    "latent": {},
    "explicit": {"explicit": True, "dynamic": 0, "static": 0},
    "explicit with latents": {"explicit": True, "dynamic": 0, "static": 2},
    "several steps a call": {"steps_per_call": 3, "predicts": "from_previous"},
    "explicit, absolute": {"explicit": True, "dynamic": 2, "static": 1, "predicts": "absolute", "steps_per_call": 2},
}


def run_import(capsys, checkpoint, config, out):
    code = main(["import", str(checkpoint), "--config", str(config), "-o", str(out)])
    output = capsys.readouterr()
    return code, output.out, output.err


@pytest.mark.parametrize("variant", VARIANTS)
def test_weights_and_settings_arrive(capsys, tmp_path, variant):
    config = small_config(**VARIANTS[variant])
    weights = random_weights(config)
    files = write_release(tmp_path, weights, settings_of(config))
    code, out, err = run_import(capsys, *files, tmp_path / "model")
    assert code == 0 and err == "" and "epoch 3, global step 1200" in out
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model", "model.ckpt", "model.yaml"]
    restored = restore(tmp_path / "model")
    assert restored.simulator.config == config
    assert restored.image_size == (32, 32) and restored.data.history == 2
    assert restored.data.context_cameras == (0, 2) and restored.data.target_only_cameras == (1, 3)
    assert restored.plan.spec.dynamics.background == "frozen"
    expected = from_published(weights, config)
    actual = restored.simulator.state_dict()
    assert actual.keys() == expected.keys()
    assert all(torch.equal(value, expected[name]) for name, value in actual.items())
    back = to_published(actual, config)
    assert all(torch.allclose(value, back[name], rtol=0, atol=1e-6) for name, value in weights.items())
    assert load(tmp_path / "model").state["step"] == 1200


@pytest.mark.slow
@pytest.mark.parametrize("history", [4, 2])
def test_full_size_round_trip(capsys, tmp_path, history):
    config = full_config("paper_latent", history, 64)
    weights = random_weights(config)
    settings = settings_of(config, 128)
    code, out, _ = run_import(capsys, *write_release(tmp_path, weights, settings), tmp_path / "model")
    assert code == 0 and "57,992,185 parameters" in out and f"history of {history}" in out
    saved = load(tmp_path / "model")
    back = to_published(saved.weights, config)
    assert all(torch.equal(value, back[name]) for name, value in weights.items())
    assert restore(tmp_path / "model").simulator.config == config


def test_tensors_that_do_not_fit_are_named(capsys, tmp_path):
    config = small_config()
    weights = random_weights(config)
    del weights["encoder.depth_predictor.upsampler.0.bias"]
    name = "dynamic_model.net.enc.enc1.block1.attn.qkv.weight"
    weights[name] = weights[name][:-1]
    weights["encoder.something.weight"] = torch.ones(2)
    code, out, err = run_import(capsys, *write_release(tmp_path, weights, settings_of(config)), tmp_path / "model")
    assert code == 2 and out == "" and len(err.splitlines()) == 1
    assert "1 missing: encoder.depth_predictor.upsampler.0.bias" in err
    assert f"1 of another shape: {name} is [47, 16] instead of [48, 16]" in err
    assert "1 unexpected: encoder.something.weight" in err
    assert not (tmp_path / "model").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda w, name: w.pop(name), "its tensors do not fit the configuration; 1 missing: {name}$"),
        (lambda w, name: w.update({name: w[name][1:]}), r"configuration; 1 of another shape: {name} is \[11\] instead"),
    ],
)
def test_single_misfitting_tensor_is_refused(tmp_path, change, message):
    config = small_config()
    weights, name = random_weights(config), "encoder.backbone.backbone.layer2.0.downsample.0.bias"
    change(weights, name)
    checkpoint, _ = write_release(tmp_path, weights, {})
    with pytest.raises(InputError, match=message.format(name=name)):
        import_released(checkpoint, settings_of(config))


def test_tensors_that_the_model_has_not_are_listed(capsys, tmp_path):
    config = small_config()
    weights = random_weights(config)
    weights["losses.1.lpips.weight"] = torch.ones(2)
    code, out, _ = run_import(capsys, *write_release(tmp_path, weights, settings_of(config)), tmp_path / "model")
    assert code == 0 and "ignored tensors (also ignored by the release): losses.1.lpips.weight" in out


def shapes_and_settings(*variant):
    config = small_config(*variant)
    return published_shapes(config), settings_of(config)


def test_sizes_come_from_the_weights():
    shapes, settings = shapes_and_settings()
    for path, value in {
        "model.state_adapter.dynamic_latent_feature_dim": 64,
        "model.encoder.num_depth_candidates": 128,
        "model.dynamic_model.model.enc_depths": [1, 1, 1],
        "model.dynamic_model.model.merge_window_size": [4, 4],
    }.items():
        read = read_config(changed(settings, path, value), shapes)
        assert read.model == small_config()
        assert any(note.startswith(f"{path} is {value!r}, but the weights have") for note in read.notes)
    assert not any("but the weights" in note for note in read_config(settings, shapes).notes)


def test_settings_that_no_weight_shows():
    shapes, settings = shapes_and_settings()

    def read(path, value):
        return read_config(changed(settings, path, value), shapes)

    net = "model.dynamic_model.model"
    assert read(f"{net}.stride", [2, 8]).model.dynamics.strides == (2, 8)
    assert read(f"{net}.grid_size", 0.004).model.dynamics.grid_size == 0.004
    assert read("model.state_adapter.metric", 3).model.dynamics.max_step == 1.5
    assert read("model.state_adapter.pred_inductive_bias", False).model.dynamics.max_step is None
    assert read("model.state_adapter.gaussians.scale_max", 0.2).model.renderer.scale_max == 0.2
    assert read("dataset.n_step_state", 4).model.dynamics.history_bits == 2
    assert read("dataset.near", 0.5).data["near_far"] == [0.5, 4.0]
    wide = read("dataset.image_shape", [64, 96]).data
    assert wide["image_size"] == wide["resize"] == [96, 64]
    assert read("dataset.make_baseline_1", True).data["unit_cameras"] is True
    assert read("dataset.with_seg", False).effects.dynamics.background == "dynamic"
    assert read(f"{net}.grid_size", "4e-3").model.dynamics.grid_size == 0.004  # as YAML 1.1 reads it


@pytest.mark.parametrize(
    ("test_views", "train_views", "count", "cameras"),
    [
        ([1, 3, 5], None, 3, [1, 3, 5]),
        ([[1, 3], [0, 2]], None, 2, [1, 3]),
        (None, [0, 2, 4, 6, 8], 4, [0, 2, 4, 6, 8]),
        (None, None, 4, []),
    ],
)
def test_input_cameras(test_views, train_views, count, cameras):
    shapes, settings = shapes_and_settings()
    settings["dataset"]["view_sampler"].update(
        num_context_views=4, test_context_views=test_views, context_views=train_views, test_target_views=[1, 7]
    )
    data = read_config(settings, shapes).data
    assert (data["context_views"], data["context_cameras"]) == (count, cameras)
    assert data["target_only_cameras"] == ([7] if test_views else [1, 7])


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("model.dynamic_model.model", ..., "is missing; use the resolved configuration"),
        ("model.dynamic_model.model.grid_size", ..., "model.dynamic_model.model.grid_size: is missing"),
        ("model.dynamic_model.model.grid_size", "0.004", "grid_size: must be a number; got '0.004'"),
        ("model.dynamic_model.model.grid_size", 0, "grid_size: must be above 0"),
        ("model.dynamic_model.model.stride", "[4,2]", r"stride: must be a list of 2 integers; got '\[4,2\]'"),
        ("model.dynamic_model.model.stride", [4, 3], r"stride: must be powers of two; got \[4, 3\]"),
        ("model.dynamic_model.model.enc_num_head", [3, 4, 4], "cannot be split into 3 heads"),
        ("model.dynamic_model.model.order", ["z"], "order: .* is not supported"),
        ("model.dynamic_model.model.pdnorm_bn", True, "pdnorm_bn: True is not supported; only False is"),
        ("model.dynamic_model.model.dec_patch_size", [32, 64], "dec_patch_size: must equal enc_patch_size"),
        ("model.encoder.wo_cost_volume", True, "wo_cost_volume: True is not supported"),
        ("model.encoder.opacity_mapping.final", 1.0, "opacity_mapping.final: 1.0 is not supported"),
        ("model.encoder.costvolume_unet_channel_mult", [1, 2, 4], "must be ones"),
        ("model.state_adapter.gaussians.rotations", 6, "rotations: 6 is not supported"),
        ("model.state_adapter.learn_static_mask", True, "learn_static_mask: True is not supported"),
        ("model.state_adapter.state_3dgs_params", ["means", "opacities", "scales"], "must be means and opacities, or"),
        ("model.state_adapter.state_3dgs_params", ["means", "opacities", "rotations", "scales", "harmonics"],
         "describes the explicit variant, but the weights are of the latent one"),
        ("model.state_adapter.pred_modality.means", "z_x", "must be one of cx_x, cx_dx, z_x, equal for all"),
        ("model.state_adapter.dynamic_state_keys", ["opacities"], "changing opacities are not supported"),
        ("dataset.n_step_state", 3, "n_step_state: must be 1, 2, 4, 8; got 3"),
        ("dataset.n_step_state_predict", -1, "n_step_state_predict: 2 is not supported"),
        ("dataset.far", 0.5, "far: must lie beyond near"),
        ("dataset.image_shape", [100, 128], "image_shape: must be multiples of 16; got 100, 128"),
        ("dataset.baseline_scale_bounds", True, "baseline_scale_bounds: .* not supported"),
        ("dataset.view_sampler.test_context_views", ["a"], "must be a list of camera numbers"),
    ],
)  # fmt: skip
def test_settings_that_do_not_fit_are_refused(path, value, message):
    shapes, settings = shapes_and_settings()
    with pytest.raises(InputError, match=message):
        read_config(changed(settings, path, value), shapes)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("model.state_adapter.dynamic_state_keys", ["means", "rotations"], "harmonics, opacities, scales is missing"),
        ("model.state_adapter.immune_to_static", [], r"must be \[harmonics\]; got nothing"),
        ("model.state_adapter.pred_modality.rotations", "z_x", "pred_modality: must be one of .*'rotations': 'z_x'"),
    ],
)
def test_settings_of_the_explicit_variant(path, value, message):
    shapes, settings = shapes_and_settings(True, 0, 2)
    with pytest.raises(InputError, match=message):
        read_config(changed(settings, path, value), shapes)


def test_several_steps_at_once():
    shapes, settings = shapes_and_settings()
    shapes[f"{DYNAMICS}dec.2.fc2.weight"] = (14, 8)
    read = read_config(settings, shapes)
    assert read.model.dynamics.steps_per_call == 2
    assert "dataset.n_step_predict_multiple is 1, but the weights have 2, which is used" in read.notes
    shapes[f"{DYNAMICS}dec.2.fc2.weight"] = (15, 8)
    with pytest.raises(InputError, match="predicts 15 values per particle, but a step of this variant needs 7"):
        read_config(settings, shapes)


def test_every_setting_is_read_refused_or_listed_as_ignored():
    """No key is silently lost: whatever changes nothing is in the list."""
    shapes, settings = shapes_and_settings()
    settings["model"]["dynamic_model.model"] = {"stride": "[4,2,2,2]"}
    ignored = read_config(settings, shapes).ignored
    assert {"wandb", "model.decoder", "dataset.name", "model.encoder.opacity_mapping.warm_up"} <= set(ignored)
    assert 'model."dynamic_model.model"' in ignored  # the release, too, passes over this literal dotted key
    known = {"model.dynamic_model.model.stride", "dataset.near", "model.encoder.name", "model.state_adapter.metric"}
    assert not known & set(ignored)


def test_untrained_attention_is_recognised():
    config = small_config()
    torch.manual_seed(0)
    drawn = to_published(Simulator(config).state_dict(), config)
    fresh = untrained_signs(drawn)
    assert fresh.blocks == fresh.n_blocks == 6 and fresh.latent_heads is True
    assert "6 of 6 attention and MLP blocks look untrained" in fresh.sentence()
    decayed = {name: 0.98 * value if value.is_floating_point() else value for name, value in drawn.items()}
    assert untrained_signs(decayed) == fresh
    trained = untrained_signs(random_weights(config))
    assert trained.blocks == 0 and trained.latent_heads is False and "have been trained" in trained.sentence()
    block = f"{DYNAMICS}dec.dec1.block0."
    for name, change in {
        "norm1.0.weight": lambda v: v + torch.linspace(0, 1e-6, len(v)),
        "norm2.0.bias": lambda v: v + 1e-8,
        "mlp.0.fc1.weight": lambda v: v * 1.5,
        "attn.proj.bias": lambda v: v + 1,
    }.items():
        touched = copy.copy(drawn)
        touched[block + name] = change(drawn[block + name])
        signs = untrained_signs(touched)
        assert signs.blocks == 5 and signs.latent_heads, name


def test_weights_without_latent_heads_have_no_signs_of_them():
    config = small_config(True, 0, 0)
    assert untrained_signs(random_weights(config)).latent_heads is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("missing.ckpt", "model.yaml", "model"), "missing.ckpt: no such file"),
        (("model.yaml", "model.yaml", "model"), "model.yaml: not a checkpoint that torch.save wrote"),
        (("model.ckpt", "missing.yaml", "model"), "missing.yaml cannot be read"),
        (("model.ckpt", "model.yaml", "there"), "exists already"),
        (("model.ckpt", "model.yaml", "model.yaml/b"), "model.yaml"),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_2(capsys, tmp_path, arguments, message):
    config = small_config()
    write_release(tmp_path, random_weights(config), settings_of(config))
    (tmp_path / "there").mkdir()
    before = sorted(tmp_path.rglob("*"))
    code, out, err = run_import(capsys, *(tmp_path / argument for argument in arguments))
    assert code == 2 and out == "" and len(err.splitlines()) == 1 and message in err
    assert sorted(tmp_path.rglob("*")) == before


def test_wrong_setting_is_named_with_its_file(capsys, tmp_path):
    config = small_config()
    settings = changed(settings_of(config), "model.encoder.num_surfaces", 2)
    code, _, err = run_import(capsys, *write_release(tmp_path, random_weights(config), settings), tmp_path / "model")
    assert code == 2 and f"{tmp_path / 'model.yaml'}: model.encoder.num_surfaces: 2 is not supported" in err


def test_imported_model_is_evaluated_at_its_own_size(capsys, tmp_path):
    """Videos of twice the size, with depth bounds of their own, are fitted to what the model was trained on."""
    config = small_config()
    settings = changed(settings_of(config), "dataset.view_sampler.num_context_views", 2)
    files = write_release(tmp_path, random_weights(config), settings)
    assert run_import(capsys, *files, tmp_path / "model")[0] == 0
    scene = restore(tmp_path / "model").open_scene(write_scene(tmp_path / "scenes" / "ball", 4, size=64))
    assert (scene.width, scene.height, scene.near, scene.far) == (32, 32, 1.0, 4.0)
    arguments = ["evaluate", tmp_path / "model", tmp_path / "scenes", "--steps", "1", "--metrics", "psnr"]
    assert main([str(argument) for argument in arguments]) == 0
    metrics = json.loads((tmp_path / "model" / "metrics.json").read_text())
    assert isinstance(metrics["future.psnr"], float)


def test_wrong_file_is_named(capsys, tmp_path, monkeypatch):
    config = small_config()
    write_release(tmp_path, {"a": torch.ones(1)}, settings_of(config))
    monkeypatch.chdir(tmp_path)
    code, _, err = run_import(capsys, "./model.ckpt", "./model.yaml", "model")
    assert code == 2 and err.startswith(
        "gsim3d: error: model.ckpt: encoder.depth_predictor.to_gaussians.2.weight is missing"
    )


def test_findings_are_saved_with_the_weights(tmp_path):
    config = small_config()
    weights = random_weights(config)
    files = write_release(tmp_path, weights, changed(settings_of(config), "dataset.speedup", 2))
    imported = import_released(files[0], yaml.safe_load(files[1].read_text()))
    learned = [value for name, value in weights.items() if "running" not in name and "num_batches" not in name]
    assert imported.n_parameters == sum(value.numel() for value in learned)
    assert main(["import", *map(str, (files[0], "--config", files[1], "-o", tmp_path / "model"))]) == 0
    state = json.loads((tmp_path / "model" / "state.json").read_text())["imported"]
    assert state["file"] == "model.ckpt" and state["untrained_blocks"] == 0
    assert any("speedup" in note for note in state["notes"])

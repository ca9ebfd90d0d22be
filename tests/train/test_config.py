"""Configurations: typed, and nothing unknown is accepted."""

import dataclasses
import math
import re
import typing
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
import yaml

from gsim3d import presets
from gsim3d.data import Fitting
from gsim3d.effects.edits import load_edits
from gsim3d.effects.spec import EffectsSpec
from gsim3d.errors import InputError
from gsim3d.io.files import read_yaml
from gsim3d.io.settings import from_dict, to_dict, upgraded
from gsim3d.priors import PriorConfig
from gsim3d.train import restore
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.restore import build_simulator, model_config


def test_spec():
    config = TrainConfig(phases=(PhaseConfig(steps=3, horizon=2, learning_rate=1e-3),), seed=4, model={"a": [1]})
    assert from_dict(TrainConfig, to_dict(config)) == config


def test_missing_settings_come_from_the_base():
    base = TrainConfig(seed=4)
    changed = from_dict(TrainConfig, {"optimizer": {"clip_norm": 2}}, base=base)
    assert changed.seed == 4 and changed.optimizer.clip_norm == 2.0
    assert changed.optimizer.weight_decay == base.optimizer.weight_decay


@pytest.mark.parametrize(
    "content, message",
    [
        ({"sed": 1}, r"^sed: unknown setting; known here: phases, preset"),
        ({"optimizer": {"lr": 1}}, r"^optimizer\.lr: unknown setting"),
        ({"phases": [{"steps": 5}, {"step": 5}]}, r"^phases\[1\]\.step: unknown setting"),
        ({"phases": [{"horizon": 5}]}, r"^phases\[0\]\.steps: this setting is missing"),
        ({"seed": 1.5}, r"^seed: must be a whole number; got 1.5"),
        ({"seed": True}, r"^seed: must be a whole number"),
        ({"seed": -1}, r"seed must be at least 0"),
        (
            {"data": {"resize": [100, 128]}},
            r"^data\.resize: must be \[width, height\], multiples of 16 up to 32768; got \[100, 128\]",
        ),
        ({"data": {"resize": [128]}}, r"data\.resize: must be \[width, height\]"),
        (
            {"data": {"near_far": [2, 1]}},
            r"data\.near_far: must be \[near, far\] with 0 < near < far",
        ),
        ({"loss": {"perceptual": -1}}, r"perceptual must be at least 0"),
        ({"optimizer": {"beta1": "x"}}, r"^optimizer\.beta1: must be a number"),
        ({"optimizer": {"beta1": 1.0}}, r"^optimizer\.beta1 must be below 1"),
        ({"optimizer": 3}, r"^optimizer: must be a mapping"),
        ({"phases": 3}, r"^phases: must be a list"),
        ({"phases": []}, r"phases: must contain at least one"),
        ({"stages": [{"steps": 1}]}, r"^stages: unknown setting; .*; it is now called 'phases'$"),
        ({"data": {"thawed": 0.5}}, r"^data\.thawed: .*; it is now called 'unfrozen_background'$"),
        ({"phases": [{"steps": 1, "lead": 2}]}, r"^phases\[0\]\.lead: .*; this version no longer has it$"),
        ({"loss": {"shape": 1}}, r"^loss\.shape: unknown setting; .*; this version no longer has it$"),
        ({"phases": [{"steps": 0}]}, r"phases\[0\]: steps must be at least 1"),
        ({"data": {"context_cameras": [1], "target_only_cameras": [1]}}, r"share a camera"),
    ],
)
def test_wrong_settings_are_named(content, message):
    with pytest.raises(InputError, match=message):
        from_dict(TrainConfig, content)


def numbers_of(cls, where=()):
    """Paths of all numbers of a configuration, with their types."""
    for field in dataclasses.fields(cls):
        hint = typing.get_type_hints(cls)[field.name]
        if dataclasses.is_dataclass(hint):
            yield from numbers_of(hint, (*where, field.name))
        elif hint in (int, float):
            yield (*where, field.name), hint


NUMBERS = [*numbers_of(TrainConfig), *(((name,), hint) for (name,), hint in numbers_of(PhaseConfig))]
HUGE = {int: 2**62, float: 1e30}


@pytest.mark.parametrize("text", [".inf", "-.inf", ".nan", "1e39", "-1", "huge"])
def test_every_number_of_a_run_has_a_finite_range(tmp_path, text):
    file = tmp_path / "a.yaml"
    for (*sections, name), hint in NUMBERS:
        content = {name: yaml.safe_load(text)} if text != "huge" else {name: HUGE[hint]}
        cls = TrainConfig if sections or hasattr(TrainConfig, name) else PhaseConfig
        if cls is PhaseConfig:
            content = {"phases": [{"steps": 1, **content}]}
        for section in reversed(sections):
            content = {section: content}
        file.write_text(yaml.safe_dump(content))
        if (text, name) == ("huge", "seed"):
            assert from_dict(TrainConfig, read_yaml(file)).seed == 2**62
            continue
        with pytest.raises(InputError, match=rf"{name}:? must be|{name}: must be"):
            from_dict(TrainConfig, read_yaml(file))


@pytest.mark.parametrize(
    "content, message",
    [
        ({"dynamics": {"grid_size": float("inf")}}, "model.dynamics.grid_size: must be a number"),
        (
            {"dynamics": {"priors": [{"type": "gravity", "acceleration": [0, 0, float("nan")]}]}},
            r"model.dynamics.priors\[0\].acceleration\[2\]: must be a number",
        ),
        ({"dynamics": {"motion_length": 0.3}}, "model.dynamics.motion_length: physics is the list"),
        ({"dynamics": {"priors": [{"type": "wind"}]}}, r"model.dynamics.priors\[0\].type: must be one of"),
        ({"stability": {"max_speed": 1e39}}, "model.stability.max_speed: must be a number"),
        ({"encoder": {"n_depths": 2**70}}, "model.encoder.n_depths: must be a whole number"),
        ({"encoder": {"cnn_dims": [-3, 32]}}, "encoder: cnn_dims must be at least 1"),
    ],
)
def test_impossible_model_is_refused(content, message):
    with pytest.raises(InputError, match=message):
        build_simulator(model_config(TrainConfig(model=content)), 0)


def test_impossible_layer_sizes_are_named(monkeypatch):
    monkeypatch.setattr(restore, "simulator_class", lambda config: lambda config: torch.zeros(3) @ torch.zeros(2))
    with pytest.raises(InputError, match="model: sizes are not valid: RuntimeError: inconsistent tensor size"):
        build_simulator(presets.tiny(), 0)


def test_every_number_of_a_model_has_a_finite_range():
    base = to_dict(presets.tiny())
    for part, settings in base.items():
        for name, value in settings.items():
            items = value if isinstance(value, list) else [value]
            if not items or isinstance(items[0], (bool, str, dict, type(None))):
                continue
            huge = (10**39,) if part == "stability" else (2**40, 10**30)  # limits of others: float32's
            for bad in (math.inf, math.nan, -1, *huge):
                content = {part: {name: [bad, *items[1:]] if isinstance(value, list) else bad}}
                with pytest.raises(InputError, match=rf"^model\.{part}"):
                    model_config(TrainConfig(model=content))
    for kind, variant in PriorConfig.VARIANTS.items():
        for name, value in to_dict(variant()).items():
            items = value if isinstance(value, list) else [value]
            if isinstance(items[0], (bool, str)) or name == "version":
                continue
            for bad in (math.inf, math.nan, 1e30):
                bad = [[bad, 0, 1]] if isinstance(items[0], list) else [bad, *items[1:]] if value is items else bad
                with pytest.raises(InputError, match=name):
                    model_config(TrainConfig(model={"dynamics": {"priors": [{"type": kind, name: bad}]}}))


def doubled(levels, line="a{i}: &a{i} [*a{b}, *a{b}]"):
    lines = ["a0: &a0 [1, 1]"] + [line.format(i=i, b=i - 1) for i in range(1, levels)]
    return "\n".join(lines)


HOSTILE = {
    "aliases": doubled(60),
    "aliases_of_mappings": doubled(60, "a{i}: &a{i} {{x: *a{b}, y: *a{b}}}"),
    "merges": "a0: &a0 {x: 1}\n" + "\n".join(f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}" for i in range(1, 60)),
    "endless": "a: &a [*a]",
    "endless_mapping": "a: &a {b: *a}",
    "base_60": "seed: 1" + ":59" * 100_000,
    "base_60_float": "seed: 1" + ":59" * 100_000 + ".5",
    "digits": "seed: 1" + "0" * 100_000,
    "binary": "seed: 0b" + "1" * 100_000,
    "deep": "a: " + "[" * 5_000,
    "large": "a: '" + "x" * (5 * 2**20) + "'",
    "no_utf8": b"a: \xff\xfe\xff",
    "date": "a: 2001-99-99",
    "key": "[1, 2]: 3",
    "merge_of_text": "a: {<<: text}",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_end_with_one_short_line(tmp_path, name):
    content = HOSTILE[name]
    (tmp_path / "a.yaml").write_bytes(content if isinstance(content, bytes) else content.encode())
    for read in (read_yaml, EffectsSpec.load, lambda path: load_edits(path, None)):
        with pytest.raises(InputError) as error:
            from_dict(TrainConfig, read(tmp_path / "a.yaml"))
        assert len(str(error.value)) < 600 + len(str(tmp_path)) and "\n" not in str(error.value)


def test_numbers_as_yaml_writes_them(tmp_path):
    (tmp_path / "a.yaml").write_text("phases: [{steps: 5, learning_rate: 2e-4}]\n")
    assert from_dict(TrainConfig, read_yaml(tmp_path / "a.yaml")).phases[0].learning_rate == 2e-4


@pytest.mark.parametrize(
    "content, message", [("a: [", "not valid YAML"), ("- 1", "mapping"), ("!!python/name:os.system", "YAML")]
)
def test_broken_files(tmp_path, content, message):
    (tmp_path / "a.yaml").write_text(content)
    with pytest.raises(InputError, match=message):
        read_yaml(tmp_path / "a.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        read_yaml(tmp_path / "b.yaml")


def test_optional_fixed_length_and_nested_fields():
    @dataclass(frozen=True)
    class Inner:
        pair: tuple[int, float] = (1, 2.0)
        limit: float | None = None

    @dataclass(frozen=True)
    class Outer:
        inner: Inner = dataclasses.field(default_factory=Inner)
        kernels: tuple[tuple[int, ...], ...] = ()

    Outer.__annotations__ = {"inner": Inner, "kernels": tuple[tuple[int, ...], ...]}
    outer = from_dict(Outer, {"inner": {"pair": [3, 4], "limit": 1}, "kernels": [[5, 3], [3]]})
    assert outer == Outer(Inner((3, 4.0), 1.0), ((5, 3), (3,)))
    with pytest.raises(InputError, match=r"inner\.pair: must be a list of 2; got \[1, 2, 3\]"):
        from_dict(Outer, {"inner": {"pair": [1, 2, 3]}})


def test_phases_follow_one_another():
    config = TrainConfig(phases=(PhaseConfig(steps=3), PhaseConfig(steps=2, horizon=4)))
    assert config.n_steps == 5
    assert [(config.phase_of(i)[0].horizon, config.phase_of(i)[1]) for i in range(5)] == [
        (0, 0), (0, 1), (0, 2), (4, 0), (4, 1),
    ]  # fmt: skip


def test_settings_that_earlier_versions_saved_are_renamed():
    phase = {"steps": 3, "horizon": 2, "lead": 0, "lit_before": 0, "dynamics_alone": False, "masked_out": 0.0}
    saved = {"stages": [phase], "in_turn": [], "rounds": 1, "data": {"thawed": 0.5}}
    saved["loss"] = {"bodies": 0.0, "shape": 0.0, "shape_length": 0.1}
    config = from_dict(TrainConfig, upgraded(TrainConfig, saved))
    expected = TrainConfig(phases=(PhaseConfig(steps=3, horizon=2),), data=DataConfig(unfrozen_background=0.5))
    assert config == expected == from_dict(TrainConfig, upgraded(TrainConfig, to_dict(config)))
    with pytest.raises(InputError, match="dynamics_alone: unknown setting.*no longer has it"):
        from_dict(TrainConfig, upgraded(TrainConfig, {"stages": [{**phase, "dynamics_alone": True}]}))


def test_documented_training_equals_published_one():
    text = (Path(__file__).parents[2] / "docs" / "compat" / "migration.md").read_text()
    config = from_dict(TrainConfig, yaml.safe_load(re.search(r"```yaml\n(.*?)```", text, re.DOTALL)[1]))
    model, paper = model_config(config), presets.paper_latent(4)
    assert model.encoder == paper.encoder and model.renderer == paper.renderer
    assert model.dynamics == dataclasses.replace(paper.dynamics, checkpointing=True)
    assert config.data.fitting == Fitting((128, 128), (1.5, 8.0), False)
    assert (config.loss.balance, config.loss.discount, config.loss.perceptual) == (0.5, 0.87, 0.05)
    optimizer = config.optimizer
    assert (optimizer.beta1, optimizer.beta2, optimizer.eps) == (0.9, 0.999, 1e-8)
    assert (optimizer.weight_decay, optimizer.clip_norm, optimizer.ema_decay) == (1e-3, 0.5, 0)
    (phase,) = config.phases
    assert (phase.horizon, phase.target_views, phase.learning_rate, phase.warm_up) == (12, 5, 2e-4, 0.01)

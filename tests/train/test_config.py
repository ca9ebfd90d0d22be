"""Configurations: typed, and nothing unknown is accepted."""

import dataclasses
from dataclasses import dataclass

import pytest

from gsim3d.errors import InputError
from gsim3d.train.config import StageConfig, TrainConfig
from gsim3d.train.settings import from_dict, load_yaml, to_dict


def test_round_trip():
    config = TrainConfig(stages=(StageConfig(steps=3, horizon=2, learning_rate=1e-3),), seed=4, model={"a": [1]})
    assert from_dict(TrainConfig, to_dict(config)) == config


def test_what_is_left_out_comes_from_the_base():
    base = TrainConfig(seed=4)
    changed = from_dict(TrainConfig, {"optimizer": {"clip_norm": 2}}, base=base)
    assert changed.seed == 4 and changed.optimizer.clip_norm == 2.0
    assert changed.optimizer.weight_decay == base.optimizer.weight_decay


@pytest.mark.parametrize(
    "content, message",
    [
        ({"sed": 1}, r"^sed: unknown setting; known here: stages, preset"),
        ({"optimizer": {"lr": 1}}, r"^optimizer\.lr: unknown setting"),
        ({"stages": [{"steps": 5}, {"step": 5}]}, r"^stages\[1\]\.step: unknown setting"),
        ({"stages": [{"horizon": 5}]}, r"^stages\[0\]\.steps: this setting is missing"),
        ({"seed": 1.5}, r"^seed: must be a whole number; got 1.5"),
        ({"seed": True}, r"^seed: must be a whole number"),
        ({"seed": -1}, r"seed must be at least 0"),
        ({"optimizer": {"beta1": "x"}}, r"^optimizer\.beta1: must be a number"),
        ({"optimizer": {"beta1": 1.0}}, r"beta1 must be below 1"),
        ({"optimizer": 3}, r"^optimizer: must be a mapping"),
        ({"stages": 3}, r"^stages: must be a list"),
        ({"stages": []}, r"stages: at least one"),
        ({"stages": [{"steps": 0}]}, r"stages\[0\]: steps must be at least 1"),
        ({"data": {"context_cameras": [1], "target_only_cameras": [1]}}, r"share a camera"),
    ],
)
def test_mistakes_are_named(content, message):
    with pytest.raises(InputError, match=message):
        from_dict(TrainConfig, content)


def test_numbers_as_yaml_writes_them(tmp_path):
    (tmp_path / "a.yaml").write_text("stages: [{steps: 5, learning_rate: 2e-4}]\n")
    assert from_dict(TrainConfig, load_yaml(tmp_path / "a.yaml")).stages[0].learning_rate == 2e-4


@pytest.mark.parametrize(
    "content, message", [("a: [", "not valid YAML"), ("- 1", "mapping"), ("!!python/name:os.system", "YAML")]
)
def test_broken_files(tmp_path, content, message):
    (tmp_path / "a.yaml").write_text(content)
    with pytest.raises(InputError, match=message):
        load_yaml(tmp_path / "a.yaml")
    with pytest.raises(InputError, match="cannot read"):
        load_yaml(tmp_path / "b.yaml")


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
    with pytest.raises(InputError, match=r"inner\.pair: must hold 2 values; got 3"):
        from_dict(Outer, {"inner": {"pair": [1, 2, 3]}})


def test_stages_follow_one_another():
    config = TrainConfig(stages=(StageConfig(steps=3), StageConfig(steps=2, horizon=4)))
    assert config.n_steps == 5
    assert [(config.stage_of(i)[0].horizon, config.stage_of(i)[1]) for i in range(5)] == [
        (0, 0), (0, 1), (0, 2), (4, 0), (4, 1),
    ]  # fmt: skip

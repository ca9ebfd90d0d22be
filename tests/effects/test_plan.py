"""What a scene calls for: typed, serialisable, and honest about what cannot be done."""

import dataclasses
import re
from pathlib import Path

import pytest

from gsim3d import presets
from gsim3d.effects.edits import OPERATIONS, load_edits
from gsim3d.effects.plan import make_plan
from gsim3d.effects.spec import AppearanceEffects, DynamicsEffects, EffectsSpec, OutputEffects, Sleep, UnsupportedEffect
from gsim3d.errors import InputError
from gsim3d.priors import InertiaConfig, PositionWavesConfig

MODEL = presets.paper_latent(4)  # holds opacities
SOME = EffectsSpec(
    DynamicsEffects(background="masked_out", history=2),
    AppearanceEffects(view_dependent=1, changing="dynamic"),
    outputs=OutputEffects(depth=True),
)


def test_spec_default_is_off():
    spec = EffectsSpec()
    assert spec.to_dict() == {"version": 1} and EffectsSpec.from_dict(None) == spec == EffectsSpec.from_dict({})
    plan = make_plan(spec, MODEL)
    assert (plan.history, plan.sh_degree) == (4, 3)
    assert plan.on == ("history", "background", "view_dependent", "changing", "rgb")


def test_plan_lists_switches_with_settings_and_outputs():
    plan = make_plan(SOME, MODEL)
    assert (plan.history, plan.sh_degree) == (2, 1)
    assert plan.switches == (("history", "2 steps"), ("view_dependent", "degree 1"), ("changing", "dynamic"))
    assert plan.outputs == ("rgb", "depth")


def test_plan_lists_priors_in_order():
    priors = (PositionWavesConfig(), InertiaConfig())
    model = dataclasses.replace(MODEL, dynamics=dataclasses.replace(MODEL.dynamics, priors=priors))
    plan = make_plan(EffectsSpec(), model)
    assert plan.priors == ("position_waves", "inertia") and plan.on[:3] == (*plan.priors, "history")
    assert make_plan(EffectsSpec(), MODEL).priors == ()


def test_old_files_with_removed_keys_load_while_they_are_off():
    off = {"actions": {"type": "keypoints3d", "names": []}, "contact": {"pairs": [], "halo": 0.05}}
    assert EffectsSpec.from_dict({"dynamics": off}) == EffectsSpec()
    old = EffectsSpec.from_dict({"dynamics": {"actions": {"type": "keypoints3d", "names": ["hand"]}}})
    assert old == EffectsSpec.from_dict({"dynamics": {"actions": ["hand"]}}) and old.dynamics.actions == ("hand",)
    assert EffectsSpec.from_dict({"dynamics": {"actions": None, "history": 2}}).dynamics.history == 2


def test_old_key_of_frozen_appearance_is_converted():
    old, new = (EffectsSpec.from_dict({"appearance": {name: ["moving"]}}) for name in ("held", "frozen_appearance"))
    assert old == new and old.appearance.frozen_appearance[0].which == "moving"
    with pytest.raises(InputError, match="appearance.held is the old name of frozen_appearance"):
        EffectsSpec.from_dict({"appearance": {"held": [], "frozen_appearance": []}})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"dynamics": {"actions": ["hand"]}}, "unsupported effect dynamics.actions: .* the type .*hand.*; it has none"),
        ({"dynamics": {"contact": {"pairs": [["a", "b"]]}}}, "unsupported effect dynamics.contact"),
        ({"dynamics": {"sleep": {"policy": "approx"}}}, "unsupported effect dynamics.sleep.policy approx"),
        ({"dynamics": {"background": "asymmetric"}}, "unsupported effect dynamics.background asymmetric"),
        ({"outputs": {"rgb": False}}, "unsupported effect outputs: no output is on"),
        ({"dynamics": {"history": 5}}, "unsupported effect dynamics.history: this model supports at most 4; got 5"),
        ({"appearance": {"opacity_changes": True}}, "unsupported effect appearance.opacity_changes"),
    ],
)
def test_plan_refuses_unsupported_effects(values, message):
    with pytest.raises(UnsupportedEffect, match=message):
        make_plan(EffectsSpec.from_dict(values), MODEL)


def test_plan_refuses_degree_beyond_model():
    with pytest.raises(UnsupportedEffect, match="view_dependent: this model supports at most 0; got 2"):
        make_plan(EffectsSpec(appearance=AppearanceEffects(view_dependent=2)), presets.tiny())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"dynamic": {}}, "dynamic: unknown setting; known here: dynamics, appearance"),
        ({"dynamics": {"backgroud": "frozen"}}, "dynamics.backgroud: unknown setting"),
        ({"dynamics": 3}, "dynamics: must be a mapping of settings; got 3"),
        ({"dynamics": {"background": "gone"}}, "dynamics.background must be one of frozen, masked_out, dynamic"),
        ({"dynamics": {"history": 0}}, "dynamics.history must be an integer of at least 1; got 0"),
        ({"dynamics": {"history": "2"}}, "dynamics.history: must be a whole number; got '2'"),
        ({"appearance": {"view_dependent": 4}}, "view_dependent must be 0 to 3; got 4"),
        ({"appearance": {"changing": "bunny"}}, "appearance.changing must be one of"),
        ({"dynamics": {"sleep": {"policy": "soundly"}}}, "dynamics.sleep.policy must be one of exact, approx"),
        ({"dynamics": {"sleep": {"patience": 0}}}, "dynamics.sleep.patience must be an integer of at least 1; got 0"),
        ({"dynamics": {"sleep": {"eps": "small"}}}, "dynamics.sleep.eps: must be a number; got 'small'"),
        ({"dynamics": {"actions": 3}}, "dynamics.actions: must be a list"),
        ({"outputs": {"depth": "yes"}}, "outputs.depth: must be true or false; got 'yes'"),
        ({"version": 2}, "version must be 1; got 2"),
    ],
)
def test_spec_refuses_malformed_values(values, message):
    with pytest.raises(InputError, match=message):
        EffectsSpec.from_dict(values)


def test_documentation_lists_every_key(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "reference" / "effects.md").read_text()
    spec, edits = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    for name, text in (("spec.yaml", spec), ("edits.yaml", edits)):
        (tmp_path / name).write_text(text)
    read = EffectsSpec.load(tmp_path / "spec.yaml")
    assert read.structure.insert and read.dynamics.sleep == Sleep()
    operations = {edit.operation.name for edit in load_edits(tmp_path / "edits.yaml", lambda folder: None)}
    assert operations <= set(OPERATIONS) and all(f"`{name}`" in page for name in OPERATIONS)
    for group in dataclasses.fields(read):
        for field in dataclasses.fields(getattr(read, group.name)):
            assert re.search(rf"\b{field.name}\b", page), f"{group.name}.{field.name}"


def test_spec_refuses_other_files(tmp_path):
    (tmp_path / "bad.yaml").write_text("- 1\n- 2\n")
    with pytest.raises(InputError, match="must hold a mapping"):
        EffectsSpec.load(tmp_path / "bad.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        EffectsSpec.load(tmp_path / "absent.yaml")

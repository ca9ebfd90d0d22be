"""Conversion of the published model's YAML configuration.

Sizes are taken from the shapes of the weights where possible; the rest (strides, heads, grid size, limits, history)
comes from the file.
"""

import math
import re
from dataclasses import dataclass
from typing import Any

from gsim3d.compat.released import DYNAMICS, ENCODER, HEAD, LATENTS
from gsim3d.compat.released_model import ReleasedDynamicsConfig, ReleasedModelConfig
from gsim3d.effects.spec import DynamicsEffects, EffectsSpec
from gsim3d.errors import InputError, naming
from gsim3d.io.files import shown
from gsim3d.nn.gaussian_head import RendererConfig
from gsim3d.nn.multiview_encoder import EncoderConfig

Shapes = dict[str, tuple[int, ...]]

CURVES = ["z", "z-trans", "hilbert", "hilbert-trans"]
EXPLICIT = {"means", "opacities", "rotations", "scales", "harmonics"}
MAX_SH_DEGREE = 3
HISTORIES = (1, 2, 4, 8)
PREDICTS = {"cx_x": "from_newest", "cx_dx": "from_previous", "z_x": "absolute"}
# Settings with a single supported value: section -> key -> value.
FIXED = {
    "model.encoder": {
        "name": "costvolume", "num_surfaces": 1, "gaussians_per_pixel": 1, "use_epipolar_trans": False,
        "wo_depth_refine": False, "wo_cost_volume": False, "wo_backbone_cross_attn": False,
        "wo_cost_volume_refine": False,
    },
    "model.encoder.opacity_mapping": {"initial": 0, "final": 0},
    "model.dynamic_model": {"name": "ptv3", "no_xyz": True},
    "model.dynamic_model.model": {
        "order": CURVES, "cls_mode": False, "temporal_merger": True, "grid_mode": False, "qkv_bias": True,
        "qk_scale": None, "pre_norm": True, "enable_rpe": False, "enable_flash": True, "pdnorm_bn": False,
        "pdnorm_ln": False,
    },
    "model.state_adapter": {"fps_to_num_points": -1, "learn_static_mask": False, "learn_background_mask": False},
    "model.state_adapter.gaussians": {"rotations": 4},
}  # fmt: skip
NO_MEANING = object()
OF_ANOTHER = "this configuration belongs to another checkpoint"


@dataclass(frozen=True)
class ReleasedConfig:
    """Converted configuration of a published checkpoint."""

    model: ReleasedModelConfig  #: model configuration
    data: dict[str, Any]  #: data section of a checkpoint's config.yaml
    effects: EffectsSpec  #: effects that the model was trained to simulate
    notes: tuple[str, ...]  #: remarks for the user
    ignored: tuple[str, ...]  #: keys of the file without effect in gsim3d


class _Settings:
    """A nested mapping with validating accessors, which records the keys that were read."""

    def __init__(self, content: dict):
        self.content, self.read = content, set()

    def get(self, path: str, default: Any = NO_MEANING) -> Any:
        """Returns the value at a dotted path; raises InputError if it is missing and there is no default."""
        value = self.content
        self.read.add(path)
        for key in path.split("."):
            if not isinstance(value, dict) or key not in value:
                if default is NO_MEANING:
                    advice = (
                        "the resolved configuration that is saved with a checkpoint, not the overrides of an experiment"
                    )
                    raise InputError(f"{path}: is missing; use {advice}")
                return default
            value = value[key]
        return value

    def _checked(self, value: Any, good: bool, path: str, what: str) -> Any:
        if not good:
            raise InputError(f"{path}: must be {what}; got {shown(value)}")
        return value

    def number(self, path: str, default: Any = NO_MEANING) -> float:
        value = self.get(path, default)
        if isinstance(value, str) and re.fullmatch(r"-?\d+[eE][-+]?\d+", value):  # YAML 1.1 reads 4e-3 as text
            value = float(value)
        good = type(value) in (int, float) and math.isfinite(value)
        return float(self._checked(value, good, path, "a number"))

    def positive(self, path: str) -> float:
        value = self.number(path)
        return self._checked(value, value > 0, path, "above 0")

    def whole(self, path: str, default: Any = NO_MEANING) -> int:
        value = self.get(path, default)
        return self._checked(value, type(value) is int, path, "an integer")

    def flag(self, path: str, default: Any = NO_MEANING) -> bool:
        value = self.get(path, default)
        return self._checked(value, isinstance(value, bool), path, "true or false")

    def wholes(self, path: str, count: int | None = None) -> tuple[int, ...]:
        value = self.get(path)
        good = isinstance(value, list) and all(type(n) is int and 0 < n < 2**20 for n in value)
        good = good and count in (None, len(value))
        return tuple(self._checked(value, good, path, f"a list of {count or 'any number of'} integers"))

    def names(self, path: str) -> set[str]:
        value = self.get(path)
        good = isinstance(value, list) and all(isinstance(name, str) for name in value)
        return set(self._checked(value, good, path, "a list of names"))

    def unread(self) -> list[str]:
        """Returns the dotted paths of values, or of whole mappings, that were not read."""
        return sorted(self._unread(self.content, ""))

    def _unread(self, value: Any, path: str) -> list[str]:
        if path in self.read:
            return []
        inside = f"{path}." if path else ""
        if isinstance(value, dict) and any(name.startswith(inside) for name in self.read):
            quoted = {key: f'"{key}"' if "." in str(key) else key for key in value}
            return [name for key, item in value.items() for name in self._unread(item, f"{inside}{quoted[key]}")]
        return [path]


class _Sizes:
    """Sizes taken from the shapes of weights; records a note if the settings differ."""

    def __init__(self, shapes: Shapes, settings: _Settings):
        self.shapes, self.settings, self.notes = shapes, settings, []

    def of(self, name: str, axis: int = 0) -> int:
        """Returns the size of a published tensor along an axis; 0 if it does not exist."""
        shape = self.shapes.get(name, ())
        return shape[axis] if len(shape) > axis else 0

    def needed(self, name: str, axis: int = 0) -> int:
        if size := self.of(name, axis):
            return size
        raise InputError(f"weights: {name} is missing or has no axis {axis}; this is not a published 3DGSim model")

    def agreed(self, path: str, found: Any, default: Any = NO_MEANING) -> Any:
        """Returns ``found``; records a note if the settings have another value at ``path``."""
        given = self.settings.get(path, default)
        if given is not NO_MEANING and given is not None and given != found:
            self.notes.append(f"{path} is {shown(given)}, but the weights have {shown(found)}, which is used")
        return found

    def count(self, pattern: str) -> int:
        """Returns the number of distinct indices that names have at the group of ``pattern``."""
        return len({match[1] for name in self.shapes if (match := re.match(pattern, name))})


def read_config(content: dict, shapes: Shapes) -> ReleasedConfig:
    """Converts the settings of a published run, the content of its YAML file; ``shapes``: published name -> shape of
    the weights. Raises InputError, which names it, if a setting is missing, of the wrong type or not supported."""
    settings = _Settings(content)
    sizes = _Sizes(shapes, settings)
    for section, values in FIXED.items():
        for key, value in values.items():
            given = settings.get(f"{section}.{key}", value)
            if given != value:
                raise InputError(f"{section}.{key}: {shown(given)} is not supported; only {value!r} is")
    explicit = _is_explicit(settings, sizes)
    n_dynamic, n_static = (
        sizes.agreed(f"model.state_adapter.{kind}_latent_feature_dim", sizes.of(f"{ENCODER}{prefix}weight"), 0)
        for kind, prefix in zip(("dynamic", "static"), LATENTS, strict=True)
    )
    sh_degree = _sh_degree(sizes, explicit)
    updates = _updates(settings, sizes, explicit, n_dynamic, sh_degree)
    common = {"explicit": explicit, "sh_degree": sh_degree}
    history = settings.whole("dataset.n_step_state")
    if history not in HISTORIES:
        raise InputError(f"dataset.n_step_state: must be {', '.join(map(str, HISTORIES))}; got {history}")
    scales = {f"scale_{end}": settings.positive(f"model.state_adapter.gaussians.scale_{end}") for end in ("min", "max")}
    with naming("settings and weights do not describe a valid model", ValueError):
        encoder = EncoderConfig(**_encoder(settings, sizes), dynamic_dim=n_dynamic, static_dim=n_static, **common)
        latents = {"dynamic_latents": n_dynamic, "static_latents": n_static, "history_bits": history.bit_length() - 1}
        dynamics = ReleasedDynamicsConfig(**_dynamics(settings, sizes), **updates, **latents, **scales, **common)
        read = 0 if explicit else n_dynamic + n_static
        renderer = RendererConfig(latents=read, sh_degree=sh_degree, jacobian="clamped", **scales)
        model = ReleasedModelConfig(encoder, dynamics, renderer)
    data, effects, notes = _data(settings, history, encoder.size_multiple)
    return ReleasedConfig(model, data, effects, (*sizes.notes, *notes), tuple(settings.unread()))


def _is_explicit(settings: _Settings, sizes: _Sizes) -> bool:
    """Returns whether particles carry all Gaussian parameters."""
    params = settings.names("model.state_adapter.state_3dgs_params")
    explicit = sizes.needed(f"{ENCODER}depth_predictor.to_gaussians.2.weight") > 2
    if params not in ({"means", "opacities"}, EXPLICIT):
        wanted, got = "means and opacities, or all five parameters", ", ".join(sorted(params))
        raise InputError(f"model.state_adapter.state_3dgs_params: must be {wanted}; got {got}")
    if explicit != (params == EXPLICIT):
        given, found = ("latent", "explicit") if explicit else ("explicit", "latent")
        said = f"describes the {given} variant, but the weights are of the {found} one"
        raise InputError(f"model.state_adapter.state_3dgs_params {said}: {OF_ANOTHER}")
    return explicit


def _sh_degree(sizes: _Sizes, explicit: bool) -> int:
    layer, others = (f"{ENCODER}depth_predictor.to_gaussians.2", 9) if explicit else (f"{HEAD}to_missing_3dgs.2", 7)
    n_harmonics = (sizes.needed(f"{layer}.weight") - others) / 3
    degree = next((d for d in range(MAX_SH_DEGREE + 1) if (d + 1) ** 2 == n_harmonics), None)
    if degree is None:
        raise InputError(f"weights: colours have {n_harmonics:g} coefficients; supported are 1, 4, 9 and 16")
    return sizes.agreed("model.state_adapter.gaussians.sh_degree", degree)


def _updates(settings: _Settings, sizes: _Sizes, explicit: bool, n_dynamic: int, sh_degree: int) -> dict[str, Any]:
    """Converts the settings of state updates; raises InputError for unsupported ones."""
    adapter = "model.state_adapter"
    changing = {"means"} | (settings.names(f"{adapter}.dynamic_state_keys") & EXPLICIT)
    if explicit and changing != EXPLICIT:
        missing = ", ".join(sorted(EXPLICIT - changing))
        wanted = "must contain all attributes of explicit particles"
        raise InputError(f"{adapter}.dynamic_state_keys: {wanted}; {missing} is missing")
    if not explicit and "opacities" in changing:
        raise InputError(f"{adapter}.dynamic_state_keys: changing opacities are not supported in the latent variant")
    changing = (EXPLICIT if explicit else {"means"}) | ({"dynamic_latent_features"} if n_dynamic else set())
    given = settings.get(f"{adapter}.pred_modality", {})
    modes = {key: given.get(key, "z_x") if isinstance(given, dict) else given for key in sorted(changing)}
    if any(mode != modes["means"] for mode in modes.values()) or str(modes["means"]) not in PREDICTS:
        known = ", ".join(PREDICTS)
        raise InputError(f"{adapter}.pred_modality: must be one of {known}, equal for all attributes; got {modes}")
    immune = settings.names(f"{adapter}.immune_to_static") if explicit else {"harmonics"}
    if immune & EXPLICIT != {"harmonics"}:
        got = ", ".join(sorted(immune)) or "nothing"
        raise InputError(f"{adapter}.immune_to_static: must be [harmonics]; got {got}")
    history = settings.whole("dataset.n_step_state")
    advanced = settings.whole("dataset.n_step_state_predict", 1)
    advanced = history if advanced < 0 else min(advanced, history)
    if advanced != 1:
        raise InputError(f"dataset.n_step_state_predict: {advanced} is not supported; only 1 is")
    predicts = PREDICTS[modes["means"]]
    turn = 4 if predicts == "absolute" else 3
    width = n_dynamic + 3 + (3 * (sh_degree + 1) ** 2 + 1 + turn + 3 if explicit else 0)
    rows = sizes.needed(f"{DYNAMICS}dec.{_n_stages(sizes) - 1}.fc2.weight")
    if rows % width:
        said = f"the dynamics predicts {rows} values per particle, but a step of this variant needs {width}"
        raise InputError(f"weights: {said}: {OF_ANOTHER}")
    steps_per_call = sizes.agreed("dataset.n_step_predict_multiple", rows // width, 1)
    metric = settings.positive(f"{adapter}.metric")
    max_step = metric / 2 if settings.flag(f"{adapter}.pred_inductive_bias") else None
    return {"predicts": predicts, "steps_per_call": steps_per_call, "max_step": max_step}


def _encoder(settings: _Settings, sizes: _Sizes) -> dict[str, Any]:
    encoder, depth, cnn = "model.encoder", f"{ENCODER}depth_predictor.", f"{ENCODER}backbone.backbone."
    layers, gaussians = f"{ENCODER}backbone.transformer.layers", "model.state_adapter.gaussians"
    feature_dim = sizes.agreed(f"{encoder}.d_feature", sizes.needed(f"{cnn}conv2.weight"))
    for unet in ("costvolume", "depth"):
        mult = settings.wholes(f"{encoder}.{unet}_unet_channel_mult")
        if set(mult) != {1}:
            raise InputError(f"{encoder}.{unet}_unet_channel_mult: must be ones; got {list(mult)}")
    condition_dim = sizes.of(f"{depth}global_cond.0.weight")
    return {
        "feature_dim": feature_dim,
        "downscale_factor": settings.whole(f"{encoder}.downscale_factor", 4),
        "cnn_dims": tuple(
            sizes.needed(f"{cnn}{name}.weight") for name in ("conv1", "layer2.0.conv1", "layer3.0.conv1")
        ),
        "cnn_blocks": sizes.count(rf"{re.escape(cnn)}layer1\.(\d+)\."),
        "transformer_layers": sizes.count(rf"{re.escape(layers)}\.(\d+)\."),
        "transformer_mlp_ratio": sizes.needed(f"{layers}.0.cross_attn_ffn.mlp.0.weight") // (2 * feature_dim),
        "window_split": settings.whole(f"{encoder}.multiview_trans_attn_split", 2),
        "n_depths": sizes.agreed(f"{encoder}.num_depth_candidates", sizes.needed(f"{depth}regressor_residual.weight")),
        "cost_unet_dim": sizes.agreed(
            f"{encoder}.costvolume_unet_feat_dim", sizes.needed(f"{depth}corr_refine_net.0.weight")
        ),
        "cost_unet_levels": len(settings.wholes(f"{encoder}.costvolume_unet_channel_mult")),
        "cost_unet_attention": settings.wholes(f"{encoder}.costvolume_unet_attn_res"),
        "refine_unet_dim": sizes.agreed(
            f"{encoder}.depth_unet_feat_dim", sizes.needed(f"{depth}proj_feature.weight")
        ),
        "refine_unet_levels": len(settings.wholes(f"{encoder}.depth_unet_channel_mult")),
        "refine_unet_attention": settings.wholes(f"{encoder}.depth_unet_attn_res"),
        "disparity_dim": sizes.needed(f"{depth}to_disparity.0.weight"),
        **({"condition_dim": condition_dim} if condition_dim else {}),
        "scale_range": tuple(settings.positive(f"{gaussians}.cam_scale_{end}") for end in ("min", "max")),
    }  # fmt: skip


def _n_stages(sizes: _Sizes) -> int:
    return sizes.count(rf"{re.escape(DYNAMICS)}enc\.enc(\d+)\.")


def _dynamics(settings: _Settings, sizes: _Sizes) -> dict[str, Any]:
    net = "model.dynamic_model.model"
    n = _n_stages(sizes)
    depths, channels = {}, {}
    for side, n_here in (("enc", n), ("dec", n - 1)):
        stages = [f"{DYNAMICS}{side}.{side}{s}.block" for s in range(n_here)]
        found = [sizes.count(rf"{re.escape(stage)}(\d+)\.") for stage in stages]
        depths[side] = tuple(sizes.agreed(f"{net}.{side}_depths", found))
        found = [sizes.of(f"{stage}0.norm1.0.weight") for stage in stages]
        channels[side] = tuple(sizes.agreed(f"{net}.{side}_channels", found))
    time_embedding = settings.flag(f"{net}.with_time_emb", True)
    windows = settings.wholes(f"{net}.merge_window_size", n - 1)
    if time_embedding:
        found = [sizes.of(f"{DYNAMICS}enc.enc{s}.merger.pos_emb") or 1 for s in range(1, n)]
        windows = tuple(sizes.agreed(f"{net}.merge_window_size", found))
    strides = settings.wholes(f"{net}.stride", n - 1)
    for name, values in (("stride", strides), ("merge_window_size", windows)):
        if any(value & (value - 1) for value in values):
            raise InputError(f"{net}.{name}: must be powers of two; got {list(values)}")
    patches = settings.wholes(f"{net}.enc_patch_size", n)
    if settings.wholes(f"{net}.dec_patch_size", n - 1) != patches[:-1]:
        raise InputError(f"{net}.dec_patch_size: must equal enc_patch_size at the same stages")
    first = f"{DYNAMICS}enc.enc0.block0.mlp.0.fc1.weight"
    sides = {}
    for name, side, n_here in (("encoder", "enc", n), ("decoder", "dec", n - 1)):
        heads = settings.wholes(f"{net}.{side}_num_head", n_here)
        sides |= {f"{name}_depths": depths[side], f"{name}_channels": channels[side], f"{name}_heads": heads}
    return {
        **{"strides": strides, "merge_windows": windows, "patch_sizes": patches, "time_embedding": time_embedding},
        **sides,
        "grid_size": settings.positive(f"{net}.grid_size"),
        "mlp_ratio": sizes.agreed(f"{net}.mlp_ratio", sizes.needed(first) // sizes.needed(first, 1)),
        "drop_path": settings.number(f"{net}.drop_path", 0.3),
        "shuffle_orders": settings.flag(f"{net}.shuffle_orders", True),
        "checkpointing": settings.flag("train.gradient_checkpointing", False),
    }


def _data(settings: _Settings, history: int, size_multiple: int) -> tuple[dict[str, Any], EffectsSpec, list[str]]:
    """Returns the data section of config.yaml, the effects, and notes on differences."""
    height, width = settings.wholes("dataset.image_shape", 2)
    near, far = settings.positive("dataset.near"), settings.positive("dataset.far")
    if far <= near:
        raise InputError(f"dataset.far: must lie beyond near; got near {near} and far {far}")
    if settings.flag("dataset.baseline_scale_bounds", False):
        raise InputError("dataset.baseline_scale_bounds: depth bounds that depend on the scene are not supported")
    if width % size_multiple or height % size_multiple:
        raise InputError(f"dataset.image_shape: must be multiples of {size_multiple}; got {height}, {width}")
    views, notes = _views(settings)
    data = {"history": history, **views, "image_size": [width, height], "resize": [width, height]}
    data |= {"near_far": [near, far], "unit_cameras": settings.flag("dataset.make_baseline_1", False)}
    with_seg = settings.flag("dataset.with_seg", False)
    effects = EffectsSpec(dynamics=DynamicsEffects(background="frozen" if with_seg else "dynamic"))
    if not with_seg:
        notes.append("dataset.with_seg is false: trained without segmentation, so all particles are movable")
    if not settings.flag("dataset.with_mask", False):
        notes.append("dataset.with_mask is false: trained on all pixels; gsim3d skips pixels with label 0")
    if settings.get("dataset.workspace_limits", None) is not None:
        notes.append("dataset.workspace_limits is set: the published dynamics excludes particles outside, gsim3d not")
    if settings.get("dataset.background_color", [0, 0, 0]) not in (None, 0, [0, 0, 0]):
        notes.append("dataset.background_color is not black: pass it as background to render")
    if (speedup := settings.get("dataset.speedup", 1)) != 1:
        notes.append(f"dataset.speedup is {speedup}: trained on every frame number {speedup} only")
    return data, effects, notes


def _views(settings: _Settings) -> tuple[dict[str, Any], list[str]]:
    """Converts the input and target cameras."""
    sampler, notes = "dataset.view_sampler", []
    fixed, drawn = (settings.get(f"{sampler}.{name}", None) or [] for name in ("test_context_views", "context_views"))
    inputs = fixed or drawn
    if inputs and isinstance(inputs, list) and all(isinstance(group, list) for group in inputs):
        notes.append(f"{sampler} has a group of context views per step; gsim3d uses the first group at all steps")
        inputs = inputs[0]
    targets = settings.get(f"{sampler}.test_target_views", None)
    targets = targets if isinstance(targets, list) else []
    for name, cams in (("test_context_views or context_views", inputs), ("test_target_views", targets)):
        if not isinstance(cams, list) or not all(type(cam) is int and cam >= 0 for cam in cams):
            raise InputError(f"{sampler}.{name}: must be a list of camera numbers; got {shown(cams)}")
    count = settings.whole(f"{sampler}.num_context_views")
    if inputs:  # all test views, or the requested number of the views to draw from
        count = len(inputs) if fixed else min(count, len(inputs))
    target_only = [cam for cam in targets if cam not in inputs]
    return {"context_views": count, "context_cameras": inputs, "target_only_cameras": target_only}, notes

"""gsplat's call: against plain torch, against what gsplat 1.5.3 computes in torch, and with its strategy."""

import importlib.util
import inspect
import math

import pytest
import torch

from gsim3d.compat.gsplat import rasterization
from gsim3d.errors import InputError, NumericalError
from gsim3d.ops import rasterize_gaussians
from tests.asserts import assert_close_relative_to_max, assert_same_bits
from tests.compat.gsplat_scene import SIZE, expected_batches, expected_images, harmonic_colors, scene_of
from tests.ops.raster_scene import random_scene
from tests.oracle import projection as projection_oracle

with_gsplat = pytest.mark.skipif(
    importlib.util.find_spec("gsplat") is None, reason="pip install --no-deps gsplat==1.5.3 rich jaxtyping"
)

DEFAULTS = {  # of gsplat 1.6.0, in their order; its rolling_shutter is GLOBAL
    "near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "eps2d": 0.3, "sh_degree": None, "packed": True,
    "tile_size": None, "backgrounds": None, "render_mode": "RGB", "sparse_grad": False, "absgrad": False,
    "rasterize_mode": "classic", "channel_chunk": 32, "distributed": False, "camera_model": "pinhole",
    "segmented": False, "covars": None, "with_ut": False, "with_eval3d": False, "return_normals": False,
    "global_z_order": True, "rays": None, "radial_coeffs": None, "tangential_coeffs": None, "thin_prism_coeffs": None,
    "ftheta_coeffs": None, "lidar_coeffs": None, "external_distortion_coeffs": None, "rolling_shutter": None,
    "viewmats_rs": None, "ut_params": None, "extra_signals": None, "extra_signals_sh_degree": None,
    "renderer_config": None,
}  # fmt: skip


def test_the_signature_is_that_of_gsplat():
    needed = ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "width", "height"]
    parameters = inspect.signature(rasterization).parameters
    assert list(parameters) == [*needed, *DEFAULTS]
    assert {name: parameters[name].default for name in DEFAULTS} == DEFAULTS
    assert all(parameters[name].default is inspect.Parameter.empty for name in needed)


# ---- images and gradients against plain torch -----------------------------------------------------------------------


@pytest.mark.parametrize("render_mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
@pytest.mark.parametrize("per_view", [False, True])
@pytest.mark.parametrize("packed", [False, True])
def test_render_modes(device, render_mode, per_view, packed):
    arguments = scene_of()
    if per_view:
        arguments["colors"] = torch.rand(2, 40, 3, dtype=torch.float64)
    leaves = {name: x.clone().requires_grad_() for name, x in arguments.items()}
    backgrounds = torch.rand(2, 3, dtype=torch.float64)
    expected = expected_images(leaves, render_mode=render_mode, backgrounds=backgrounds)
    moved = {name: x.detach().to(device).requires_grad_() for name, x in arguments.items()}
    *actual, _ = rasterization(
        **moved, **SIZE, render_mode=render_mode, backgrounds=backgrounds.to(device), packed=packed
    )
    names = [name for name in leaves if name != "Ks" and (name != "colors" or "RGB" in render_mode)]
    assert_images_and_gradients(actual, expected, *([inputs[name] for name in names] for inputs in (moved, leaves)))


def assert_images_and_gradients(actual, expected, inputs, leaves):
    """``actual`` is of ``inputs`` and ``expected`` of ``leaves``."""
    for a, e in zip(actual, expected, strict=True):
        assert_close_relative_to_max(a, e, "raster_float64")
    mixes, both = [torch.randn_like(e) for e in expected], []
    for images, of in ((actual, inputs), (expected, leaves)):
        loss = sum((m.to(x) * x).sum() for m, x in zip(mixes, images, strict=True))
        both.append(torch.autograd.grad(loss, of))
    for place, (a, e) in enumerate(zip(*both, strict=True)):
        assert_close_relative_to_max(a, e, "projection_grad_float64", f"gradient {place}")


CASES = [(mode, of) for mode in ("RGB", "RGB+D") for of in ("Gaussians", "views", "harmonics")]


@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(("render_mode", "colors_of"), [*CASES, ("D", None)])
def test_the_cases_that_gsplat_tests(device, render_mode, colors_of, packed, batch):
    arguments, g = scene_of(batch, cameras=3, n=15), torch.Generator().manual_seed(1)
    sizes = {"Gaussians": (15, 3), "views": (3, 15, 3), "harmonics": (15, 16, 3)}
    if colors_of is None:
        del arguments["colors"]
    else:
        arguments["colors"] = torch.rand(*batch, *sizes[colors_of], generator=g, dtype=torch.float64)
        arguments["backgrounds"] = torch.rand(*batch, 3, 3, generator=g, dtype=torch.float64)
    leaves = {name: x.clone().requires_grad_() for name, x in arguments.items()}
    reference = dict(leaves)
    if colors_of is None:
        reference["colors"] = torch.zeros(*batch, 15, 3, dtype=torch.float64)
    elif colors_of == "harmonics":
        reference["colors"] = harmonic_colors(leaves["means"], leaves["viewmats"], leaves["colors"], 3)
    expected = expected_batches(reference, batch, render_mode=render_mode)
    moved = {name: x.detach().to(device).requires_grad_() for name, x in arguments.items()}
    options = {"render_mode": render_mode, "packed": packed, "sh_degree": 3 if colors_of == "harmonics" else None}
    *actual, _ = rasterization(**{"colors": None} | moved, **SIZE, **options)
    names = [name for name in leaves if name != "Ks"]
    assert_images_and_gradients(actual, expected, *([inputs[name] for name in names] for inputs in (moved, leaves)))


@pytest.mark.parametrize("channels", [1, 3, 32, 128])
@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
def test_channels_and_batches(device, batch, channels):
    arguments = {name: x.to(device) for name, x in scene_of(batch, channels=channels, n=20).items()}
    color, alpha, meta = rasterization(**arguments, **SIZE, packed=False)
    assert color.shape == (*batch, 2, 37, 45, channels) and alpha.shape == (*batch, 2, 37, 45, 1)
    assert meta["means2d"].shape == (*batch, 2, 20, 2) and meta["radii"].dtype == torch.int32
    assert meta["n_batches"] == max(1, len(batch) and 2) and meta["n_cameras"] == 2
    expected, _ = expected_batches({name: x.cpu() for name, x in arguments.items()}, batch)
    assert_close_relative_to_max(color, expected, "raster_float64")


@pytest.mark.parametrize("eps2d", [0.3, 0.0, 1.0])
@pytest.mark.parametrize("with_covars", [False, True])
@pytest.mark.parametrize("camera_model", ["pinhole", "ortho", "fisheye"])
def test_antialiased_covars_and_cameras(device, camera_model, with_covars, eps2d):
    arguments, lens = scene_of(), {"ortho": "orthographic"}.get(camera_model, camera_model)
    if with_covars:
        arguments["covars"] = projection_oracle.covariances(arguments["quats"], arguments["scales"])
    expected = expected_images(arguments, antialiased=True, eps2d=eps2d, lens=lens)
    options = {"rasterize_mode": "antialiased", "camera_model": camera_model, "eps2d": eps2d}
    moved = {name: x.to(device) for name, x in arguments.items()}
    if with_covars:
        moved |= {"quats": None, "scales": None}
    *actual, meta = rasterization(**moved, **SIZE, **options, packed=False)
    for a, e in zip(actual, expected, strict=True):
        assert_close_relative_to_max(a, e, "raster_float64")
    assert (meta["opacities"].cpu() <= arguments["opacities"] + 1e-12).all()


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(("batch", "cameras", "n"), [((), 2, 0), ((), 0, 5), ((0,), 2, 5), ((2,), 0, 5), ((2,), 1, 0)])
def test_nothing_to_draw(device, batch, cameras, n, packed):
    arguments = {name: x.to(device) for name, x in scene_of((), cameras=2, n=5).items()}
    of_cameras = {name: arguments[name][:cameras].expand(*batch, -1, -1, -1) for name in ("viewmats", "Ks")}
    of_rows = {name: x[:n].expand(*batch, n, *x.shape[1:]) for name, x in arguments.items() if name not in of_cameras}
    backgrounds = torch.rand(*batch, cameras, 3, dtype=torch.float64, device=device)
    sh = torch.rand(*batch, n, 9, 3, dtype=torch.float64, device=device)
    for options in ({}, {"colors": sh, "sh_degree": 2}, {"colors": sh[(0,) * len(batch)] if 0 not in batch else sh}):
        if options.keys() == {"colors"}:
            options["sh_degree"], options["colors"] = 1, options["colors"][..., :4, :]
        call = of_rows | of_cameras | options
        color, alpha, _ = rasterization(**call, **SIZE, backgrounds=backgrounds, packed=packed)
        assert color.shape == (*batch, cameras, 37, 45, 3) and alpha.shape == (*batch, cameras, 37, 45, 1)
        if n == 0:
            assert_same_bits(color, backgrounds[..., None, None, :].expand(color.shape))


@pytest.mark.parametrize("sh_degree", range(5))
@pytest.mark.parametrize("batch", [(), (2,)])
def test_harmonics(device, batch, sh_degree):
    arguments = {name: x.to(device) for name, x in scene_of(batch, n=20).items()}
    shared = 0.3 * torch.randn(20, 25, 3, dtype=torch.float64, device=device)
    arguments["colors"] = shared
    color, *_ = rasterization(**arguments, **SIZE, sh_degree=sh_degree)
    again, *_ = rasterization(**arguments | {"colors": shared.expand(*batch, 20, 25, 3)}, **SIZE, sh_degree=sh_degree)
    assert_close_relative_to_max(again, color, 1e-14)
    of_views = harmonic_colors(arguments["means"], arguments["viewmats"], shared, sh_degree)
    expected, *_ = rasterization(**arguments | {"colors": of_views.to(device)}, **SIZE)
    assert_close_relative_to_max(color, expected, 1e-12)


@pytest.mark.parametrize(
    ("camera_model", "n_radial", "n_tangential"),
    [("pinhole", 6, 2), ("pinhole", 6, 0), ("pinhole", 4, 0), ("pinhole", 0, 2), ("fisheye", 4, 0)],
)
def test_distorted_cameras(device, camera_model, n_radial, n_tangential):
    arguments = scene_of()
    radial = torch.tensor([[0.1, 0.02, 0.01, -0.02, 0.03, 0.01], [0.05, -0.01, 0.0, 0.02, 0.0, 0.0]]).double()
    tangential = torch.tensor([[0.01, -0.01], [-0.02, 0.01]]).double()
    radial[:, n_radial:], tangential[:, n_tangential:] = 0, 0
    leaves = {name: x.clone().requires_grad_() for name, x in arguments.items() if name != "Ks"}
    moved = {name: x.detach().to(device).requires_grad_() for name, x in leaves.items()}
    given = {"radial_coeffs": radial[:, :n_radial], "tangential_coeffs": tangential[:, :n_tangential]}
    given = {name: x.to(device).requires_grad_() for name, x in given.items() if x.shape[1]}
    inputs = [*moved.values(), *given.values()]
    options, Ks = {"camera_model": camera_model, "rasterize_mode": "antialiased"}, arguments["Ks"]
    *actual, _ = rasterization(**moved, Ks=Ks.to(device), **SIZE, **options, **given)
    assert relative(actual[0], rasterization(**moved, Ks=Ks.to(device), **SIZE, **options)[0]) > 1e-2
    lens, parts = camera_model, {"radial_coeffs": radial.requires_grad_(), "tangential_coeffs": tangential}
    in_order = radial[:, :4]
    if camera_model == "pinhole":
        lens, in_order = "opencv", torch.cat([radial[:, :2], tangential.requires_grad_(), radial[:, 2:]], 1)
    expected = expected_images(leaves | {"Ks": Ks}, lens=lens, distortion=in_order, antialiased=True)
    for a, e in zip(actual, expected, strict=True):
        assert_close_relative_to_max(a, e, "raster_float64")
    mixes, both = [torch.randn_like(e) for e in expected], []
    for images, of in ((actual, inputs), (expected, [*leaves.values(), *(parts[name] for name in given)])):
        both.append(torch.autograd.grad(sum((m.to(x) * x).sum() for m, x in zip(mixes, images)), of))
    for place, (a, e) in enumerate(zip(*both, strict=True)):
        e = e[:, : a.shape[1]] if place >= len(moved) else e
        assert_close_relative_to_max(a, e, "projection_grad_float64", f"gradient {place}")


@pytest.mark.parametrize(
    ("camera_model", "name", "size"),
    [("ortho", "radial_coeffs", 6), ("ortho", "tangential_coeffs", 2), ("fisheye", "tangential_coeffs", 2)],
)
def test_coefficients_of_other_lenses_are_refused(camera_model, name, size):
    given = {name: torch.zeros(2, size, dtype=torch.float64)}
    with pytest.raises(InputError, match="tangential_coeffs of pinhole"):
        rasterization(**scene_of(), **SIZE, camera_model=camera_model, **given)


def relative(a, b):
    return ((a - b).abs().max() / b.abs().max()).item()


def test_near_far_and_radius_clip(device):
    arguments = {name: x.to(device) for name, x in scene_of().items()}
    _, _, meta = rasterization(**arguments, **SIZE, near_plane=2.8, far_plane=3.3, radius_clip=4.0, packed=False)
    seen = (meta["radii"] > 0).all(-1)
    assert 0 < seen.sum() < 40
    assert ((meta["depths"][seen] > 2.8) & (meta["depths"][seen] < 3.3)).all() and (meta["radii"][seen] > 4).any(
        -1
    ).all()


def test_fused_op_agrees(device):
    scene = random_scene(n=60, clouds=1, images=2, sh_terms=0, dtype=torch.float32).to(device)
    fused = rasterize_gaussians(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.cameras(),
        colors=scene.color, background=scene.background, jacobian="clamped",
    )  # fmt: skip
    color, alpha, _ = rasterization(
        scene.means, scene.quats, scene.scales, scene.opacities, scene.color, scene.viewmats, scene.Ks,
        **SIZE, backgrounds=scene.background,
    )  # fmt: skip
    assert_close_relative_to_max(color, fused.color, "raster_float32")
    assert_close_relative_to_max(alpha[..., 0], fused.alpha, "raster_float32")


# ---- meta, gradients of the 2D means --------------------------------------------------------------------------------


def test_packed_meta_lists_what_is_seen(device):
    arguments = {name: x.to(device) for name, x in scene_of((2,)).items()}
    color, _, whole = rasterization(**arguments, **SIZE, packed=False)
    packed_color, _, packed = rasterization(**arguments, **SIZE)
    assert_same_bits(packed_color, color)
    assert whole["batch_ids"] is whole["camera_ids"] is whole["gaussian_ids"] is None
    unseen = (whole["radii"] == 0).any(-1)
    for name in ("means2d", "radii", "depths", "conics"):
        assert whole[name][unseen].abs().max() == 0
    assert (whole["opacities"][unseen] > 0).all()
    at = (packed["batch_ids"], packed["camera_ids"], packed["gaussian_ids"])
    assert len(at[0]) == (whole["radii"] > 0).all(-1).sum() < whole["radii"][..., 0].numel()
    for name in ("means2d", "radii", "depths", "conics", "opacities"):
        assert_same_bits(packed[name], whole[name][at])


@pytest.mark.parametrize("packed", [False, True])
def test_means2d_have_gradients(device, packed):
    arguments = {name: x.to(device).requires_grad_() for name, x in scene_of().items()}
    color, _, meta = rasterization(**arguments, **SIZE, absgrad=True, packed=packed)
    meta["means2d"].retain_grad()
    (color**2).sum().backward()
    grad, absolute = meta["means2d"].grad, meta["means2d"].absgrad
    assert grad.shape == absolute.shape == meta["means2d"].shape and grad.abs().max() > 0
    assert (absolute >= grad.abs() - 1e-12).all() and absolute.sum() > 1.1 * grad.abs().sum()
    color, _, meta = rasterization(**arguments, **SIZE, packed=packed)
    color.sum().backward()
    assert not hasattr(meta["means2d"], "absgrad")


def test_lists_of_tiles_are_refused_by_name():
    *_, meta = rasterization(**scene_of(), **SIZE)
    for name in ("isect_ids", "isect_offsets", "flatten_ids", "tiles_per_gauss", "tile_width", "tile_height"):
        for read in (lambda: meta[name], lambda: meta.get(name), lambda: meta.get(name, 0)):
            with pytest.raises(InputError, match=name):
                read()
    with pytest.raises(KeyError):
        meta["nothing"]
    assert meta.get("nothing") is None and meta.get("nothing", 7) == 7 and meta.get("width") == 45
    assert meta["tile_size"] == 16 and meta["width"] == 45 and meta["height"] == 37


@pytest.mark.parametrize(
    ("name", "value"),
    [("with_ut", True), ("with_eval3d", True), ("rays", torch.zeros(1)), ("ftheta_coeffs", object()),
     ("lidar_coeffs", object()), ("rolling_shutter", object()), ("viewmats_rs", torch.zeros(1)), ("distributed", True),
     ("sparse_grad", True), ("global_z_order", False), ("return_normals", True), ("extra_signals", torch.zeros(1)),
     ("extra_signals_sh_degree", 3), ("external_distortion_coeffs", object()),
     ("thin_prism_coeffs", torch.zeros(1)), ("ut_params", object()), ("renderer_config", object()),
     ("render_mode", "RGB-d"), ("camera_model", "ftheta"), ("rasterize_mode", "smooth")],
)  # fmt: skip
def test_what_is_not_offered_is_refused_by_name(name, value):
    with pytest.raises(InputError, match=name):
        rasterization(**scene_of(), **SIZE, **{name: value})


def test_absgrad_is_refused_while_compiling_and_works_beside():
    arguments = scene_of()
    arguments["means"].requires_grad_()

    def loss(means):
        return rasterization(**arguments | {"means": means}, **SIZE, packed=False, absgrad=True)[0].sum()

    with pytest.raises(Exception, match="absgrad under torch.compile is not offered"):
        torch.compile(loss, fullgraph=True, backend="eager")(arguments["means"])
    assert torch.compile(loss, backend="eager")(arguments["means"]) == loss(arguments["means"])


def test_wrong_shapes_are_named():
    arguments = scene_of()
    for name in ("means", "quats", "opacities", "viewmats", "Ks", "colors"):
        with pytest.raises(ValueError, match=name if name != "means" else "quats|opacities|means"):
            rasterization(
                **arguments | {name: arguments[name][..., :-1, :] if name != "opacities" else torch.ones(3)}, **SIZE
            )
    with pytest.raises(ValueError, match="colors"):
        rasterization(**arguments | {"colors": None}, **SIZE)
    wrong = {
        "backgrounds": torch.zeros(3), "radial_coeffs": torch.zeros(8), "tangential_coeffs": torch.zeros(1, 4),
        "viewmats": torch.eye(4), "colors": torch.zeros(40, 3),
    }  # fmt: skip
    for name, value in wrong.items():
        value = value if name == "colors" else value.double()
        with pytest.raises(ValueError, match=name):
            rasterization(**arguments | {name: value}, **SIZE)
    with pytest.raises(ValueError, match=r"radial_coeffs must be \[2, 4\]"):
        rasterization(**arguments, **SIZE, camera_model="fisheye", radial_coeffs=torch.zeros(2, 6).double())
    with pytest.raises(TypeError, match="means must be a tensor"):
        rasterization(**arguments | {"means": [0.0]}, **SIZE)
    with pytest.raises(TypeError, match="sh_degree must be a whole number"):
        rasterization(**arguments | {"colors": torch.zeros(40, 4, 3).double()}, **SIZE, sh_degree=1.0)
    with pytest.raises(ValueError, match="sh_degree=5"):
        rasterization(**arguments | {"colors": torch.zeros(40, 36, 3).double()}, **SIZE, sh_degree=5)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_bad_numbers_are_named_on_a_cpu(batch):
    arguments = scene_of(batch)
    bad = {"means": math.nan, "quats": math.inf, "scales": -1.0, "opacities": 1.5, "colors": math.nan}
    for name, value in bad.items():
        wrong = arguments[name].clone()
        wrong.view(-1)[7] = value
        with pytest.raises(NumericalError, match=f"rasterization: {name} must be finite"):
            rasterization(**arguments | {name: wrong}, **SIZE)
    for name in ("viewmats", "Ks"):
        with pytest.raises(NumericalError, match=rf"rasterization: {name}\[.*\] \(0 unless transposed\) must be"):
            rasterization(**arguments | {name: arguments[name].mT.contiguous()}, **SIZE)
    backgrounds = torch.full((*batch, 2, 3), math.inf).double()
    with pytest.raises(NumericalError, match="rasterization: backgrounds must be finite"):
        rasterization(**arguments, **SIZE, backgrounds=backgrounds)
    with pytest.raises(ValueError, match="rasterization: colors must be float64, as means, or of 16 bits"):
        rasterization(**arguments | {"colors": arguments["colors"].float()}, **SIZE)
    with pytest.raises(ValueError, match="rasterization: width and height must be in"):
        rasterization(**arguments, width=0, height=4)
    for eps2d, error in ((-1.0, ValueError), (math.nan, ValueError), ("0.3", TypeError)):
        with pytest.raises(error, match="rasterization: eps2d must be"):
            rasterization(**arguments, **SIZE, eps2d=eps2d)
    for wrong in (45.5, True, 2**70):
        with pytest.raises((TypeError, ValueError), match="rasterization: width must"):
            rasterization(**arguments, width=wrong, height=4)


# ---- gsplat 1.5.3, where it is installed -----------------------------------------------------------------------------


@with_gsplat
@pytest.mark.parametrize("camera_model", ["pinhole", "ortho", "fisheye"])
@pytest.mark.parametrize("calc_compensations", [False, True])
@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
def test_projection_of_gsplat(device, batch, calc_compensations, camera_model):
    from gsplat.cuda import _torch_impl as gsplat

    arguments = scene_of(batch, n=80)
    leaves = {name: x.clone().requires_grad_() for name, x in arguments.items()}
    covars, _ = gsplat._quat_scale_to_covar_preci(leaves["quats"], leaves["scales"], True, False, triu=False)
    radii, *expected, compensations = gsplat._fully_fused_projection(
        leaves["means"], covars, leaves["viewmats"], arguments["Ks"], 45, 37,
        calc_compensations=calc_compensations, camera_model=camera_model,
    )  # fmt: skip
    moved = {name: x.to(device).requires_grad_() for name, x in arguments.items()}
    mode = "antialiased" if calc_compensations else "classic"
    opacities = torch.full_like(moved["opacities"], 0.97)
    *_, meta = rasterization(
        **moved | {"opacities": opacities}, **SIZE, camera_model=camera_model, rasterize_mode=mode, packed=False
    )
    seen = ((radii > 0) & (meta["radii"].cpu() > 0)).all(-1)
    assert seen.sum() > 20 and ((radii > 0).all(-1) ^ seen).double().mean() < 0.1  # radii there ignore opacity
    # An epsilon is added to the radius of a fisheye there.
    tolerances = [1e-6, 1e-6] if camera_model == "fisheye" else ["projection_float64", "projection_grad_float64"]
    names = ["means2d", "depths", "conics"]
    if calc_compensations:
        names, expected = [*names, "opacities"], [*expected, 0.97 * compensations]
    actual, expected = [meta[name].cpu()[seen] for name in names], [x[seen] for x in expected]
    for name, a, e in zip(names, actual, expected, strict=True):
        assert_close_relative_to_max(a, e, tolerances[0], name)
    mixes = [torch.randn(e.shape, generator=torch.Generator().manual_seed(1)).to(e) for e in expected]
    inputs, both = ["means", "quats", "scales", "viewmats"], []
    for results, of in ((actual, moved), (expected, leaves)):
        loss = sum((m * x).sum() for m, x in zip(mixes, results, strict=True))
        both.append(torch.autograd.grad(loss, [of[name] for name in inputs]))
    for name, a, e in zip(inputs, *both, strict=True):
        assert_close_relative_to_max(a, e, tolerances[1], f"gradient of {name}")


@with_gsplat
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("absgrad", [False, True])
def test_default_strategy_of_gsplat(absgrad, packed):
    from gsplat.strategy import DefaultStrategy

    scene = scene_of(n=60, cameras=2, dtype=torch.float32)
    params = {
        "means": scene["means"],
        "quats": scene["quats"],
        "scales": scene["scales"].log(),
        "opacities": torch.logit(scene["opacities"]),
        "colors": torch.logit(scene["colors"].clamp(0.1, 0.9)),
    }
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(x.clone()) for name, x in params.items()})
    optimizers = {name: torch.optim.Adam([x], lr=0.01) for name, x in params.items()}
    strategy = DefaultStrategy(
        refine_start_iter=2,
        refine_every=5,
        reset_every=20,
        grow_grad2d=2e-3,
        absgrad=absgrad,
        pause_refine_after_reset=0,
    )
    strategy.check_sanity(params, optimizers)
    state, target, losses, counts = strategy.initialize_state(), torch.rand(2, 37, 45, 3), [], []
    for step in range(25):
        color, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            params["colors"].sigmoid(), scene["viewmats"], scene["Ks"], **SIZE, packed=packed, absgrad=absgrad,
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (color - target).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        losses.append(loss.item()), counts.append(len(params["means"]))
    assert len(set(counts)) > 1 and min(losses[-5:]) < losses[0]


# ---- gsplat's kernels, on a GPU --------------------------------------------------------------------------------------


@pytest.fixture
def gsplat_on_gpu(devices):
    """gsplat and the GPU; gsplat compiles its kernels at first use."""
    gsplat = pytest.importorskip("gsplat", reason="pip install --no-deps gsplat==1.5.3 rich jaxtyping")
    from gsplat.cuda import _backend

    if _backend._C is None:
        pytest.skip("gsplat has no compiled kernels here")
    return gsplat, devices[1]


def both_sides(gsplat, device, arguments, options):
    """(images, gradients, meta) of this call and of gsplat's, for the same mix of all outputs."""
    results = []
    for call in (rasterization, gsplat.rasterization):
        leaves = {name: x.detach().to(device).requires_grad_() for name, x in arguments.items()}
        shapes = {"quats": None, "scales": None} if "covars" in leaves else {}
        color, alpha, meta = call(**leaves | shapes, **SIZE, **options)
        meta["means2d"].retain_grad()
        g = torch.Generator().manual_seed(7)
        mixes = [torch.randn(x.shape, generator=g).to(device) for x in (color, alpha)]
        ((mixes[0] * color).sum() + (mixes[1] * alpha).sum()).backward()
        grads = {name: x.grad for name, x in leaves.items() if x.grad is not None and name != "Ks"}
        if "covars" in grads:  # gsplat reads one half of a covariance
            grads["covars"] = grads["covars"].triu() + grads["covars"].tril(-1).mT
        grads["means2d"] = meta["means2d"].grad
        if options.get("absgrad"):
            grads["absolute"] = meta["means2d"].absgrad
        results.append(((color.detach(), alpha.detach()), grads, meta))
    return results


def assert_close_but_for_jumps(actual, expected, what):
    """float32 on both sides: an alpha at 1/255, or light at 1e-4, falls on either side of its limit in few places."""
    error = (actual - expected).double().abs() / expected.double().abs().max().clamp_min(1e-12)
    assert (error > 1e-4).double().mean() < 2e-3 and error.max() < 2e-2, f"{what}: {error.max():.3g}"


def assert_same_as_gsplat(gsplat_on_gpu, arguments, options, without=()):
    """Images and gradients, but for those of ``without``; returns both meta."""
    (images, grads, meta), (their_images, their_grads, their_meta) = both_sides(*gsplat_on_gpu, arguments, options)
    for what, a, e in zip(("images", "alpha"), images, their_images, strict=True):
        assert_close_but_for_jumps(a, e, what)
    for name in grads.keys() & their_grads.keys() - set(without):
        error = (grads[name] - their_grads[name]).norm() / their_grads[name].norm().clamp_min(1e-12)
        assert error < 3e-3, f"gradient of {name}: {error:.3g}"
    return meta, their_meta


BESIDE = [
    *({"render_mode": mode} for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED")),
    *({"rasterize_mode": "antialiased", "camera_model": model} for model in ("pinhole", "ortho", "fisheye")),
    *({"camera_model": model, "packed": False} for model in ("ortho", "fisheye")),
    {"eps2d": 0.1},
    {"near_plane": 2.8, "far_plane": 3.3},
    {"radius_clip": 4.0},
    {"packed": False},
    {"absgrad": True, "packed": False},
]  # fmt: skip


@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
@pytest.mark.parametrize("options", BESIDE, ids=lambda options: "-".join(map(str, options.values())))
def test_images_and_gradients_beside_gsplat(gsplat_on_gpu, options, batch):
    if batch and options.get("packed", True):
        options = options | {"packed": False}  # gsplat 1.5.3 packs one batch
    packed = options.get("packed", True)  # rows of the same pairs may be in another order
    arguments = scene_of(batch, n=300, dtype=torch.float32)
    meta, their_meta = assert_same_as_gsplat(gsplat_on_gpu, arguments, options, ["means2d"] if packed else [])
    if not packed:
        seen = ((meta["radii"] > 0) & (their_meta["radii"] > 0)).all(-1)
        assert ((their_meta["radii"] > 0).all(-1) ^ seen).double().mean() < 0.1
        for name in ("means2d", "depths", "conics"):
            assert_close_relative_to_max(meta[name][seen], their_meta[name][seen], "projection_float32", name)


BATCHES = pytest.mark.parametrize(("batch", "packed"), [((), False), ((), True), ((2,), False), ((1, 2), False)])


@BATCHES
@pytest.mark.parametrize("changed", ["colors", "covars"])
def test_colors_of_views_and_covars_beside_gsplat(gsplat_on_gpu, changed, batch, packed):
    arguments = scene_of(batch, n=300, dtype=torch.float32)
    if changed == "colors":
        arguments["colors"] = torch.rand(*batch, 2, 300, 3, generator=torch.Generator().manual_seed(1))
    else:
        arguments["covars"] = projection_oracle.covariances(arguments.pop("quats"), arguments.pop("scales"))
    assert_same_as_gsplat(gsplat_on_gpu, arguments, {"packed": packed}, ["means2d"] if packed else [])


@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
@pytest.mark.parametrize("render_mode", ["RGB", "D", "RGB+D", "RGB+ED"])
def test_backgrounds_beside_gsplat(gsplat_on_gpu, render_mode, batch):  # packed gsplat 1.5.3 takes none
    arguments = scene_of(batch, n=300, dtype=torch.float32)
    arguments["backgrounds"] = torch.rand(*batch, 2, 3, generator=torch.Generator().manual_seed(1))
    assert_same_as_gsplat(gsplat_on_gpu, arguments, {"packed": False, "render_mode": render_mode})


@pytest.mark.parametrize("batch", [(), (2,), (1, 2)])
@pytest.mark.parametrize("channels", [1, 3, 5, 32, 33, 128])
def test_channels_beside_gsplat(gsplat_on_gpu, channels, batch):
    arguments = scene_of(batch, n=300, channels=channels, dtype=torch.float32)
    assert_same_as_gsplat(gsplat_on_gpu, arguments, {"packed": False})


@BATCHES
@pytest.mark.parametrize("sh_degree", range(5))
def test_harmonics_beside_gsplat(gsplat_on_gpu, sh_degree, batch, packed):
    arguments = scene_of(batch, n=300, dtype=torch.float32)
    arguments["colors"] = 0.3 * torch.randn(*batch, 300, 25, 3, generator=torch.Generator().manual_seed(1))
    without = ["viewmats", *["means2d"] * packed]  # there the centre is that of an inverted matrix
    assert_same_as_gsplat(gsplat_on_gpu, arguments, {"packed": packed, "sh_degree": sh_degree}, without)


def test_mcmc_strategy_of_gsplat(gsplat_on_gpu):
    gsplat, device = gsplat_on_gpu
    scene = {name: x.to(device) for name, x in scene_of(n=100, dtype=torch.float32).items()}
    params = {
        "means": scene["means"],
        "quats": scene["quats"],
        "scales": scene["scales"].log(),
        "opacities": torch.logit(scene["opacities"].clamp(0.02, 0.9)),
        "colors": torch.logit(scene["colors"].clamp(0.1, 0.9)),
    }
    params["opacities"][:10] = -8  # dead: they are moved
    params = torch.nn.ParameterDict({name: torch.nn.Parameter(x.clone()) for name, x in params.items()})
    optimizers = {name: torch.optim.Adam([x], lr=0.01) for name, x in params.items()}
    strategy = gsplat.MCMCStrategy(cap_max=120, refine_start_iter=2, refine_every=5, noise_lr=1.0)
    strategy.check_sanity(params, optimizers)
    state, target, losses = strategy.initialize_state(), torch.rand(2, 37, 45, 3, device=device), []
    for step in range(40):
        color, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            params["colors"].sigmoid(), scene["viewmats"], scene["Ks"], **SIZE,
        )  # fmt: skip
        loss = (color - target).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        strategy.step_post_backward(params, optimizers, state, step, info, lr=1e-4)
        losses.append(loss.item())
    assert len(params["means"]) == 120 and min(losses[-5:]) < losses[0]
    assert params["opacities"].sigmoid().min() > 0.003

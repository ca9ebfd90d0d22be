""".usdc and .usda: UsdVol ParticleField3DGaussianSplat, float32; positions and rotations of frames as time samples.

Attributes that never change are written once. Of frames with the same Gaussians in the same order, those that never
move make a field of their own, which has no time samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsim3d.errors import InputError
from gsim3d.io.arrays import FIELDS, Y_TO_Z_UP, Splats, read_head, turned
from gsim3d.io.files import whole_file

TYPE = "ParticleField3DGaussianSplat"


def _pxr(path: Path):
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, Vt
    except ImportError:
        raise InputError(f"{path}: USD needs usd-core 26.3 or newer: pip install 'gsim3d[usd]'") from None
    return Gf, Sdf, Usd, UsdGeom, Vt


def write(path: Path, frames: Sequence[Splats], fps: float) -> None:
    """Writes frames without loss, z up, in metres; a single one without time."""
    _, Sdf, Usd, UsdGeom, Vt = _pxr(path)
    with whole_file(path) as part:
        stage = Usd.Stage.CreateNew(str(part))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = stage.DefinePrim("/Gaussians", "Xform")
        stage.SetDefaultPrim(root)
        if len(frames) > 1:
            stage.SetTimeCodesPerSecond(fps)
            stage.SetFramesPerSecond(fps)
            stage.SetStartTimeCode(0)
            stage.SetEndTimeCode(len(frames) - 1)
        for name, chosen in _split(frames):
            _field(stage.DefinePrim(f"/Gaussians/{name}", TYPE), chosen, Sdf, Vt)
        stage.GetRootLayer().Save()
        del stage


def read(path: Path) -> Splats:
    """The Gaussians of all fields of a stage at its first time, z up, in metres.

    Raises:
        InputError: it is no USD file, or has no field of Gaussians.
    """
    read_head(path)  # a regular file
    try:
        whole, is_y_up, unit = _read(path)
    except InputError:
        raise
    except (RuntimeError, ValueError, TypeError, AttributeError) as error:  # RuntimeError: pxr's own, too
        raise InputError(f"{path}: damaged, or not a USD file: {_line(error)}") from None
    if not 0 < unit < np.inf:
        raise InputError(f"{path}: metersPerUnit must be positive; got {unit}")
    if is_y_up:
        whole = turned(whole, Y_TO_Z_UP)
    return Splats(whole.means * unit, whole.quats, whole.scales * unit, whole.opacities, whole.sh)


def _read(path: Path) -> tuple[Splats, bool, np.float32]:
    """The Gaussians as they stand, whether y points up, and metres a unit."""
    _, _, Usd, UsdGeom, _ = _pxr(path)
    stage = Usd.Stage.Open(str(path))
    time = Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.EarliestTime()
    parts = [_arrays(path, prim, time) for prim in stage.Traverse() if prim.GetTypeName() == TYPE]
    if not parts:
        raise InputError(f"{path}: no prim is a {TYPE}")
    if len({part.degree for part in parts}) > 1:
        raise InputError(f"{path}: its fields have different degrees of harmonics")
    whole = Splats(*(np.concatenate([getattr(part, name) for part in parts]) for name in FIELDS))
    is_y_up = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    return whole, is_y_up, np.float32(UsdGeom.GetStageMetersPerUnit(stage))


def _line(error: Exception) -> str:
    """The first line of a message; pxr's may hold bytes of the file."""
    try:
        return next(iter(str(error).strip().splitlines()), "").rpartition(" : ")[2][:100]
    except UnicodeDecodeError:
        return "its text is not UTF-8"


def _split(frames: Sequence[Splats]) -> list[tuple[str, list[Splats]]]:
    """(name, frames) of the parts that are written: what never changes once, what does in every frame."""
    if len(frames) == 1:
        return [("all", list(frames))]
    if len({frame.means.shape + frame.sh.shape for frame in frames}) > 1:
        return [("moving", list(frames))]
    first, still = frames[0], np.ones(frames[0].count, bool)
    for frame in frames[1:]:
        for name in FIELDS:
            now, before = (getattr(one, name).reshape(first.count, -1) for one in (frame, first))
            still &= (now == before).all(1)

    def some(frame: Splats, chosen: np.ndarray) -> Splats:
        return Splats(*(getattr(frame, name)[chosen] for name in FIELDS))

    parts = [("still", [some(first, still)])] if still.any() else []
    return parts + ([("moving", [some(frame, ~still) for frame in frames])] if not still.all() else [])


def _field(prim, frames: Sequence[Splats], Sdf, Vt) -> None:
    types = Sdf.ValueTypeNames
    attributes = {
        "positions": (types.Point3fArray, Vt.Vec3fArray, lambda s: s.means),
        # numpy has the imaginary part first, as the memory of a GfQuatf has
        "orientations": (types.QuatfArray, Vt.QuatfArray, lambda s: s.quats[:, [1, 2, 3, 0]]),
        "scales": (types.Float3Array, Vt.Vec3fArray, lambda s: s.scales),
        "opacities": (types.FloatArray, Vt.FloatArray, lambda s: s.opacities),
        "radiance:sphericalHarmonicsCoefficients": (types.Float3Array, Vt.Vec3fArray, lambda s: s.sh.reshape(-1, 3)),
        "extent": (types.Float3Array, Vt.Vec3fArray, _extent),
    }
    degree = prim.CreateAttribute("radiance:sphericalHarmonicsDegree", types.Int, False, Sdf.VariabilityUniform)
    degree.Set(frames[0].degree)
    for name, (kind, array_type, values) in attributes.items():
        attribute = prim.CreateAttribute(name, kind, False)
        before = None
        arrays = [array_type.FromNumpy(np.ascontiguousarray(values(frame))) for frame in frames]
        if all(array == arrays[0] for array in arrays[1:]):
            attribute.Set(arrays[0])
            continue
        for time, array in enumerate(arrays):
            if before is None or array != before or time + 1 < len(arrays) and arrays[time + 1] != array:
                attribute.Set(array, time)  # both ends of what stays: readers interpolate between samples
            before = array


def _extent(splats: Splats) -> np.ndarray:
    """[2, 3] float32, of the ellipsoids at three standard deviations, as spheres."""
    if not splats.count:
        return np.zeros((2, 3), np.float32)
    reach = 3 * splats.scales.max(1, keepdims=True)
    return np.stack([(splats.means - reach).min(0), (splats.means + reach).max(0)]).astype(np.float32)


def _arrays(path: Path, prim, time) -> Splats:
    def get(name: str, half: str | None = None):
        for key in (name, half):
            attribute = prim.GetAttribute(key) if key else None
            if attribute and (value := attribute.Get(time)) is not None:
                return value
        raise InputError(f"{path}: {prim.GetPath()} lacks {name}")

    means = np.array(get("positions", "positionsh"), np.float32).reshape(-1, 3)
    turns = get("orientations", "orientationsh")
    quats = np.array([[q.GetReal(), *q.GetImaginary()] for q in turns], np.float32).reshape(-1, 4)
    scales = np.array(get("scales", "scalesh"), np.float32).reshape(-1, 3)
    opacities = np.array(get("opacities", "opacitiesh"), np.float32)
    flat = np.array(get("radiance:sphericalHarmonicsCoefficients"), np.float32).reshape(-1, 3)
    n = len(means)
    fits = n == len(quats) == len(scales) == len(opacities)
    if not fits or n and (len(flat) % n or len(flat) // n not in (1, 4, 9, 16)):
        raise InputError(f"{path}: {prim.GetPath()}: its arrays have different counts")
    return Splats(means, quats, scales, opacities, flat.reshape(n, -1, 3) if n else np.zeros((0, 1, 3), np.float32))

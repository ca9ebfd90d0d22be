""".usdc and .usda: UsdVol ParticleField3DGaussianSplat, float32; positions and rotations of frames as time samples.

Attributes that never change are written once. Frames in a row with as many Gaussians share their fields: one of those
that never change, without time samples, and one of the others. Fields of other frames are invisible.
"""

import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gsim3d.errors import FitWarning, InputError
from gsim3d.io import usd_child
from gsim3d.io.arrays import FIELDS, Y_TO_Z_UP, Splats, joined, placed, read_head, turned
from gsim3d.io.files import whole_file


def _pxr(path: Path):
    try:
        from pxr import Sdf, Usd, UsdGeom, Vt
    except ImportError:
        raise InputError(f"{path}: USD needs usd-core 26.3 or newer: pip install 'gsim3d[usd]'") from None
    return Sdf, Usd, UsdGeom, Vt


def write(path: Path, frames: Sequence[Splats], fps: float) -> None:
    """Writes frames without loss, z up, in metres; a single one without time. Raises InputError where it cannot."""
    Sdf, Usd, UsdGeom, Vt = _pxr(path)
    with whole_file(path) as part:
        try:
            stage = Usd.Stage.CreateNew(str(part))
            UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
            UsdGeom.SetStageMetersPerUnit(stage, 1.0)
            stage.SetDefaultPrim(stage.DefinePrim("/Gaussians", "Xform"))
            if len(frames) > 1:
                stage.SetTimeCodesPerSecond(fps)
                stage.SetFramesPerSecond(fps)
                stage.SetStartTimeCode(0)
                stage.SetEndTimeCode(len(frames) - 1)
            for begin, span in _spans(frames):
                for name, chosen in _split(span):
                    prim = stage.DefinePrim(f"/Gaussians/{name}_{begin}", usd_child.TYPE)
                    _field(prim, begin, chosen, Sdf, Vt)
                    field, shown = UsdGeom.Imageable(prim), {0: begin == 0, begin: True, begin + len(span): False}
                    for at in shown.keys() & range(len(frames)) if len(span) < len(frames) else ():
                        field.CreateVisibilityAttr().Set("inherited" if shown[at] else "invisible", at)
            stage.GetRootLayer().Save()
        except RuntimeError as error:  # of pxr
            raise InputError(f"{path}: OpenUSD cannot write it: {usd_child.line(error)}") from None


def read(path: Path) -> Splats:
    """The Gaussians of all fields of a stage at its first time, z up, in metres.

    Raises:
        InputError: it is no USD file, or has no field of Gaussians.
    """
    read_head(path)  # a regular file
    _pxr(path)  # is installed
    with TemporaryDirectory() as place:
        out = Path(place) / "arrays.npz"
        if status := _child(str(path), str(out)):
            ended = signal.Signals(-status).name if status < 0 else f"code {status}"
            raise InputError(f"{path}: damaged, or too large: OpenUSD was ended by {ended} while reading it")
        with np.load(out) as file:
            found = dict(file)
    if "error" in found:
        raise InputError(f"{path}: {found['error']}")
    if found["is_moving"]:
        warnings.warn(f"{path}: only the first frame is read", FitWarning, stacklevel=3)
    unit = found["unit"]
    if not 0 < unit < np.inf:
        raise InputError(f"{path}: metersPerUnit must be positive; got {unit}")
    columns = (np.split(found[name], found["counts"].cumsum()[:-1]) for name in usd_child.FIELDS)
    parts = [placed(Splats(*part), place, path) for *part, place in zip(*columns, found["places"])]
    whole = placed(joined(parts, path), np.diag([unit, unit, unit, 1.0]), path)
    return turned(whole, Y_TO_Z_UP) if found["is_y_up"] else whole


def _child(file: str, out: str) -> int:
    """Runs ``usd_child``; its exit status."""
    few = dict.fromkeys(("PXR_WORK_THREAD_LIMIT", "OPENBLAS_NUM_THREADS", "MALLOC_ARENA_MAX"), "1")  # address space
    command = [sys.executable, "-P", usd_child.__file__, file, out]
    return subprocess.run(command, env={**os.environ, **few}, capture_output=True).returncode


def _spans(frames: Sequence[Splats]) -> Iterator[tuple[int, list[Splats]]]:
    """(number of the first, frames) of those in a row with as many Gaussians and harmonics."""
    begin = 0
    for _, group in groupby(frames, lambda frame: frame.sh.shape):
        yield begin, (span := list(group))
        begin += len(span)


def _split(span: list[Splats]) -> Iterator[tuple[str, list[Splats]]]:
    """(name, frames) of the parts of a span: what never changes once, what does in every frame."""
    first, still = span[0], np.ones(span[0].count, bool)
    for frame in span[1:]:
        for name in FIELDS:
            now, before = (getattr(one, name).reshape(first.count, -1) for one in (frame, first))
            still &= (now == before).all(1)

    def some(frame: Splats, chosen: np.ndarray) -> Splats:
        return Splats(*(getattr(frame, name)[chosen] for name in FIELDS))

    if still.any() or not len(still):
        yield "still", [some(first, still)]
    if not still.all():
        yield "moving", [some(frame, ~still) for frame in span]


def _field(prim, begin: int, frames: Sequence[Splats], Sdf, Vt) -> None:
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
                attribute.Set(array, begin + time)  # both ends of what stays: readers interpolate between samples
            before = array


def _extent(splats: Splats) -> np.ndarray:
    """[2, 3] float32, of the ellipsoids at three standard deviations, as spheres."""
    if not splats.count:
        return np.zeros((2, 3), np.float32)
    reach = 3 * splats.scales.max(1, keepdims=True)
    return np.stack([(splats.means - reach).min(0), (splats.means + reach).max(0)]).astype(np.float32)

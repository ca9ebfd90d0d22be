"""The program that reads a USD file for :mod:`gsim3d.io.usd`, in a process of its own: damaged ones crash OpenUSD.

``python -P usd_child.py FILE OUT`` writes the arrays of all fields to OUT (.npz), or under "error" what is wrong. It
imports nothing of the package, so that it starts at once.
"""

import os
import resource
import signal
import sys
from pathlib import Path

import numpy as np

TYPE = "ParticleField3DGaussianSplat"
MEMORY, SECONDS = 2**30, 60  # that any file may take beyond what the process has; further ones:
MEMORY_A_BYTE, BYTES_A_SECOND = 64, 2**20
FIELDS = ("positions", "orientations", "scales", "opacities", "radiance:sphericalHarmonicsCoefficients")


class Refused(Exception):
    """A file that is read, and holds something else."""


def main(file: str, out: str) -> None:
    """Writes what ``file`` holds to ``out``; the process ends where that takes too much time."""
    size = os.stat(file).st_size
    signal.alarm(SECONDS + size // BYTES_A_SECOND)
    if (statm := Path("/proc/self/statm")).is_file():  # Linux: begins with the pages that the process has
        has = int(statm.read_text().split()[0]) * resource.getpagesize()
        most, limit = has + MEMORY + MEMORY_A_BYTE * size, resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (most if limit == resource.RLIM_INFINITY else min(most, limit), limit))
    try:
        found = read(file)
    except Exception as error:  # whatever a damaged file brings about
        says = str(error) if isinstance(error, Refused) else f"damaged, or not a USD file: {line(error)}"
        found = {"error": np.array(says)}
    np.savez(out, **found)


def read(file: str) -> dict[str, np.ndarray]:
    """Arrays of all fields at the first time, joined, by FIELDS; for each its count and its transform, float64 [4, 4].

    Also whether there are later times, whether y points up, and metres a unit.
    """
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(file)
    time = Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.EarliestTime()
    fields = [prim for prim in stage.Traverse() if prim.GetTypeName() == TYPE]
    fields = [prim for prim in fields if UsdGeom.Imageable(prim).ComputeVisibility(time) != "invisible"]
    parts = [_arrays(prim, time) for prim in fields]
    if not parts:
        raise Refused(f"no visible prim is a {TYPE}")
    if len({part[-1].shape[1:] for part in parts}) > 1:
        raise Refused("its fields have different degrees of harmonics")
    found = {name: np.concatenate(arrays) for name, arrays in zip(FIELDS, zip(*parts))}
    found["counts"], places = np.array([len(part[0]) for part in parts]), UsdGeom.XformCache(time)
    found["places"] = np.array([np.array(places.GetLocalToWorldTransform(prim)).T for prim in fields])
    found["is_moving"] = np.array(stage.GetEndTimeCode() > stage.GetStartTimeCode())
    is_y_up = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    return found | {"is_y_up": np.array(is_y_up), "unit": np.array(UsdGeom.GetStageMetersPerUnit(stage))}


def _arrays(prim, time) -> list[np.ndarray]:
    def get(name: str, *shape: int) -> np.ndarray:
        for key in (name, f"{name}h"):  # of half precision
            attribute = prim.GetAttribute(key)
            if attribute and (value := attribute.Get(time)) is not None:
                return np.array(value, np.float32).reshape(shape)
        raise Refused(f"{prim.GetPath()} lacks {name}")

    means, quats, scales, opacities, sh = map(get, FIELDS, (-1,) * 5, (3, 4, 3, 1, 3))
    n = len(means)
    fits = n == len(quats) == len(scales) == len(opacities)
    if not fits or n and (len(sh) % n or len(sh) // n not in (1, 4, 9, 16)):
        raise Refused(f"{prim.GetPath()}: its arrays have different counts")
    sh = sh.reshape(n, -1, 3) if n else np.zeros((0, 1, 3), np.float32)
    return [means, np.roll(quats, 1, 1), scales, opacities[:, 0], sh]  # in memory the real part stands last


def line(error: Exception) -> str:
    """The first line of a message; pxr's may hold bytes of the file."""
    try:
        return next(iter(str(error).strip().splitlines()), "").rpartition(" : ")[2][:100]
    except UnicodeDecodeError:
        return "its text is not UTF-8"


if __name__ == "__main__":
    main(*sys.argv[1:])

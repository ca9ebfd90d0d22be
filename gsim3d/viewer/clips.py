"""Frames of videos: labelled panels of a size that screens like."""

from collections.abc import Iterator, Mapping

import cv2
import numpy as np

PANEL = 512  # pixels, least height of a panel
WIDEST = 3840  # pixels of a video, where its images are not wider themselves
GAP = 4  # pixels of white between panels
FONT, TEXT, SHADE = cv2.FONT_HERSHEY_SIMPLEX, 1 / 600, 0.4  # scale per pixel of a panel; brightness behind a text
WHITE, ACCENT = (255, 255, 255), (255, 157, 77)


def clip_frames(rows: Mapping[str, np.ndarray], fps: float, n_given: int = 0) -> Iterator[np.ndarray]:
    """Frames uint8 [H, W, 3] of even size: a row of panels for each label, a column a view, the time in seconds.

    ``rows`` is label -> images uint8 [S, V, H, W, 3], all of one shape; small ones are enlarged to PANEL. The last
    row of the first ``n_given`` is labelled as given.
    """
    n_steps, n_views, height, width = next(iter(rows.values())).shape[:4]
    scale = max(1.0, min(PANEL / height, (WIDEST / n_views - GAP) / width))
    height, width = (2 * round(scale * side / 2) for side in (height, width))
    for step in range(n_steps):
        canvas = np.full((len(rows) * (height + GAP) - GAP, n_views * (width + GAP) - GAP, 3), 255, np.uint8)
        for i, (label, images) in enumerate(rows.items()):
            is_last = i == len(rows) - 1
            for j, image in enumerate(images[step]):
                panel = canvas[i * (height + GAP) :, j * (width + GAP) :][:height, :width]
                panel[:] = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
                if j == 0:
                    write_text(panel, "given" if is_last and step < n_given else label, ACCENT if is_last else WHITE)
                if i == 0 and j == n_views - 1:
                    write_time(panel, step, fps)
        yield canvas


def turbo(values: np.ndarray) -> np.ndarray:
    """Returns colours uint8 [..., 3] of ``values`` in [0, 1], from blue to red."""
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
    return table[(np.clip(values, 0, 1) * 255).round().astype(np.uint8)]


def write_time(image: np.ndarray, step: int, fps: float) -> None:
    """Writes the time of ``step`` into the upper right corner of ``image``."""
    write_text(image, f"{step / fps:.2f} s", WHITE, right=True)


def write_text(image: np.ndarray, text: str, color: tuple[int, int, int], right: bool = False) -> None:
    """Writes ``text`` into an upper corner of ``image`` uint8 [H, W, 3], on a darker ground."""
    scale, edge = TEXT * image.shape[0], max(2, image.shape[0] // 42)
    thickness = max(1, round(2 * scale))
    (width, height), below = cv2.getTextSize(text, FONT, scale, thickness)
    left = image.shape[1] - width - 3 * edge if right else edge
    ground = image[edge : 2 * edge + height + below, max(0, left) : left + width + 2 * edge]
    ground[:] = (SHADE * ground).astype(np.uint8)
    drawn = np.ascontiguousarray(image)
    cv2.putText(drawn, text, (left + edge, 3 * edge // 2 + height), FONT, scale, color, thickness, cv2.LINE_AA)
    image[:] = drawn

"""A viewer of a training run: the newest sample prediction, uploaded by the viewer's own thread."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise

from gsim3d.io.arrays import rows_of
from gsim3d.state import Gaussians, Particles, single_steps
from gsim3d.train.log import Sample
from gsim3d.viewer.live import Target
from gsim3d.viewer.server import Viewer, load_viser


@contextmanager
def showing_samples() -> Iterator[Callable[[Sample, int], None]]:
    """Within it, calling what it gives with a sample and the step shows them; the first call prints the address.

    A viewer that fails is given up with a warning: the training goes on.

    Raises:
        InputError: viser is not installed.
    """
    load_viser()
    viewers: list[Viewer | None] = []

    def show(sample: Sample, step: int) -> None:
        if viewers == [None]:
            return
        try:
            if viewers:
                viewers[0].show(*_frames(sample), f"training step {step}")
                return
            particles, frames = _frames(sample)
            scene, about = sample.scene, {"scene": sample.scene, "n_encoded": sample.n_given}
            viewers.append(Viewer(Target(scene.name, scene.fps, particles=particles, frames=frames, **about)))
            print(f"viewer: {viewers[0].address}", flush=True)
        except Exception as error:  # whatever it is, it is not worth the training
            warnings.warn(f"--viewer is given up at step {step}: {type(error).__name__}: {error}", stacklevel=2)
            viewers[:] = [None]

    try:
        yield show
    finally:
        for viewer in filter(None, viewers):
            with suppress(Exception):
                viewer.close()


def _frames(sample: Sample) -> tuple[list[Particles], list[Gaussians]]:
    """Particles and Gaussians of each step, on the CPU."""
    particles, gaussians = sample.particles.to("cpu"), sample.gaussians.to("cpu")
    spans = pairwise(gaussians.cu_rows.tolist())
    return single_steps(particles), [rows_of(gaussians, slice(*span)) for span in spans]

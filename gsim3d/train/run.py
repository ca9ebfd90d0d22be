"""Implementation of ``gsim3d train``: starts or resumes a training run of one or several processes."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path

from gsim3d.cuda_graphs import is_out_of_memory
from gsim3d.data import Scene
from gsim3d.errors import InputError
from gsim3d.io import checkpoint
from gsim3d.io.files import with_parents
from gsim3d.io.locks import only_one_writer
from gsim3d.train.config import TrainConfig
from gsim3d.train.log import Sample
from gsim3d.train.loop import Trainer
from gsim3d.train.processes import joined
from gsim3d.train.samples import check_scenes


@contextmanager
def run_folder(out: Path) -> Iterator[None]:
    """Makes and locks the folder ``out``; removes it if nothing was written into it. Raises InputError if it is a file,
    or as :func:`only_one_writer`."""
    new = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"--out: {out} is not a folder") from None
    try:
        with only_one_writer(out):
            yield
    finally:
        with suppress(OSError):  # not empty
            new and out.rmdir()


def train(
    config: TrainConfig,
    folders: Sequence[Path],
    out: str | Path,
    *,
    cache: str | Path | None = None,
    device: str = "cpu",
    until: int | None = None,
    export: str | Path | None = None,
    tensorboard: bool = False,
    wandb: bool = False,
    viewer: Callable[[], AbstractContextManager[Callable[[Sample, int], None]]] | None = None,
    held_out: Sequence[Path] = (),
    profile: bool = False,
) -> None:
    """Trains on the scenes in ``folders`` and writes the run folder ``out``.

    Args:
        cache: folder to cache decoded images in; None caches them in memory.
        device: "cpu" or "cuda".
        until: optimizer step to stop after; None: the last one.
        export: .safetensors file to export the result to; None: no export.
        tensorboard: also log to OUT/tensorboard.
        wandb: also log for Weights & Biases.
        viewer: returns a context manager whose value is called with samples, see ``watch`` of :meth:`Trainer.run`.
        held_out: held-out scene folders; the viewer shows the first, or a training scene if there are none.
        profile: write a trace of two steps to OUT/profile.

    Raises:
        InputError: scenes do not fit the settings, or memory is exhausted.
        RunStopped: a signal, or the end of another process, stopped the run.
    """
    if cache:
        Path(cache).mkdir(parents=True, exist_ok=True)  # raises early if not writable
    opened = {"fitting": config.data.fitting, "fps": config.data.subsample_fps or None}
    scenes = [Scene.open(folder, cache_dir=cache, **opened) for folder in folders]
    with joined(device) as processes, run_folder(Path(out)) if processes.is_first else nullcontext():
        report = print if processes.is_first else lambda *_: None
        trainer = Trainer(config, scenes, out, device=device, processes=processes)
        if trainer.step:
            changed = "" if trainer.same_scenes else "; scenes were added, so results differ from an uninterrupted run"
            report(f"resuming at step {trainer.step} of {config.n_steps}{changed}")
        watched = None
        if viewer and held_out:
            watched = Scene.open(held_out[0], cache_dir=cache, **opened)
            check_scenes([trainer.scenes[0], watched], config.data, config.phases)
        options = {"until": until, "tensorboard": tensorboard, "wandb": wandb, "profile": profile}
        try:
            with viewer() if viewer else nullcontext() as watch:
                trainer.run(**options, watch=watch, watched=watched)
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error):
                raise
            raise InputError(
                f"step {trainer.step}: out of memory ({device}): reduce batch or target_views, increase the strides of "
                f"data, or set recompute: [encoder, steps, images]; then {out} resumes from its last checkpoint"
            ) from None
        report(f"trained to step {trainer.step} of {config.n_steps}: {out}")
        if export and processes.is_first:
            checkpoint.export(checkpoint.load(out), with_parents(Path(export)))
            report(f"written: {export}")

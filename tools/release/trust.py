#!/usr/bin/env python
"""Calibrates the trust in a simulator, and measures how well it holds on held-out and on changed scenes.

    python tools/release/trust.py elastic-small --data runs/trust --out docs/results
    python tools/release/trust.py elastic-gns --checkpoint runs/gns/elastic-gns.weights.safetensors --preset published \
        --data runs/trust --out runs/gns --device cuda

Generates sets of the simulator's world in DATA, predicts them with the spread of variants, writes trust.json beside the
weights, and OUT/NAME.trust.json and OUT/NAME.trust.png for docs/results/trust.md. Killed and started again, it goes on:
every scene that is finished is kept in DATA, for these weights.
"""

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import torch

ROOT = Path(__file__).resolve().parent.parent.parent
sys.path.insert(0, str(ROOT))
from gsim3d.data import find_scenes  # noqa: E402
from gsim3d.errors import InputError  # noqa: E402
from gsim3d.evaluate import trust  # noqa: E402
from gsim3d.evaluate.pictures import pyplot  # noqa: E402
from gsim3d.evaluate.protocol import predict_together  # noqa: E402
from gsim3d.evaluate.report import write_json  # noqa: E402
from gsim3d.io.files import whole_file  # noqa: E402
from gsim3d.io.terminal import progress  # noqa: E402
from gsim3d.numerics.trust import Trust  # noqa: E402
from gsim3d.pretrained import folder_of  # noqa: E402
from gsim3d.synth import generate  # noqa: E402
from gsim3d.synth.worlds import TEST_SEED, VALIDATION_SEED  # noqa: E402
from gsim3d.train.restore import Restored, restore  # noqa: E402

FRAMES, STEPS, CHANGED_FRAMES = 32, 24, 5  # frames of the sets, predicted steps, frames of changed scenes
# set -> trajectories, how many of them are predicted, options of the generator
SETS = {
    "validation": (20, 14, {"seed": VALIDATION_SEED}),
    "test": (14, 14, {"seed": TEST_SEED}),
    "unseen": (8, 8, {"seed": VALIDATION_SEED, "subset": "unseen"}),
}
UNDECLARED, TRUE_FOV = "lens, wider than declared", 42.0
# Changes of the world elastic.
CHANGES = {
    "rig, nearer": {"distance": 2.6},
    "rig, farther": {"distance": 3.9, "far": 6.0},
    "rig, steeper": {"elevations": (40.0, 60.0)},
    "rig, varied by 15 %": {"camera_spread": 0.15, "near": 1.0, "far": 6.0},
    "ground, grey": {"ground_albedo": 0.55},
    "ground, raised": {"subset": "raised"},
    "ground, none": {"subset": "no-ground"},
    "lens, wider": {"fov": 50.0},
    "lens, longer": {"fov": 36.0},
    UNDECLARED: {"fov": 48.0},
    "size, smaller": {"body_size": (0.3, 0.4)},
    "size, larger": {"body_size": (0.84, 0.9)},
}
CHANGED = 4  # trajectories of each


def scenes_of(folder: Path, count: int, **options) -> list[Path]:
    """Generates ``count`` trajectories in ``folder``; returns them with the objects in turn."""
    generate(folder, n_trajectories=count, **options)
    return sorted(find_scenes(folder), key=lambda path: (path.name, path.parent.name))[:count]


def declare_lens(folders: list[Path], fov: float) -> None:
    """Writes other intrinsics, of a field of view of ``fov`` degrees, to the metadata of scenes."""
    for folder in folders:
        metadata = json.loads((folder / "metadata.json").read_text())
        for camera in (metadata[f"cam_{cam}"] for cam in range(metadata["n_cams"])):
            focal = camera["resolution"][1] / 2 / np.tan(np.radians(fov) / 2)
            camera["intrinsics"][0][0] = camera["intrinsics"][1][1] = focal
        write_json(folder / "metadata.json", metadata)


def measures(restored: Restored, folders: list[Path], kept: Path, starts: tuple[int, ...] = (0,)) -> list[dict]:
    """Measures of the input of each scene and start; those in the file ``kept`` are not measured again."""
    known = json.loads(kept.read_text()) if kept.is_file() else {}
    wanted = {f"{folder.parent.name}/{folder.name}@{start}": (folder, start) for folder in folders for start in starts}
    for key, (folder, start) in progress(list(wanted.items()), kept.stem, unit="scene"):
        if key not in known:
            known[key] = trust.measure_scene(restored, restored.open_scene(folder), start)
            write_json(kept, known)
    return [known[key] for key in wanted]


def pairs(restored: Restored, folders: list[Path], kept: Path) -> list[trust.Samples]:
    """Spread and error of each scene; those in the folder ``kept`` are not predicted again."""
    kept.mkdir(parents=True, exist_ok=True)
    found = []
    for folder in progress(folders, f"predicting {kept.name}", unit="scene"):
        file = kept / f"{folder.parent.name}_{folder.name}.npz"
        if not file.is_file():
            made = predict_together(restored, [restored.open_scene(folder)], STEPS, with_spread=True)[0]
            spread, error = trust.samples(restored.open_scene(folder), made)
            with whole_file(file) as part, open(part, "wb") as opened:
                np.savez(opened, spread=spread, error=error)
        with np.load(file) as values:
            found.append((values["spread"], values["error"]))
    return found


def detection(calibration: Trust, measured: list[dict]) -> dict:
    """Counts of scenes, of those that are announced, and of the measures that announce them."""
    found = [calibration.unfamiliar(one) for one in measured]
    names = Counter(text.partition("]")[0].split(" [")[0] if "[" in text else text.split(" (")[0].rpartition(" ")[0]
                    for texts in found for text in texts)  # fmt: skip
    return {"scenes": len(found), "announced": sum(map(bool, found)), "measures": dict(names.most_common())}


def measure(
    name: str, checkpoint: str, data: Path, preset: str, device: str
) -> tuple[dict, Trust, dict[str, list[trust.Samples]]]:
    """Calibrates ``checkpoint``; returns what OUT/NAME.trust.json holds, the calibration, and the samples by set."""
    restored = restore(checkpoint, device)
    restored.simulator.trust = None  # an older calibration announces nothing here
    kind, data = {"world": name.split("-")[0], "preset": preset}, data / f"{name.split('-')[0]}-{preset}"
    kept = data / "measured" / restored.checkpoint.digest[:16]
    kept.mkdir(parents=True, exist_ok=True)
    found, measured = {}, {}
    for part, (count, predicted, options) in SETS.items():
        folders = scenes_of(data / part, count, n_frames=FRAMES, **kind, **options)
        starts = (0, (FRAMES - restored.n_encoded) // 2) if part == "validation" else (0,)
        measured[part] = measures(restored, folders, kept / f"{part}.json", starts)
        found[part] = pairs(restored, folders[:predicted], kept / part)
    for part, options in CHANGES.items():
        place = part.replace(",", "").replace(" ", "-").replace("%", "percent")
        given = {"seed": VALIDATION_SEED, "n_frames": CHANGED_FRAMES, **kind, **options}
        folders = scenes_of(data / "changed" / place, CHANGED, **given)
        if part == UNDECLARED:
            declare_lens(folders, TRUE_FOV)
        measured[part] = measures(restored, folders, kept / f"{place}.json")
    fitted = {**trust.fit_bounds(found["validation"]), **trust.fit_ranges(measured["validation"])}
    made = Trust(n_scenes=len(found["validation"]), n_steps=STEPS, **fitted)
    results = {
        "checkpoint": name,
        "sets": {part: trust.report(made, samples) for part, samples in found.items()},
        "detection": {part: detection(made, one) for part, one in measured.items()},
    }
    trust.save_trust(folder_of(checkpoint), restored.checkpoint.digest, made)
    return results, made, found


def draw(path: Path, results: dict, made: Trust, found: dict[str, list[trust.Samples]]) -> None:
    """Draws reliability, risk and coverage, and errors and bounds by step."""
    plt = pyplot()
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    left.plot([0, 1], [0, 1], color="#bbbbbb", linewidth=1)
    for k, (name, summary) in enumerate(results["sets"].items()):
        shares = summary["reliability"]
        label = f"{name}, {summary['n_scenes']} scenes"
        left.plot([float(level) for level in shares], list(shares.values()), "o-", markersize=3, label=label)
        steps = np.arange(1, len(summary["by_step"]["error"]) + 1)
        right.plot(steps, summary["by_step"]["error"], color=f"C{k}", label=f"{name}, error")
        right.plot(steps, summary["by_step"]["bound"], color=f"C{k}", linestyle="--")
    _, step, error = trust.flat(found["test"])
    scores = np.concatenate([made.score(torch.from_numpy(one)).flatten().numpy() for one, _ in found["test"]])
    for label, order in (("step alone", step), ("trust", scores), ("perfect", error)):
        curve = trust.risks(error, order)
        middle.plot(np.arange(1, len(curve) + 1) / len(curve), curve, label=label)
    left.set(title="reliability", xlabel="level of the bound", ylabel="share of errors within it")
    middle.set(title="risk and coverage, test", xlabel="share of particles kept", ylabel="mean error [m]")
    right.set(title="errors, and bounds of 90 % (dashed)", xlabel="predicted step", ylabel="mean [m]")
    for axes in (left, middle, right):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    with whole_file(path) as part:
        figure.savefig(part, dpi=90, format="png")
    plt.close(figure)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("name", help="world and size, such as elastic-small")
    parser.add_argument("--checkpoint", help="where its weights are (default: those that come with gsim3d)")
    parser.add_argument("--data", type=Path, required=True, help="folder of the scenes; made if absent")
    parser.add_argument("--out", type=Path, required=True, help="folder of NAME.trust.json and NAME.trust.png")
    parser.add_argument("--preset", default="diverse", help="of its training's trajectories (default: diverse)")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    args = parser.parse_args(arguments)
    results, made, found = measure(args.name, args.checkpoint or args.name, args.data, args.preset, args.device)
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(args.out / f"{args.name}.trust.json", results)
    draw(args.out / f"{args.name}.trust.png", results, made, found)
    for name, summary in results["sets"].items():
        print(f"{name}: {trust.table(summary)}")
    for name, one in results["detection"].items():
        print(f"{name}: {one['announced']} of {one['scenes']} announced; {one['measures']}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"trust: error: {error}")

"""Trains a tiny simulator for a few steps, saves it and loads it again.

gsim3d generate elastic --preset mini --objects blob --trajectories 2 --frames 12 --out runs/mini
python examples/04_train.py runs/mini runs/example_model
"""

import sys

from gsim3d import Simulator
from gsim3d.data import Scene, find_scenes
from gsim3d.train.config import DataConfig, PhaseConfig, TrainConfig
from gsim3d.train.loop import Trainer

if len(sys.argv) != 3 or sys.argv[1].startswith("-"):
    sys.exit(__doc__)
data, out = sys.argv[1:3]

config = TrainConfig(
    preset="tiny",
    phases=(
        PhaseConfig(steps=2, target_views=2),  # images of the encoded steps alone
        PhaseConfig(steps=2, target_views=2, horizon=2),  # rollouts of two steps
    ),
    data=DataConfig(history=2, context_views=2, body_stride=2, background_stride=4, resize=(64, 64)),
    log_every=1,
)
scenes = [Scene.open(folder, fitting=config.data.fitting) for folder in find_scenes(data)]

trainer = Trainer(config, scenes, out)
trainer.run()  # a second call with the same folder continues where it stopped

simulator = Simulator.from_pretrained(out)
print(f"{trainer.step} steps; {sum(p.numel() for p in simulator.parameters()):,} parameters; log: {out}/metrics.jsonl")

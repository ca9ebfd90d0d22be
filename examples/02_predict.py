"""Predicts a scene with a shipped simulator; writes predicted images and 3D Gaussians.

gsim3d generate elastic --preset diverse --trajectories 7 --out runs/data
python examples/02_predict.py runs/data/ball/0000 runs/example
"""

import sys
from pathlib import Path

import cv2
import torch

from gsim3d import Simulator
from gsim3d.data import Scene
from gsim3d.io import write_splats

if len(sys.argv) != 3 or sys.argv[1].startswith("-"):
    sys.exit(__doc__)
folder, out = sys.argv[1], Path(sys.argv[2])
out.mkdir(parents=True, exist_ok=True)

simulator = Simulator.from_pretrained("elastic-small")
scene = Scene.open(folder)
cameras = scene.cameras_at([0], [0])

with torch.no_grad():
    prediction = simulator.predict(scene, steps=4, cameras=cameras)

for step, (particles, rendering) in enumerate(zip(prediction.steps, prediction.renderings)):
    image = (255 * rendering.color[0].clamp(0, 1)).byte().numpy()
    cv2.imwrite(str(out / f"{step:04d}.png"), image[..., ::-1])
    write_splats(out / f"{step:04d}.ply", simulator.renderer(particles))
print(f"{prediction.steps[-1].n_rows} particles after {len(prediction.steps)} steps; written: {out}")

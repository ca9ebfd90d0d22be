#!/usr/bin/env bash
# The main job on one machine: makes multi-view video and predicts it (with --train: learns the simulator, too).
# Any further arguments go to `gsim3d demo` (see `python -m gsim3d demo --help`).
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
exec python -m gsim3d demo --out runs/demo "$@"

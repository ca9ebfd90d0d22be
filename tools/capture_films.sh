#!/usr/bin/env bash
# From degraded films of generated scenes to a scored simulator; an interrupted run continues.
#   bash tools/capture_films.sh runs/films cuda 15
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-runs/films} device=${2:-cpu} minutes=${3:-15} scenes=${4:-24}
world=(elastic --preset published --size 256 --frames 84 --trajectories "$scenes" --seed 5)
python -m gsim3d generate "${world[@]}" --out "$out/data"
[ -f "$out/films/truth.json" ] || python -m tools.films "$out/data" "$out/films" --cameras 0 1 2
python -m gsim3d capture "$out/films" --board 5 4 0.25 --out "$out/run" --device "$device" --minutes "$minutes"

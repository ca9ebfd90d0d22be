#!/usr/bin/env bash
# Degraded videos of generated scenes -> simulators by plane sweep and from pretrained depth -> docs/results/captures.
#   bash tools/capture_videos.sh runs/videos cuda 15 ~/.cache/gsim3d/weights/dinov2_small.safetensors
# An interrupted call continues: `timeout 540 bash tools/capture_videos.sh ...` until the table is printed. Further
# arguments: scenes of a set of videos, folder of the scores, names of the sets to capture (default: all).
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-runs/videos} device=${2:-cpu} minutes=${3:-15} weights=${4:-}
scenes=${5:-24} results=${6:-docs/results/captures}
names=" ${*:7} "
[ "$names" != "  " ] || names=" elastic rigid cloth held_out_camera "
videos=()
for words in "elastic elastic 0 1 2" "rigid rigid 0 1 2" "cloth cloth 0 1 2" "held_out_camera elastic 0 1 2 3"; do
  [[ $names != *" ${words%% *} "* ]] || videos+=("$words")
done

video() { # NAME WORLD CAMERA ...
  [ -f "$out/$1/videos/truth.json" ] && return
  python -m gsim3d generate "$2" --preset published --size 256 --frames 84 --trajectories "$scenes" --seed "${#1}" \
    --out "$out/$1/data" --quiet
  python -m tools.clips "$out/$1/data" "$out/$1/videos" --cameras "${@:3}"
}

capture() { # NAME ENCODER [--depth MODEL FILE]
  local run="$out/$1/$2"
  python -m gsim3d capture "$out/$1/videos" --board 5 4 0.25 --out "$run" --device "$device" --minutes "$minutes" \
    "${@:3}"
  cp "$run/metrics.json" "$results/$1-$2.json"
}

mkdir -p "$out" "$results"
for words in "${videos[@]}"; do video $words & done
for job in $(jobs -p); do wait "$job"; done
for words in "${videos[@]}"; do
  name=${words%% *}
  capture "$name" plane_sweep
  [ -n "$weights" ] || continue
  if [ ! -f "$out/$name/dinov2_small/proposal.json" ]; then # prepared alike
    mkdir -p "$out/$name/dinov2_small"
    cp -rlf "$out/$name/plane_sweep/"{scenes,check.json,proposal.json} "$out/$name/dinov2_small"
  fi
  capture "$name" dinov2_small --depth dinov2_small "$weights"
done
python -c "
import pathlib, sys
sys.path.insert(0, 'docs')
import generate
print(generate.captures(pathlib.Path('$results')))"

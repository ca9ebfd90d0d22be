#!/usr/bin/env bash
# Degraded films of generated scenes -> simulators by plane sweep and from pretrained depth -> docs/results/captures.
#   bash tools/capture_films.sh runs/films cuda 15 ~/.cache/gsim3d/weights/dinov2_small.safetensors
# An interrupted call continues: `timeout 540 bash tools/capture_films.sh ...` until the table is printed. Further
# arguments: scenes of a set of films, folder of the scores, names of the sets to capture (default: all).
set -euo pipefail
cd "$(dirname "$0")/.."
out=${1:-runs/films} device=${2:-cpu} minutes=${3:-15} weights=${4:-}
scenes=${5:-24} results=${6:-docs/results/captures}
names=" ${*:7} "
[ "$names" != "  " ] || names=" elastic rigid cloth held_out_camera "
films=()
for words in "elastic elastic 0 1 2" "rigid rigid 0 1 2" "cloth cloth 0 1 2" "held_out_camera elastic 0 1 2 3"; do
  [[ $names != *" ${words%% *} "* ]] || films+=("$words")
done

film() { # NAME WORLD CAMERA ...
  [ -f "$out/$1/films/truth.json" ] && return
  python -m gsim3d generate "$2" --preset published --size 256 --frames 84 --trajectories "$scenes" --seed "${#1}" \
    --out "$out/$1/data" --quiet
  python -m tools.films "$out/$1/data" "$out/$1/films" --cameras "${@:3}"
}

capture() { # NAME ENCODER [--depth MODEL FILE]
  local run="$out/$1/$2"
  python -m gsim3d capture "$out/$1/films" --board 5 4 0.25 --out "$run" --device "$device" --minutes "$minutes" \
    "${@:3}"
  cp "$run/metrics.json" "$results/$1-$2.json"
}

mkdir -p "$out" "$results"
for words in "${films[@]}"; do film $words & done
for job in $(jobs -p); do wait "$job"; done
for words in "${films[@]}"; do
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

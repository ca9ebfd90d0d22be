#!/usr/bin/env bash
# Packs what a training run needs on a machine that has Python, torch, nvcc and no network:
#
#   bash tools/release/pack.sh COMMIT DIR [STATE_DIR]
#
# DIR/source.tar.gz: the code at COMMIT without weights, pictures and tests (under 8 MiB); DIR/commit; DIR/state: the
# state of the last run; DIR/start.sh. Wheels of the packages that the machine lacks go to DIR/wheels, by hand.
set -euo pipefail
[ $# -ge 2 ] || { echo "usage: bash tools/release/pack.sh COMMIT DIR [STATE_DIR]" >&2; exit 2; }
root="$(cd "$(dirname "$0")/../.." && pwd)"
commit="$(git -C "$root" rev-parse --verify "$1^{commit}")"
mkdir -p "$2/state"
configs="$(git -C "$root" ls-tree --name-only "$commit" configs)"  # which older commits lack
git -C "$root" archive --format=tar.gz -o "$(realpath "$2")/source.tar.gz" "$commit" -- \
  setup.py pyproject.toml README.md LICENSE csrc gsim3d tools $configs \
  ':!gsim3d/pretrained/*/**' ':!tools/bench' ':!tools/release/state'
echo "$commit" >"$2/commit"
git -C "$root" show "$commit:tools/release/start.sh" >"$2/start.sh"
if [ $# -ge 3 ]; then cp "$3"/*.state.safetensors "$2/state/"; fi
size="$(stat -c %s "$2/source.tar.gz")"
echo "$2/source.tar.gz: $((size / 1024)) KiB of $commit"
[ "$size" -le $((8 << 20)) ] || { echo "source.tar.gz is over 8 MiB" >&2; exit 1; }

#!/usr/bin/env bash
# Packs what a training run needs on a machine that has Python, torch, nvcc and no network:
#
#   bash tools/release/pack.sh COMMIT DIR [STATE_DIR [PYTHON]]
#
# DIR/source.tar.gz: the code at COMMIT without weights, pictures and tests (under 8 MiB); DIR/commit; DIR/state: the
# state of the last run; DIR/start.sh. Wheels of the packages that the machine lacks go to DIR/wheels, by hand. With
# PYTHON, of the machine's version and with its torch, the extension is built here into DIR/build, for the GPUs in
# TORCH_CUDA_ARCH_LIST (default 9.0a: H100 and H200), so that the machine need not build it.
set -euo pipefail
[ $# -ge 2 ] || { echo "usage: bash tools/release/pack.sh COMMIT DIR [STATE_DIR [PYTHON]]" >&2; exit 2; }
root="$(cd "$(dirname "$0")/../.." && pwd)"
commit="$(git -C "$root" rev-parse --verify "$1^{commit}")"
mkdir -p "$2/state" && packed="$(realpath "$2")"
configs="$(git -C "$root" ls-tree --name-only "$commit" configs)"  # which older commits lack
git -C "$root" archive --format=tar.gz -o "$packed/source.tar.gz" "$commit" -- \
  setup.py pyproject.toml README.md LICENSE csrc gsim3d tools $configs \
  ':!gsim3d/pretrained/*/**' ':!tools/bench' ':!tools/release/state'
echo "$commit" >"$packed/commit"
git -C "$root" show "$commit:tools/release/start.sh" >"$packed/start.sh"
if [ $# -ge 3 ]; then cp "$3"/*.state.safetensors "$packed/state/"; fi
size="$(stat -c %s "$packed/source.tar.gz")"
echo "$packed/source.tar.gz: $((size / 1024)) KiB of $commit"
[ "$size" -le $((8 << 20)) ] || { echo "source.tar.gz is over 8 MiB" >&2; exit 1; }
[ $# -ge 4 ] || exit 0
work="$(mktemp -d)" && trap 'rm -rf "$work"' EXIT
tar -xzf "$packed/source.tar.gz" -C "$work" && mkdir -p "$packed/build" && cd "$work"
[ ! -x /usr/bin/g++ ] || export CXX="${CXX:-/usr/bin/g++}" CC="${CC:-/usr/bin/gcc}"
[ ! -d /usr/local/cuda ] || export CUDA_HOME="${CUDA_HOME:-/usr/local/cuda}"
export GSIM3D_CUDA=1 TORCH_CUDA_ARCH_LIST="${TORCH_CUDA_ARCH_LIST:-9.0a}"
# As start.sh does.
sources="$(find csrc setup.py -type f -print0 | LC_ALL=C sort -z | xargs -0 cat | sha256sum | cut -d ' ' -f 1)"
"$4" setup.py -q build_ext --inplace
strip --strip-debug gsim3d/*.so
for file in gsim3d/*.so; do xz -T0 -c "$file" >"$packed/build/$(basename "$file").xz"; done
echo "$sources" >"$packed/build/sources"

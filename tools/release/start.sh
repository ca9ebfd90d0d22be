#!/usr/bin/env bash
# Unpacks what pack.sh packed, builds it and trains; to be started where the run may outlive the shell:
#
#   setsid bash DIR/start.sh DIR WORK [options of tools/release/train.py] >WORK.log 2>&1 &
#
# WORK/out holds the state and its video at any time. --state, --out, --device and --commit are set here. Several runs
# share a host with CUDA_VISIBLE_DEVICES, taskset and a WORK each. A build that another run left in DIR/build (made by
# this script in WORK/build) is used if it is of the same sources; torch 2.11 runs what a later one has built.
set -euo pipefail
[ $# -ge 3 ] || { echo "usage: bash start.sh DIR WORK WORLD --minutes M [options]" >&2; exit 2; }
packed="$(realpath "$1")" && mkdir -p "$2" && work="$(realpath "$2")" && shift 2
mkdir -p "$work/code" "$work/out" "$work/build"
tar -xzf "$packed/source.tar.gz" -C "$work/code"
cp "$packed"/state/*.safetensors "$work/out/" 2>/dev/null || true
if compgen -G "$packed/wheels/*.whl" >/dev/null; then
  python3 -m pip install -q --no-index --no-deps --no-compile --target "$work/site" "$packed"/wheels/*.whl
  export PYTHONPATH="$work/site"
fi
cd "$work/code"
[ ! -x /usr/bin/g++ ] || export CXX="${CXX:-/usr/bin/g++}" CC="${CC:-/usr/bin/gcc}"  # it has a shared libstdc++
sources="$(find csrc setup.py -type f -print0 | LC_ALL=C sort -z | xargs -0 cat | sha256sum | cut -d ' ' -f 1)"
if [ "$(cat "$packed/build/sources" 2>/dev/null)" = "$sources" ]; then
  for file in "$packed"/build/*.so.xz; do xz -dc "$file" >"gsim3d/$(basename "${file%.xz}")"; done
else
  GSIM3D_CUDA=1 python3 setup.py -q build_ext --inplace
  strip --strip-debug gsim3d/*.so
  for file in gsim3d/*.so; do xz -T0 -c "$file" >"$work/build/$(basename "$file").xz"; done
  echo "$sources" >"$work/build/sources"
fi
gpus="$(python3 -c 'import torch; print(torch.cuda.device_count())')"
command=(python3 -u)
[ "$gpus" -le 1 ] || command=(torchrun --standalone --nproc-per-node "$gpus")
exec "${command[@]}" tools/release/train.py "$@" \
  --state "$work/out" --out "$work/out" --device cuda --commit "$(cat "$packed/commit")"

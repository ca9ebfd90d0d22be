#!/usr/bin/env bash
# The whole CUDA gate: build, tests, sanitizer, benchmarks.
#
#   tools/gpu_check.sh all                  everything, in this order
#   tools/gpu_check.sh build                the extension with its CUDA kernels, in place
#   tools/gpu_check.sh test                 the tests that use the GPU; tools/test.sh has the others
#   tools/gpu_check.sh sanitize             compute-sanitizer (memcheck, racecheck) on the tests of the ops
#   tools/gpu_check.sh bench                every op and the whole model against its peers: tools/bench/results/*.jsonl
#
# A step that passed on these sources is not repeated: started again, the check goes on where it stopped (remove
# build/gpu_check to start over). Uses `python3`, or $PYTHON; needs torch with CUDA, nvcc, pytest; works without a
# network.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
PYTHON="${PYTHON:-python3}"
STATE=build/gpu_check
OPS=(curve sparse_conv patch_attn pool row_norm plane_sweep raster decode background)

say() { printf '\033[1m%s\033[0m\n' "$*" >&2; }
die() { say "$*"; exit 1; }
usage() { sed -n '2,12s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; }

# What a result holds for: sources, tests, torch and the GPU.
key() {
  { find setup.py csrc gsim3d tests tools -type f -not -name '*.so' -not -name '*.pyc' -not -name '*.jsonl' -print0 |
      sort -z | xargs -0 cat; echo "$MACHINE"; } | cksum | cut -d ' ' -f 1
}

# step NAME COMMAND...: runs it once for these sources, with its output in $STATE/NAME.log.
step() {
  local name="$1" started=$SECONDS
  shift
  if [ "$(cat "$STATE/$name.done" 2>/dev/null)" = "$KEY" ]; then
    say "$name: passed before"
    return 0
  fi
  if "$@" >"$STATE/$name.log" 2>&1; then
    echo "$KEY" >"$STATE/$name.done"
    say "$name: passed in $((SECONDS - started)) s; $(tail -n 1 "$STATE/$name.log")"
  else
    say "$name: FAILED after $((SECONDS - started)) s; the end of $STATE/$name.log:"
    tail -n 40 "$STATE/$name.log" >&2
    return 1
  fi
}

compile() {
  # A GCC without a shared libstdc++ cannot build an extension whose errors reach Python.
  if [[ "$("${CXX:-c++}" -print-file-name=libstdc++.so 2>/dev/null)" != /* ]] && [ -x /usr/bin/g++ ]; then
    export CXX=/usr/bin/g++ CC=/usr/bin/gcc
  fi
  MAX_JOBS="${MAX_JOBS:-$(nproc)}" GSIM3D_CUDA=1 "$PYTHON" setup.py build_ext --inplace
}

# Tests run side by side where pytest-xdist is installed; they share the GPU.
tests() {
  local parallel=()
  "$PYTHON" -c 'import xdist' 2>/dev/null && parallel=(-n "$(($(nproc) < 14 ? $(nproc) : 14))" --dist load)
  # What the hard cases measured: python tools/stability.py --add FILE puts it into docs/stability.md.
  GSIM3D_REQUIRE_CUDA=1 GSIM3D_STABILITY_JSON="$STATE/stability.json" OMP_NUM_THREADS=1 \
    "$PYTHON" -m pytest -q "${parallel[@]}" tests/stability tests -m "gpu and not slow"
}

sanitize() {
  local tool="$1" file="$2"
  # Without torch's memory pool every tensor is an allocation that the tool watches; a graph cannot be captured so.
  # It slows kernels a hundred times, so that it sees our kernels alone, and some cases of every test.
  GSIM3D_FEW=3 GSIM3D_REQUIRE_CUDA=1 PYTORCH_NO_CUDA_MEMORY_CACHING=1 OMP_NUM_THREADS=1 \
    compute-sanitizer --tool "$tool" --kernel-name kns=gsim3d --kernel-name kns=3cub --error-exitcode 9 \
    "$PYTHON" -m pytest -q -p no:cacheprovider "$file" -m gpu -k "not compile and not graph and not opcheck"
}

run_build() { step build compile; }
run_test() { step test tests; }
run_sanitize() {
  command -v compute-sanitizer >/dev/null || die "compute-sanitizer was not found: it comes with the CUDA toolkit"
  local failed=0 tool file name
  # Few at a time, for they wait for one GPU; the longest first.
  for file in $(ls -S tests/ops/test_*.py); do
    for tool in memcheck racecheck; do
      while [ "$(jobs -rp | wc -l)" -ge 14 ]; do wait -n; done
      step "${tool}_$(basename "$file" .py)" sanitize "$tool" "$file" &
    done
  done
  wait
  for file in tests/ops/test_*.py; do
    for tool in memcheck racecheck; do
      name="${tool}_$(basename "$file" .py)"
      [ "$(cat "$STATE/$name.done" 2>/dev/null)" = "$KEY" ] || failed=1
    done
  done
  return $failed
}
run_bench() {
  local failed=0 file
  for file in "${OPS[@]}" end_to_end stability sleeping effects training; do
    [ -f "tools/bench/$file.py" ] || continue
    step "bench_$file" "$PYTHON" "tools/bench/$file.py" --device cuda || failed=1
    cat "$STATE/bench_$file.log"
  done
  return $failed
}

phase="${1:-}"
case "$phase" in
  build | test | sanitize | bench | all) ;;
  -h | --help) usage; exit 0 ;;
  *) usage >&2; exit 2 ;;
esac
MACHINE="$("$PYTHON" -c 'import torch; print(torch.__version__, torch.cuda.get_device_name())' 2>/dev/null)" ||
  die "$PYTHON has no torch that sees a GPU: activate one, or set PYTHON"
command -v nvcc >/dev/null || [ -n "${CUDA_HOME:-}" ] ||
  die "nvcc was not found: install the CUDA toolkit, or set CUDA_HOME"
mkdir -p "$STATE"
export PYTHONPATH="$PWD${PYTHONPATH:+:$PYTHONPATH}"
KEY="$(key)"
say "$MACHINE, $(nproc) cores"
run_build || exit 1
[ "$phase" = build ] && exit 0
result=0
for part in test sanitize bench; do
  if [ "$phase" = "$part" ] || [ "$phase" = all ]; then "run_$part" || result=1; fi
done
[ $result = 0 ] && say "gpu_check $phase: all passed" || say "gpu_check $phase: something failed, see above"
exit $result

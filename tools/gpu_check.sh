#!/usr/bin/env bash
# The whole CUDA gate: build, tests, sanitizer, benchmarks.
#
#   tools/gpu_check.sh all                  everything, in this order
#   tools/gpu_check.sh build                the extension with its CUDA kernels, in place
#   tools/gpu_check.sh test                 the tests that use the GPU; tools/test.sh has the others
#   tools/gpu_check.sh sanitize             compute-sanitizer (memcheck, racecheck) on the tests of the ops, on all GPUs
#   tools/gpu_check.sh bench                every op and the whole model against its peers: tools/bench/results
#
# A step that passed on these sources is not repeated: started again, the check goes on where it stopped (remove
# build/gpu_check to start over). Its last line names what passed, failed and was not run. Uses `python3`, or $PYTHON;
# needs torch with CUDA, nvcc, pytest; works without a network.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
PYTHON="${PYTHON:-python3}"
STATE=build/gpu_check
OPS=(curve sparse_conv patch_attn pool row_norm plane_sweep raster decode background springs projection)
# Tests whose checks take longest come first, longest first, in so many parts: racecheck of all of them, then memcheck.
LONG=(raster:3:1 sparse_conv:6:2 raster_edges:4:2 pyramid:3:2 joint_attention:2:1 unchecked_lists:4:2
  pyramid_capacity:2:2 patch_attn_cuda:2:1 patch_attn:2:1 background:1:1 plane_sweep:2:1)

say() { printf '\033[1m%s\033[0m\n' "$*" >&2; }
die() { say "$*"; exit 1; }
usage() { sed -n '2,13s/^# \{0,1\}//p' "${BASH_SOURCE[0]}"; }

# What a result holds for: sources, tests, torch and the GPU. Benchmarks write their results among them.
key() {
  { find setup.py csrc gsim3d tests tools \( -name __pycache__ -o -path tools/bench/results \) -prune -o \
      -type f -not -name '*.so' -print0 | sort -z | xargs -0 cat; echo "$MACHINE"; } | cksum | cut -d ' ' -f 1
}

# step NAME COMMAND...: runs it once for these sources, with its output in $STATE/NAME.log.
step() {
  local name="$1" started=$SECONDS code
  shift
  if is_now "$name" done; then
    say "$name: passed before"
    return 0
  fi
  rm -f "$STATE/$name.failed"
  "$@" >"$STATE/$name.log" 2>&1
  code=$?
  case $code in
    0)
      echo "$KEY" >"$STATE/$name.done"
      say "$name: passed in $((SECONDS - started)) s; $(tail -n 1 "$STATE/$name.log")" ;;
    130 | 143) say "$name: stopped after $((SECONDS - started)) s" ;;  # by SIGINT, SIGTERM
    *)
      echo "$KEY" >"$STATE/$name.failed"
      say "$name: FAILED after $((SECONDS - started)) s; the end of $STATE/$name.log:"
      tail -n 40 "$STATE/$name.log" >&2 ;;
  esac
  return $code
}

# is_now NAME done|failed: whether NAME did so on these sources.
is_now() { [ "$(cat "$STATE/$1.$2" 2>/dev/null)" = "$KEY" ]; }

# The steps of a phase behind the build, one a line.
steps_of() {
  local name phase
  case "$1" in
    test) echo test ;;
    sanitize) sanitized | cut -d ' ' -f 1 ;;
    bench) for name in "${OPS[@]}" end_to_end stability sleeping effects training; do echo "bench_$name"; done ;;
    all) for phase in test sanitize bench; do steps_of "$phase"; done ;;
  esac
}

# The last line; its status is 0 where all passed.
summary() {
  local name passed=0 failed="" missing=""
  for name in build $(steps_of "$1"); do
    if is_now "$name" done; then passed=$((passed + 1))
    elif is_now "$name" failed; then failed+=" $name"
    else missing+=" $name"; fi
  done
  say "gpu_check $1: $passed passed; failed:${failed:- none}; not run:${missing:- none}"
  [ -z "$failed$missing" ]
}

compile() {
  # A GCC without a shared libstdc++ cannot build an extension whose errors reach Python.
  if [[ "$("${CXX:-c++}" -print-file-name=libstdc++.so 2>/dev/null)" != /* ]] && [ -x /usr/bin/g++ ]; then
    export CXX=/usr/bin/g++ CC=/usr/bin/gcc
  fi
  MAX_JOBS="${MAX_JOBS:-$(nproc)}" GSIM3D_CUDA=1 "$PYTHON" setup.py build_ext --inplace
}

at_once() { local most=$((14 * ${1:-1})); echo "$(($(nproc) < most ? $(nproc) : most))"; }  # so many share a GPU
devices() {
  if [ -n "${CUDA_VISIBLE_DEVICES:-}" ]; then tr , '\n' <<<"$CUDA_VISIBLE_DEVICES"
  else nvidia-smi --query-gpu=index --format=csv,noheader 2>/dev/null || echo 0; fi
}

# Tests run side by side where pytest-xdist is installed.
tests() {
  local parallel=()
  "$PYTHON" -c 'import xdist' 2>/dev/null && parallel=(-n "$(at_once)" --dist load)
  # What the hard cases measured: python tools/stability.py --add FILE puts it into docs/results/stability.json.
  GSIM3D_REQUIRE_CUDA=1 GSIM3D_STABILITY_JSON="$STATE/stability.json" OMP_NUM_THREADS=1 \
    "$PYTHON" -m pytest -q "${parallel[@]}" tests/stability tests -m "gpu and not slow"
}

# The sanitizer's steps in their order, one a line: NAME TOOL FILE PART.
sanitized() {
  local long name race memory file
  for long in "${LONG[@]}"; do
    IFS=: read -r name race memory <<<"$long"
    parts racecheck "$name" "$race"
  done
  for long in "${LONG[@]}"; do
    IFS=: read -r name race memory <<<"$long"
    parts memcheck "$name" "$memory"
  done
  for file in tests/ops/test_*.py; do
    name="${file##*/test_}"
    name="${name%.py}"
    [[ " ${LONG[*]}" == *" $name:"* ]] || ! grep -qwE '^def.*(device|devices|gpus)' "$file" && continue
    parts racecheck "$name" 1
    parts memcheck "$name" 1
  done
}
parts() {
  local tool="$1" name="$2" count="$3" part
  for ((part = 0; part < count; part++)); do
    echo "${tool}_test_$name$([ "$count" = 1 ] || echo "_$part") $tool tests/ops/test_$name.py $part/$count"
  done
}

sanitize() {
  local tool="$1" file="$2" part="$3" wanted="gpu and not unsanitized"
  [ "$tool" = racecheck ] && wanted+=" and not unraced"
  # Without torch's memory pool every tensor is an allocation that the tool watches; a graph cannot be captured so.
  # It slows kernels a hundred times, so that it sees our kernels alone, and some cases of every test.
  GSIM3D_FEW=3 GSIM3D_PART="$part" GSIM3D_REQUIRE_CUDA=1 PYTORCH_NO_CUDA_MEMORY_CACHING=1 OMP_NUM_THREADS=1 \
    compute-sanitizer --tool "$tool" --kernel-name kns=gsim3d --kernel-name kns=3cub --error-exitcode 9 \
    "$PYTHON" -m pytest -v -p no:cacheprovider --durations 10 "$file" -m "$wanted" \
    -k "not compile and not graph and not opcheck"
}

run_build() { step build compile; }
run_test() { step test tests; }
run_sanitize() {
  command -v compute-sanitizer >/dev/null || die "compute-sanitizer was not found: it comes with the CUDA toolkit"
  local name tool file part gpus gpu most n_running=0 turn=0
  mapfile -t gpus < <(devices)
  most="$(at_once "${#gpus[@]}")"
  set -m  # a group of processes for each job: what stops this script can stop them
  while read -r name tool file part; do
    # No $( ) here: bash 5.2 cannot run a trap while it parses one.
    if ((n_running == most)); then wait -n; else n_running=$((n_running + 1)); fi
    gpu="${gpus[turn++ % ${#gpus[@]}]}"
    CUDA_VISIBLE_DEVICES="$gpu" step "$name" sanitize "$tool" "$file" "$part" </dev/null &
  done < <(sanitized)
  wait
  set +m
}
run_bench() {
  local name options
  for name in $(steps_of bench); do
    options=(--device cuda)
    case "$name" in
      bench_stability | bench_effects) ;;
      bench_training) options+=(--warm-up 1) ;;
      *) options+=(--seconds 0.5) ;;  # a side: the phase is to take less than 8 minutes
    esac
    step "$name" "$PYTHON" "tools/bench/${name#bench_}.py" "${options[@]}"
    cat "$STATE/$name.log"
  done
}

stop() {
  local group
  trap '' INT TERM  # a second signal would begin again
  for _ in 1 2 3 4 5; do  # a job that was just begun may miss the first
    for group in $(jobs -rp); do kill -- "-$group" 2>/dev/null; done
    [ -n "$(jobs -rp)" ] || break
    sleep 0.2
  done
  summary "$PHASE"
  exit 143
}

PHASE="${1:-}"
case "$PHASE" in
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
trap stop INT TERM
if run_build; then
  for phase in test sanitize bench; do
    if [ "$PHASE" = "$phase" ] || [ "$PHASE" = all ]; then "run_$phase"; fi
  done
fi
summary "$PHASE"

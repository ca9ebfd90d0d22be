# Sourced by demo.sh and test.sh: leaves an environment in which `python` runs gsim3d from this repository.
# Uses the active virtual environment, else makes .venv; installs what is missing; builds the extension when it changed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
TORCH_VERSION="2.13.0"  # the tested version; an installed torch 2.11 or later is kept

say() { printf '\033[1m%s\033[0m\n' "$*" >&2; }

if [ -z "${VIRTUAL_ENV:-}" ]; then
  if [ ! -x .venv/bin/python ]; then
    found=""
    for candidate in python3.12 python3.11 python3.13 python3 python; do
      if "$candidate" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null; then
        found="$candidate"
        break
      fi
    done
    [ -n "$found" ] || { say "gsim3d needs Python 3.11, 3.12 or 3.13; none was found"; exit 1; }
    say "Making .venv with $("$found" --version)"
    # A half-made environment must not be taken for a whole one at the next start.
    rm -rf .venv && "$found" -m venv .venv || { rm -rf .venv; exit 1; }
  fi
  # shellcheck disable=SC1091
  source .venv/bin/activate
fi
command -v c++ >/dev/null 2>&1 || command -v g++ >/dev/null 2>&1 || {
  say "A C++20 compiler is needed (Debian, Ubuntu: apt install g++; macOS: xcode-select --install)"; exit 1; }

stamp="$VIRTUAL_ENV/.gsim3d-$(printf '%s' "$PWD" | cksum | cut -d ' ' -f 1)"
# Everything the build depends on; a change of any of it makes a new build, anything else starts at once.
state() {
  { python -c 'import sys, importlib.metadata as m; print(sys.version, m.version("torch"))'
    find setup.py pyproject.toml csrc -type f -print0 | sort -z | xargs -0 cat; } 2>/dev/null | cksum
}
if ! compgen -G "gsim3d/_ops*.so" >/dev/null || [ ! -f "$stamp" ] || [ "$(cat "$stamp")" != "$(state)" ]; then
  if ! python -c 'import torch' 2>/dev/null; then
    say "Installing torch $TORCH_VERSION"
    # The CPU build where one is offered; the plain index otherwise.
    if [ "$(uname -s)" = Linux ] && ! command -v nvidia-smi >/dev/null 2>&1; then
      pip install -q "torch==$TORCH_VERSION+cpu" 2>/dev/null || pip install -q "torch==$TORCH_VERSION"
    else
      pip install -q "torch==$TORCH_VERSION"
    fi
  fi
  say "Installing gsim3d and building its extension (about two minutes the first time)"
  pip install -q ninja 'pybind11>=3.0' 'setuptools>=77' wheel
  log="$(mktemp)"
  if ! pip install -q --no-build-isolation -e '.[dev]' >"$log" 2>&1; then
    tail -n 60 "$log" >&2
    say "The installation failed; the last lines are above"
    exit 1
  fi
  rm -f "$log"
  state >"$stamp"
fi

#!/usr/bin/env bash
# Runs the tests: tools/test.sh (under 15 minutes on 2 cores), tools/test.sh --full (adds the slow ones).
# Other arguments go to pytest.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
select=(-m "not slow")
if [ "${1:-}" = "--full" ]; then
  select=()
  shift
fi
# Side by side, a thread each: on tensors as small as those of most tests threads wait for each other.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
exec python -m pytest -n auto --maxprocesses 8 --dist worksteal "${select[@]}" "$@"

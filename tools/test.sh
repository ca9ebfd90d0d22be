#!/usr/bin/env bash
# Runs the tests: tools/test.sh (under 15 minutes on 2 cores), tools/test.sh --full (adds the slow ones).
# Other arguments go to pytest.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
select=(-m "not slow")
if [ "${1:-}" = "--full" ]; then
  select=()
  shift
fi
exec python -m pytest "${select[@]}" "$@"

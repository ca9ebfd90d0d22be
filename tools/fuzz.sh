#!/usr/bin/env bash
# Feeds damaged files to every reader, 100,000 each: days on one core. Stopped and started again, it goes on.
#   tools/fuzz.sh [TARGET ...] [--count N] [--campaign DIR]     default: every reader, 100000, runs/fuzz
# Prints each round, and all totals at the end; the exit code is 1 where an input failed.
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh"
exec nice python -m tests.stability.fuzz --campaign runs/fuzz --count 100000 "$@"

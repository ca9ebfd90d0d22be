"""See the package's docstring."""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.stability.fuzz import __doc__ as description
from tests.stability.fuzz.engine import replay, run, targets


def main() -> int:
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET", help="default: all of the CPU")
    parser.add_argument("--count", type=int, default=2000, help="inputs of each target (default 2000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for failing inputs (default: a temporary one)")
    parser.add_argument("--replay", type=Path, metavar="FAILURE", help="run a kept input again and show what happens")
    parser.add_argument("--list", action="store_true", help="print the names of the targets")
    args = parser.parse_args()
    known = [name for name, target in targets().items() if not name.startswith("_") and not target.on_gpu]
    if args.list:
        print("\n".join(name for name in targets() if not name.startswith("_")))
        return 0
    if args.replay:
        answer, problem = replay(args.replay)
        print(f"{answer}: {problem or 'an answer'}")
        return 1 if problem else 0
    out = args.out or Path(tempfile.mkdtemp(prefix="fuzz-"))
    outcomes = run(args.targets or known, args.count, args.seed, out)
    print("\n".join(map(str, outcomes)))
    return 1 if any(outcome.failures for outcome in outcomes) else 0


sys.exit(main())

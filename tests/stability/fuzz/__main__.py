"""See the package's docstring."""

import argparse
import sys
import tempfile
from pathlib import Path

from tests.stability.fuzz import __doc__ as description
from tests.stability.fuzz.campaign import campaign
from tests.stability.fuzz.engine import GROUPS, PATIENCE, chosen, replay, run, targets


def main() -> int:
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "targets",
        nargs="*",
        metavar="TARGET",
        help=f"or a group of them: {', '.join(GROUPS)}; default: all of the CPU (readers)",
    )
    parser.add_argument("--count", type=int, default=2000, help="inputs of each target (default 2000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--patience", type=float, default=PATIENCE, help="seconds for an input (default %(default)s)")
    parser.add_argument("--out", type=Path, help="folder for failing inputs (default: a temporary one)")
    parser.add_argument("--campaign", type=Path, metavar="DIR", help="in rounds, with totals in DIR; goes on there")
    parser.add_argument("--replay", type=Path, metavar="FAILURE", help="run a kept input again and show what happens")
    parser.add_argument("--list", action="store_true", help="print the names of the targets")
    args = parser.parse_args()
    if args.list:
        print("\n".join(name for name in targets() if not name.startswith("_")))
        return 0
    if args.replay:
        answer, problem = replay(args.replay)
        print(f"{answer}: {problem or 'an answer'}")
        return 1 if problem else 0
    names = chosen(args.targets or (["readers"] if args.campaign else GROUPS))
    if unknown := sorted(set(names) - set(targets())):
        parser.error(f"no such targets: {', '.join(unknown)} (see --list)")
    if args.campaign:
        return 0 if campaign(names, args.count, args.campaign, args.patience) else 1
    out, failed = args.out or Path(tempfile.mkdtemp(prefix="fuzz-")), False
    for name in names:
        (outcome,) = run([name], args.count, args.seed, out, args.patience)
        print(outcome, flush=True)
        failed |= bool(outcome.failures)
    return 1 if failed else 0


sys.exit(main())

#!/usr/bin/env python
"""Do the tests notice a wrong kernel, or a guard that is gone? Changes one place at a time and runs the test for it.

    python tools/mutants.py                 all mutants of tests/mutants/*.json
    python tools/mutants.py raster pool     those of some ops
    python tools/mutants.py guards          guards of hard cases in Python: nothing is compiled (guards_core: in C++)
    python tools/mutants.py --list

Each mutant is {"file", "old", "new", "test"}: `old` must occur exactly once in `file`; `test` is a pytest node. The
work is done in a copy of the repository, so the tree and its build are left alone. Prints one line a mutant; exit code
1 if any survives.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def load(ops: list[str]) -> list[dict]:
    files = sorted((ROOT / "tests" / "mutants").glob("*.json"))
    unknown = set(ops) - {file.stem for file in files}
    if unknown:
        sys.exit(f"no mutants for {', '.join(sorted(unknown))}; there are {', '.join(file.stem for file in files)}")
    return [{"op": f.stem, **mutant} for f in files if not ops or f.stem in ops for mutant in json.loads(f.read_text())]


def run(command: list[str], cwd: Path) -> subprocess.CompletedProcess:
    env = {**os.environ, "PYTHONPATH": str(cwd), "MAX_JOBS": "2"}
    return subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True)


def build(tree: Path) -> bool:
    return run([sys.executable, "setup.py", "-q", "build_ext", "--inplace"], tree).returncode == 0


def pytest(tree: Path, tests: list[str]) -> subprocess.CompletedProcess:
    return run([sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests], tree)


def judge(tree: Path, mutant: dict) -> str:
    """'killed', or why the mutant counts as surviving."""
    path = tree / mutant["file"]
    text = path.read_text()
    if text.count(mutant["old"]) != 1:
        return f"`old` occurs {text.count(mutant['old'])} times"
    path.write_text(text.replace(mutant["old"], mutant["new"]))
    try:
        if path.suffix != ".py" and not build(tree):
            return "does not compile"
        code = pytest(tree, [mutant["test"]]).returncode
        # 1: a test failed. Anything else (0 passed, 2-5 no such test, ...) proves nothing; a crash is a negative code.
        return "killed" if code == 1 or code < 0 else f"survives (pytest exit code {code})"
    finally:
        path.write_text(text)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ops", nargs="*", help="files of tests/mutants; default: all")
    parser.add_argument("--list", action="store_true", help="print the mutants and stop")
    args = parser.parse_args()
    mutants = load(args.ops)
    if args.list:
        for mutant in mutants:
            print(f"{mutant['op']:<12} {mutant['old'].strip()}  ->  {mutant['new'].strip()}  [{mutant['test']}]")
        return 0
    survivors = 0
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "gsim3d"
        ignore = shutil.ignore_patterns(".git", ".venv", "runs", "__pycache__")
        shutil.copytree(ROOT, tree, ignore=ignore, symlinks=True)
        tests = sorted({mutant["test"] for mutant in mutants})
        if not build(tree) or (done := pytest(tree, tests)).returncode != 0:
            print("the tests must pass on the unchanged tree first", file=sys.stderr)
            print(done.stdout[-2000:] if "done" in locals() else "", file=sys.stderr)
            return 1
        for number, mutant in enumerate(mutants, 1):
            verdict = judge(tree, mutant)
            survivors += verdict != "killed"
            print(
                f"{number:>3}/{len(mutants)} {mutant['op']:<12} {verdict:<10} {mutant['old'].strip()[:60]}",
                f" [{mutant['test']}]",
                flush=True,
            )
    print(f"{len(mutants) - survivors} killed, {survivors} survived")
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())

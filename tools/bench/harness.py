"""What the benchmarks of the ops share: check first, then time gsim3d and plain torch in turns and print both.

    bench = Bench("pool")                                        # reads the command line: --json, --threads, --seconds
    bench.compare("64k rows", ours, plain)                       # callables without arguments; results must agree
    bench.compare("64k rows, fwd+bwd", *with_gradients(inputs, ours_of, plain_of))
    bench.finish()

Numbers are medians, "best" is the fastest round; the spread is the distance between the quartiles as a part of the
median. The two sides take turns, so that a busy machine slows both.
"""

import argparse
import json
import platform
import statistics
import time
from pathlib import Path

import torch
from torch import Tensor

MIN_ROUNDS, MAX_ROUNDS = 5, 200


def tensors_of(result) -> list[Tensor]:
    return [result] if isinstance(result, Tensor) else [t for part in result for t in tensors_of(part)]


def worst_error(ours, plain) -> float:
    """Largest error of any output, relative to that output's largest value; integers must be equal."""
    ours, plain = tensors_of(ours), tensors_of(plain)
    if len(ours) != len(plain):
        raise AssertionError(f"gsim3d gives {len(ours)} tensors, torch {len(plain)}")
    worst = 0.0
    for a, b in zip(ours, plain):
        if a.shape != b.shape:
            raise AssertionError(f"gsim3d gives shape {tuple(a.shape)}, torch {tuple(b.shape)}")
        if not a.is_floating_point():
            worst = max(worst, 0.0 if torch.equal(a, b) else float("inf"))
        elif a.numel():
            error = (a.double() - b.double()).abs().max() / b.double().abs().max().clamp_min(1e-30)
            worst = max(worst, float(error.nan_to_num(float("inf"))))
    return worst


def with_gradients(inputs: list[Tensor], *functions):
    """For each function of ``inputs`` a callable that runs it and its gradients to every floating-point input."""
    leaves = [x.detach().clone().requires_grad_() if x.is_floating_point() else x for x in inputs]
    wanted = [x for x in leaves if x.requires_grad]
    with torch.no_grad():
        cotangent = torch.randn(functions[0](*inputs).shape, generator=torch.Generator().manual_seed(0))

    def both(f):
        def run():
            out = f(*leaves)
            return [out.detach(), *torch.autograd.grad(out, wanted, cotangent)]

        return run

    return tuple(both(f) for f in functions)


def summary(seconds: list[float]) -> dict:
    low, median, high = statistics.quantiles(seconds, n=4, method="inclusive")
    return {"ms": 1e3 * median, "best_ms": 1e3 * min(seconds), "spread": (high - low) / median, "rounds": len(seconds)}


class Bench:
    def __init__(self, op: str):
        parser = argparse.ArgumentParser(description=f"gsim3d's {op} against plain torch on the CPU")
        parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results here")
        parser.add_argument("--threads", type=int, default=2)
        parser.add_argument("--seconds", type=float, default=1.0, help="time for each side of a comparison")
        self.args = parser.parse_args()
        self.op, self.results = op, []
        torch.set_num_threads(self.args.threads)
        print(f"{op}: {platform.machine()}, torch {torch.__version__}, {self.args.threads} threads")
        columns = f"{'gsim3d ms':>11}{'best':>10}{'torch ms':>11}{'best':>10}"
        print(f"{'case':<44}{columns}{'faster':>9}{'spread':>8}{'error':>9}")

    def compare(self, case: str, ours, plain, *, tolerance: float = 1e-5) -> dict:
        """Fails when the results differ by more than ``tolerance`` of the largest value; then times both in turns."""
        error = worst_error(ours(), plain())
        if not error <= tolerance:
            raise AssertionError(f"{self.op}, {case}: results differ by {error:.1e} of the largest value")
        times: tuple[list[float], list[float]] = ([], [])
        spent = 0.0
        while len(times[0]) < MIN_ROUNDS or (spent < 2 * self.args.seconds and len(times[0]) < MAX_ROUNDS):
            for f, to in ((ours, times[0]), (plain, times[1])):
                start = time.perf_counter()
                f()
                to.append(time.perf_counter() - start)
                spent += to[-1]
        a, b = (summary(side) for side in times)
        result = {"case": case, "gsim3d": a, "torch": b, "faster": b["ms"] / a["ms"], "error": error}
        spread = max(a["spread"], b["spread"])
        columns = "".join(f"{side['ms']:>11.3f}{side['best_ms']:>10.3f}" for side in (a, b))
        print(f"{case:<44}{columns}{result['faster']:>8.1f}x{spread:>8.0%}{error:>9.1e}", flush=True)
        self.results.append(result)
        return result

    def finish(self) -> None:
        if self.args.json:
            record = {"op": self.op, "threads": self.args.threads, "torch": torch.__version__, "results": self.results}
            self.args.json.write_text(json.dumps(record, indent=1) + "\n")

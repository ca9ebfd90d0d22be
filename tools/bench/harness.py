"""What the benchmarks of the ops share: check first, then time gsim3d and its peer in turns and print both.

    bench = Bench("pool")                                # reads the command line (--help)
    bench.compare("64k rows", ours, plain)               # CPU: callables without arguments; results must agree
    bench.passes("64k rows", inputs, ours_of, {"torch": plain_of})   # both devices: forward, forward and backward
    bench.gpu("64k rows", "float32", ours, {"torch": plain}, target_ratio=5, limit_ms=0.04)      # --device cuda
    bench.cost("sleep", with_it, without_it, limit=1.05)    # either device: what one form of a call costs over another
    bench.finish()

Numbers are medians, "best" is the fastest round; the spread is the distance between the quartiles as a part of the
median. The two sides take turns, so that a busy machine slows both. On a GPU a number is the time between two events
around one call as a program makes it, Python and launches included; beside it stands the time of the same call replayed
from a CUDA graph, where it can be captured.
"""

import argparse
import datetime
import json
import platform
import statistics
import subprocess
import time
from pathlib import Path

import torch
from torch import Tensor

MIN_ROUNDS, MAX_ROUNDS = 5, 200
PAIRS, MAX_PAIRS = 15, 400  # of timings of a cost; more than 15 of what is fast
GPU_ROUNDS, REPLAYS = 20, 30  # or MIN_ROUNDS of what takes long
RESULTS = Path(__file__).parent / "results"  # one JSON line for each row measured on a GPU


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
        out = functions[0](*inputs)
        cotangent = torch.randn(out.shape, generator=torch.Generator().manual_seed(0)).to(out)

    def both(f):
        def run():
            out = f(*leaves)
            return [out.detach(), *torch.autograd.grad(out, wanted, cotangent)]

        return run

    return tuple(both(f) for f in functions)


def summary(seconds: list[float]) -> dict:
    low, median, high = statistics.quantiles(seconds, n=4, method="inclusive")
    return {"ms": 1e3 * median, "best_ms": 1e3 * min(seconds), "spread": (high - low) / median, "rounds": len(seconds)}


def commit() -> str:
    done = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], cwd=Path(__file__).parent, capture_output=True, text=True
    )
    return done.stdout.strip() or "unknown"


def event_ms(f) -> float:
    start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    f()
    end.record()
    end.synchronize()
    return start.elapsed_time(end)


def best_seconds(f, repeats: int = 3) -> float:
    """Of the fastest of a few calls."""
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        f()
        best = min(best, time.perf_counter() - start)
    return best


def processor_seconds(f) -> float:
    start = time.process_time()
    f()
    return time.process_time() - start


def graph_of(f):
    """f captured in a CUDA graph, or None where it cannot be (it waits for the device, say)."""
    try:
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            for _ in range(3):
                f()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            f()
        return graph.replay
    except RuntimeError:
        torch.cuda.synchronize()
        return None


class Bench:
    def __init__(self, op: str):
        parser = argparse.ArgumentParser(description=f"gsim3d's {op} against its peers")
        parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
        parser.add_argument("--json", type=Path, metavar="FILE", help="also write the results here")
        parser.add_argument("--threads", type=int, default=2)
        parser.add_argument("--seconds", type=float, default=1.0, help="time for each side of a comparison")
        self.args = parser.parse_args()
        self.op, self.results = op, []
        torch.set_num_threads(self.args.threads)
        self.device = torch.device(self.args.device)
        if self.args.device == "cuda":
            print(f"{op}: {torch.cuda.get_device_name()}, torch {torch.__version__}")
            names = ("gsim3d ms", "graph", "peer ms", "graph", "ratio", "target", "error")
            print(f"{'case':<52}" + "".join(f"{name:>{n}}" for name, n in zip(names, (10, 9, 10, 9, 8, 8, 9))))
            return
        print(f"{op}: {platform.machine()}, torch {torch.__version__}, {self.args.threads} threads")
        columns = f"{'gsim3d ms':>11}{'best':>10}{'torch ms':>11}{'best':>10}"
        print(f"{'case':<44}{columns}{'faster':>9}{'spread':>8}{'error':>9}")

    def compare(self, case: str, ours, plain, *, tolerance: float | None = 1e-5) -> dict:
        """Fails when the results differ by more than ``tolerance`` of the largest value; then times both in turns.
        ``tolerance`` None: the results are of different things."""
        error = 0.0 if tolerance is None else worst_error(ours(), plain())
        if not error <= (tolerance or 0.0):
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

    def passes(self, case: str, inputs: list[Tensor], ours, forms: dict, *, tolerance: float | None = 1e-5, ratio=None,
               limits_ms=(None, None)) -> None:  # fmt: skip
        """Compares the forward pass, and both passes, of functions of ``inputs``: on the CPU with the fastest of
        ``forms``, a function by name, on a GPU with each. ``limits_ms``: of the two rows."""
        runs = with_gradients(inputs, ours, *forms.values())
        for n, what in enumerate(("fwd", "fwd+bwd")):
            sides = [lambda f=f: f(*inputs) for f in (ours, *forms.values())] if n == 0 else runs
            with torch.set_grad_enabled(n > 0):
                if self.device.type == "cuda":
                    dtype, peers = str(inputs[0].dtype).removeprefix("torch."), dict(zip(forms, sides[1:]))
                    options = {"target_ratio": ratio, "limit_ms": limits_ms[n], "tolerance": tolerance}
                    self.gpu(f"{case}: {what}", dtype, sides[0], peers, **options)
                else:
                    self.compare(f"{case}: {what}", sides[0], min(sides[1:], key=best_seconds), tolerance=tolerance)

    def gpu(self, case: str, dtype: str, ours, peers: dict, *, target_ratio=None, limit_ms=None, tolerance=1e-5,
            capture=True, graphs: dict | None = None) -> None:  # fmt: skip
        """``peers``: name -> callable, the fastest counts, or the milliseconds once recorded of a peer that cannot run
        here; empty where there is none. ``tolerance`` bounds the error against each peer, relative to the largest
        value; None where the caller has compared the results by its own rule. ``capture``: also try a CUDA graph (a
        capture that fails leaves torch's random generator unusable). ``graphs``: instead, replays of those that the
        sides have already, "gsim3d" for ours."""
        recorded = {name: peer for name, peer in peers.items() if not callable(peer)}
        peers = {name: peer for name, peer in peers.items() if callable(peer)}
        error = None
        if tolerance is not None:
            for name, peer in peers.items():
                error = max(error or 0.0, worst_error(ours(), peer()))
                if not error <= tolerance:
                    raise AssertionError(f"{self.op}, {case}: differs from {name} by {error:.1e} of the largest value")
        sides = {"gsim3d": ours, **peers}
        times = {name: [] for name in sides}
        for f in sides.values():
            for _ in range(3):
                f()
        torch.cuda.synchronize()
        start, spent, allowed = time.perf_counter(), 0.0, self.args.seconds * len(sides)
        while len(times["gsim3d"]) < (GPU_ROUNDS if spent < 2 * allowed else MIN_ROUNDS) or (
            spent < allowed and len(times["gsim3d"]) < MAX_ROUNDS
        ):
            for name, f in sides.items():
                times[name].append(event_ms(f))
            spent = time.perf_counter() - start
        replays = graphs or {name: graph_of(f) if capture else None for name, f in sides.items()}
        graph_ms = {name: replay and self._replayed(replay) for name, replay in replays.items()}
        low, ours_ms, high = statistics.quantiles(times["gsim3d"], n=4, method="inclusive")
        medians = {name: statistics.median(values) for name, values in times.items() if name != "gsim3d"}
        medians |= recorded
        peer = min(medians, key=medians.get) if medians else None
        row = {
            "dtype": dtype, "ours_ms": ours_ms, "ours_graph_ms": graph_ms["gsim3d"], "peer": peer,
            "peer_ms": medians.get(peer), "peer_graph_ms": graph_ms.get(peer), "peers_ms": medians,
            "target_ratio": target_ratio, "limit_ms": limit_ms, "spread": (high - low) / ours_ms, "error": error,
        }  # fmt: skip
        cells = [ours_ms, graph_ms["gsim3d"], row["peer_ms"], row["peer_graph_ms"]]
        text = "".join(f"{'-' if v is None else format(v, '.3f'):>{w}}" for v, w in zip(cells, (10, 9, 10, 9)))
        ratio = "-" if peer is None else f"{row['peer_ms'] / ours_ms:.1f}x"
        wanted = "-" if target_ratio is None else f"{target_ratio:g}x"
        error_text = "-" if error is None else format(error, ".0e")
        print(f"{case + ' ' + dtype:<52}{text}{ratio:>8}{wanted:>8}{error_text:>9}", flush=True)
        self._store(case, row)

    def _replayed(self, replay) -> float:
        """Median milliseconds of a graph."""
        times: list[float] = []
        while len(times) < MIN_ROUNDS or (sum(times) < 1e3 * self.args.seconds and len(times) < REPLAYS):
            times.append(event_ms(replay))
        return statistics.median(times)

    def _store(self, case: str, row: dict) -> None:
        """Notes a row of a GPU, at once: a benchmark may be cut short."""
        made = {"gpu": torch.cuda.get_device_name(), "torch": torch.__version__, "commit": commit()}
        self.results.append({"op": self.op, "case": case, **row, **made, "date": datetime.date.today().isoformat()})
        file = self.args.json or RESULTS / f"{self.op}.jsonl"
        file.parent.mkdir(exist_ok=True)
        file.write_text("".join(json.dumps(row) + "\n" for row in self.results))

    def cost(self, case: str, run, plain, *, dtype="float32", tolerance: float | None = 0.0, limit=None) -> None:
        """What ``run`` costs over ``plain``, both sides in turns, one ahead and then the other; the cost is the median
        over pairs, between its quartiles. On the CPU of processor time on one thread, whatever else runs.

        Args:
            tolerance: of the results, which are compared twice; None: they are others.
            limit: wanted at most, times the time of ``plain``.
        """
        on_gpu = self.device.type == "cuda"
        for _ in range(2):
            results = run(), plain()
            error = 0.0 if tolerance is None else worst_error(*results)
            assert error <= (tolerance or 0.0), f"{self.op}, {case}: results differ by {error:.1e} of the largest value"
        torch.set_num_threads(1)
        times: dict = {run: [], plain: []}
        spent = 0.0
        while len(times[run]) < PAIRS or (spent < 2 * self.args.seconds and len(times[run]) < MAX_PAIRS):
            for f in (run, plain) if len(times[run]) % 2 else (plain, run):
                times[f].append(event_ms(f) / 1e3 if on_gpu else processor_seconds(f))
                spent += times[f][-1]
        torch.set_num_threads(self.args.threads)
        low, share, high = statistics.quantiles((a / b - 1 for a, b in zip(*times.values())), n=4, method="inclusive")
        a, b = summary(times[run]), summary(times[plain])
        print(f"{case:<52}{a['ms']:>10.3f}{b['ms']:>10.3f} cost {share:.2%} ({low:.2%} to {high:.2%})", flush=True)
        cost = {"cost": share, "quartiles": [low, high], "limit": limit}
        if on_gpu:
            self._store(case, {"dtype": dtype, "ours_ms": a["ms"], "peer_ms": b["ms"], "pairs": a["rounds"], **cost})
        else:
            self.results.append({"case": case, "gsim3d": a, "plain": b, **cost})

    def finish(self) -> None:
        if self.args.device == "cpu" and self.args.json:
            record = {"op": self.op, "threads": self.args.threads, "torch": torch.__version__, "results": self.results}
            self.args.json.write_text(json.dumps(record, indent=1) + "\n")

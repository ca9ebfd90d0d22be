"""Success of agents on PushToGoal: random, zero, and planners in MuJoCo and in a simulator, on 50 fixed seeds.

python tools/bench/push_planning.py [--agents zero random mppi cem model] [--model PATH] [--device cuda] [--seeds 50]
    [--out docs/results/push_planning.json]

Planners: K 64 sequences of H 8 actions, 3 iterations, replanned every 4 steps. Agent ``model`` is MPPI in the simulator
``--model``, which acts in MuJoCo: before each plan it encodes images of the last steps, with masks of the body and the
pusher, and the pusher's positions. Printed: solved episodes with the 95 % Wilson interval, the median of the last
distance to the goal, steps of solved episodes, seconds of encoding and of a plan, predicted steps a second, and for
``model`` the median error of the body's center at each of the H steps of its plans, and that of a resting body.
"""

import argparse
import json
import math
import os
import sys
import time
from collections import deque
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402

import gsim3d.envs  # noqa: E402, F401
from gsim3d import Simulator  # noqa: E402
from gsim3d.envs.model import ModelScenes, ModelState, Start  # noqa: E402
from gsim3d.envs.push import MAX_SPEED, PushToGoal  # noqa: E402
from gsim3d.envs.push_planning import GoalCost, ModelDynamics, TrueDynamics  # noqa: E402
from gsim3d.io.files import write_whole  # noqa: E402
from gsim3d.io.terminal import progress  # noqa: E402
from gsim3d.planning import CEM, MPPI, Plan  # noqa: E402

FIRST_SEED, FASTEST = 1000, torch.full((2,), MAX_SPEED, dtype=torch.float64)
EVERY = 4  # steps between plans
PLANNERS = {"mppi": MPPI, "cem": CEM, "model": MPPI}
SETTINGS = {"horizon": 8, "samples": 64, "iterations": 3, "noise": 0.3}


class InModel:
    """Plans in a simulator, from images.

    Attributes:
        errors: of each plan, of the body's center [H] in metres, and of a body that does not move.
    """

    def __init__(self, task: PushToGoal, seed: int, scenes: ModelScenes, reach: float | None, chunk: int | None):
        self.task, self.scenes, self.seed, self.errors = task, scenes, seed, []
        self.dynamics, cost = ModelDynamics(scenes, reach), GoalCost(torch.from_numpy(task.goal).to(scenes.device))
        self.planner = MPPI(self.dynamics, cost, -FASTEST, FASTEST, seed=seed, chunk=chunk, **SETTINGS)
        first = (task.scenes.all[0].view(scenes.rig), task.scenes.all[0].actors)
        self.seen = deque([first] * scenes.history, maxlen=scenes.history)  # at rest before the start

    def observe(self) -> None:
        """Sees the task after a step."""
        truth = self.task.scenes.all[0]
        self.seen.append((truth.view(self.scenes.rig), truth.actors))

    def state(self) -> ModelState:
        """What the planner begins with, encoded from the last images."""
        views, actors = zip(*self.seen, strict=True)
        start = Start(views, np.stack(actors), self.task.scenes.all[0])
        self.scenes.encode({0: start}, {0: np.random.default_rng(self.seed)})
        return self.scenes.state

    def compare(self, plan: Plan) -> None:
        """Adds the errors of a plan."""
        simulation, actions = self.task.simulation, plan.actions[None]
        at = torch.from_numpy(simulation.centers[0, :2])
        truth = TrueDynamics(self.task)(simulation.state(), actions).centers[0]
        predicted = self.dynamics(self.scenes.state, actions).centers[0].cpu()
        self.errors.append([(one - truth).norm(dim=1).tolist() for one in (predicted, at)])


def run(agent: str, env: gymnasium.Env, seed: int, **of_model) -> dict:
    """How an episode ended, predicted steps, and of each plan seconds and errors. ``of_model``: of :class:`InModel`."""
    _, info = env.reset(seed=seed)
    task, rng, times, predicted = env.unwrapped, np.random.default_rng((seed, 1)), [], []  # ``seed`` drew the scene
    model = InModel(task, seed, **of_model) if agent == "model" else None

    def counted(state, given):
        predicted.append(len(given) * SETTINGS["horizon"])
        return dynamics(state, given)

    if agent in PLANNERS:
        dynamics, cost = TrueDynamics(task), GoalCost(torch.from_numpy(task.goal))
        planner = model.planner if model else PLANNERS[agent](dynamics, cost, -FASTEST, FASTEST, seed=seed, **SETTINGS)
        dynamics, planner.dynamics = planner.dynamics, counted
    ended, steps, reward, actions = False, 0, 0.0, []
    while not ended:
        if agent not in PLANNERS:
            actions = [rng.uniform(-MAX_SPEED, MAX_SPEED, 2).astype(np.float32) * (agent == "random")] * EVERY
        else:
            start = time.perf_counter()
            state = model.state() if model else task.simulation.state()
            encoded = time.perf_counter()  # ends with a copy to the CPU, as the search does
            plan = planner.plan(state, len(actions))
            times.append((encoded - start, time.perf_counter() - encoded))
            if model:
                model.compare(plan)
            actions = list(plan.actions[:EVERY].numpy().astype(np.float32))
        for action in actions:
            _, reward, terminated, truncated, info = env.step(action)
            steps, ended = steps + 1, terminated or truncated
            if model:
                model.observe()
            if ended:
                break
    found = {"seed": seed, "solved": info["is_success"], "distance": -reward, "steps": steps}
    found |= zip(("encode_seconds", "plan_seconds"), np.reshape(times, (-1, 2)).T.tolist(), strict=True)
    return {**found, "predicted_steps": sum(predicted), "errors": model.errors if model else []}


def wilson(solved: int, count: int, z: float = 1.959964) -> tuple[float, float]:
    """The 95 % interval of a share."""
    share, spread = solved / count, z * z / count
    half = z * math.sqrt(share * (1 - share) / count + spread / (4 * count))
    return tuple(min(1.0, max(0.0, (share + spread / 2 + sign * half) / (1 + spread))) for sign in (-1, 1))


def summary(episodes: list[dict]) -> dict:
    """Numbers of an agent."""
    steps = [episode["steps"] for episode in episodes if episode["solved"]]
    encoding, times = (sum((one[f"{name}_seconds"] for one in episodes), []) for name in ("encode", "plan"))
    errors = np.array([plan for episode in episodes for plan in episode["errors"]])  # [plans, 2, H]
    return {
        "solved": len(steps),
        "episodes": len(episodes),
        "interval": wilson(len(steps), len(episodes)),
        "median_distance": np.median([episode["distance"] for episode in episodes]),
        "median_steps": np.median(steps) if steps else None,
        "median_encode_seconds": np.median(encoding) if times else None,
        "median_plan_seconds": np.median(times) if times else None,
        "steps_a_second": sum(one["predicted_steps"] for one in episodes) / sum(times) if times else None,
        "median_errors": dict(
            zip(("model", "rest"), np.median(errors, 0).tolist() if len(errors) else [], strict=False)
        ),
        "runs": episodes,
    }


def show(agent: str, found: dict) -> None:
    """Prints the numbers of an agent."""
    low, high = found["interval"]
    text = f"{agent:7} solved {found['solved']} of {found['episodes']} (95 %: {low:.0%} to {high:.0%}), "
    text += f"last distance {found['median_distance']:.3f} m"
    if found["median_steps"] is not None:
        text += f", {found['median_steps']:.0f} steps"
    if found["median_plan_seconds"] is not None:
        text += f", {found['median_encode_seconds']:.2f} s to encode"
        text += f", {found['median_plan_seconds']:.2f} s a plan, {found['steps_a_second']:.0f} steps a second"
    for what, errors in found["median_errors"].items():
        text += f"\n        error of {what}: " + " ".join(f"{100 * error:.1f}" for error in errors) + " cm"
    print(text, flush=True)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument("--agents", nargs="+", choices=("zero", "random", *PLANNERS), help="default: all that can run")
    parser.add_argument("--model", help="simulator of the agent model: a checkpoint, or a shipped name")
    parser.add_argument("--device", default="cpu", help="of the simulator (default %(default)s)")
    parser.add_argument("--reach", type=float, help="metres around bodies and pusher of the background that is copied")
    parser.add_argument("--chunk", type=int, help="largest number of sequences that the simulator predicts together")
    parser.add_argument("--seeds", type=int, default=50, help="number of episodes (default %(default)s)")
    parser.add_argument("--out", type=Path, help="file for all numbers, written after each episode; goes on from it")
    args = parser.parse_args(arguments)
    agents = args.agents or ["zero", "random", "mppi", "cem", *["model"] * (args.model is not None)]
    if "model" in agents and args.model is None:
        parser.error("the agent model needs --model PATH")
    if args.seeds < 1:
        parser.error(f"--seeds must be at least 1; got {args.seeds}")
    simulator = args.model and Simulator.from_pretrained(args.model, device=args.device).requires_grad_(False)
    device = torch.cuda.get_device_name() if args.device == "cuda" else args.device
    about = {"model": args.model, "device": device, "reach": args.reach}
    about = {"task": "PushToGoal", "version": 2, "first_seed": FIRST_SEED, "every": EVERY, **SETTINGS, **about}
    given = json.loads(args.out.read_bytes()) if args.out and args.out.exists() else {"about": about, "agents": {}}
    if given.get("about") != about:
        parser.error(f"--out: {args.out} is of other settings; name another file")
    found = given["agents"]
    of_model = {"scenes": args.model and ModelScenes(simulator, 1, 1), "reach": args.reach, "chunk": args.chunk}
    env, seeds = gymnasium.make("gsim3d/PushToGoal-v0"), range(FIRST_SEED, FIRST_SEED + args.seeds)
    for agent in agents:
        runs = {one["seed"]: one for one in found.get(agent, {}).get("runs", [])}
        for seed in progress(seeds, agent, unit="episode"):
            if seed in runs:
                continue
            runs[seed] = run(agent, env, seed, **of_model)
            found[agent] = summary(list(runs.values()))
            if args.out:
                write_whole(args.out, json.dumps({"about": about, "agents": found}, indent=1) + "\n")
        show(agent, summary([runs[seed] for seed in seeds]))


if __name__ == "__main__":
    try:
        main()
    except (ValueError, OSError) as error:
        sys.exit(f"push_planning: error: {error}")

"""Success of agents on PushToGoal: random, zero, and planners in MuJoCo itself, on 50 fixed seeds.

python tools/bench/push_planning.py [--agents zero random mppi cem] [--seeds 50] [--out docs/results/push_planning.json]

Planners: K 64 sequences of H 8 actions, 3 iterations, replanned every 4 steps. Printed: solved episodes with the 95 %
Wilson interval, the median of the last distance to the goal, steps of solved episodes and seconds of a plan.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402

import gsim3d.envs  # noqa: E402, F401
from gsim3d.envs.push_planning import GoalCost, TrueDynamics, action_bounds  # noqa: E402
from gsim3d.planning import CEM, MPPI  # noqa: E402

FIRST_SEED = 1000
EVERY = 4  # steps between plans
PLANNERS = {"mppi": MPPI, "cem": CEM}
SETTINGS = {"horizon": 8, "samples": 64, "iterations": 3, "noise": 0.3}


def run(agent: str, env: gymnasium.Env, seed: int) -> dict:
    """One episode: whether it was solved, the last distance, steps, and seconds of each plan."""
    _, info = env.reset(seed=seed)
    task, rng, times = env.unwrapped, np.random.default_rng(seed), []
    if agent in PLANNERS:
        cost = GoalCost(torch.from_numpy(task.goal))
        planner = PLANNERS[agent](TrueDynamics(task.simulation), cost, *action_bounds(), seed=seed, **SETTINGS)
    ended, steps, reward, actions = False, 0, 0.0, []
    while not ended:
        if agent == "zero":
            actions = [np.zeros(2, np.float32)]
        elif agent == "random":
            low, high = env.action_space.low, env.action_space.high
            actions = [rng.uniform(low, high).astype(np.float32)]
        else:
            start = time.perf_counter()
            plan = planner.plan(task.simulation.state(), executed=len(actions))
            times.append(time.perf_counter() - start)
            actions = list(plan.actions[:EVERY].numpy().astype(np.float32))
        for action in actions:
            _, reward, terminated, truncated, info = env.step(action)
            steps, ended = steps + 1, terminated or truncated
            if ended:
                break
    return {"seed": seed, "solved": info["is_success"], "distance": -reward, "steps": steps, "plan_seconds": times}


def wilson(solved: int, count: int, z: float = 1.959964) -> tuple[float, float]:
    """The 95 % interval of a share."""
    share, spread = solved / count, z * z / count
    middle = (share + spread / 2) / (1 + spread)
    half = z / (1 + spread) * math.sqrt(share * (1 - share) / count + spread / (4 * count))
    return middle - half, middle + half


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0], allow_abbrev=False)
    parser.add_argument(
        "--agents", nargs="+", choices=("zero", "random", *PLANNERS), default=["zero", "random", *PLANNERS]
    )
    parser.add_argument("--seeds", type=int, default=50, help="number of episodes (default %(default)s)")
    parser.add_argument("--out", type=Path, help="file for all numbers")
    args = parser.parse_args()
    env, found = gymnasium.make("gsim3d/PushToGoal-v0"), {}
    for agent in args.agents:
        episodes = [run(agent, env, FIRST_SEED + number) for number in range(args.seeds)]
        solved = sum(episode["solved"] for episode in episodes)
        low, high = wilson(solved, len(episodes))
        distance = statistics.median(episode["distance"] for episode in episodes)
        steps = [episode["steps"] for episode in episodes if episode["solved"]]
        times = [seconds for episode in episodes for seconds in episode["plan_seconds"]]
        found[agent] = {
            "solved": solved,
            "episodes": len(episodes),
            "interval": [low, high],
            "median_distance": distance,
            "median_steps": statistics.median(steps) if steps else None,
            "median_plan_seconds": statistics.median(times) if times else None,
            "runs": [{k: v for k, v in episode.items() if k != "plan_seconds"} for episode in episodes],
        }
        print(
            f"{agent:7} solved {solved} of {len(episodes)} (95 %: {low:.0%} to {high:.0%}), "
            f"last distance {distance:.3f} m"
            + (f", {statistics.median(steps):.0f} steps" if steps else "")
            + (f", {statistics.median(times):.2f} s a plan" if times else ""),
            flush=True,
        )
    if args.out:
        about = {
            "task": "PushToGoal",
            "first_seed": FIRST_SEED,
            "every": EVERY,
            **SETTINGS,
        }
        args.out.write_text(json.dumps({"about": about, "agents": found}, indent=1) + "\n")


if __name__ == "__main__":
    main()

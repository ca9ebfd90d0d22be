"""Base of the environments: one episode, or many side by side, in MuJoCo or in a learned simulator."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from gsim3d import pretrained
from gsim3d.envs.model import ModelScenes
from gsim3d.envs.scenes import FPS, N_PARTICLES, N_VIEWS, Scenes, TrueScene, TrueScenes, task_rig
from gsim3d.errors import InputError, check_one_of, check_whole, did_you_mean
from gsim3d.io.files import shown
from gsim3d.simulator import Simulator

OBSERVATIONS = ("particles", "images", "both")
BACKENDS = ("truth", "model")
RENDER_MODES = ("rgb_array",)
REACH = 2.0  # metres; bound of the positions of actors and goals


class TaskEnv(gymnasium.Env):
    """Base of the tasks.

    Observations are a dictionary:

    - ``goal`` [2], and the positions of actors: metres;
    - ``particles`` [256, 3]: points of the bodies, metres; the same points at every step;
    - ``images`` uint8 [4, H, W, 3]: of four calibrated cameras (``rig``).

    Episodes are functions of the seed, in all bits; those of a learned simulator for one machine and number of threads.

    Args:
        observation: "particles", "images" or "both".
        image_size: pixels, width and height of observed images.
        render_mode: None or "rgb_array": the first camera.
        backend: "truth": MuJoCo; "model": a learned simulator, which encodes images of the truth's start.
        model: name or path of the simulator, for ``backend="model"``. Default: the task's shipped one, if there is one.
        device: "cpu" or "cuda", of the simulator.

    Attributes:
        rig: cameras of the images.
        goal: [2] metres.

    Raises:
        InputError: an argument is not known, or the simulator cannot be loaded.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": list(RENDER_MODES), "render_fps": FPS}
    max_bodies: ClassVar[int] = 1
    actors: ClassVar[tuple[str, tuple[int, ...]] | None] = None  # name and shape of their observed positions
    max_action: ClassVar[tuple[float, ...]]
    reached: ClassVar[float]  # distance below which a scene is solved
    true_scenes: ClassVar[type[TrueScenes]] = TrueScenes
    shipped: ClassVar[str] = ""  # name of the simulator that is the default of ``model``, once it ships

    def __init__(self, observation: str = "particles", image_size: int = 64, render_mode: str | None = None, **options):
        self._episodes = Episodes(type(self), 1, observation, image_size, render_mode, **options)
        self.render_mode, self.rig, self.scenes = render_mode, self._episodes.rig, self._episodes.scenes
        self.observation_space, self.action_space = self._episodes.observation_space, self._episodes.action_space

    @property
    def goal(self) -> np.ndarray:
        """[2] metres."""
        return self._episodes.goals[0].cpu().numpy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """The first observation of a new episode, and ``info``. Raises InputError where ``options`` are given."""
        if options:
            raise InputError(f"reset: a single environment has no options; got {shown(options)}")
        super().reset(seed=seed)
        self._episodes.begin({0: self.np_random})
        return self._observe(), self._info()

    def step(self, action: np.ndarray):
        """One step: observation, reward, terminated, truncated, info.

        Raises:
            InputError: ``action`` is not inside the bounds, or no episode has begun.
        """
        self._episodes.act(self._episodes.numbers(action)[None])
        reward, terminated = -float(self._episodes.distances[0]), bool(self._episodes.ended[0])
        return self._observe(), reward, terminated, False, self._info()

    def render(self) -> np.ndarray | None:
        """uint8 [H, W, 3] of the first camera; None without a render mode."""
        return self._episodes.pictures()[0] if self.render_mode == "rgb_array" else None

    def _observe(self) -> dict[str, np.ndarray]:
        return {name: value[0].cpu().numpy() for name, value in self._episodes.observe().items()}

    def _info(self) -> dict[str, Any]:
        found = {name: value[0].cpu().numpy() for name, value in self._episodes.info().items()}
        return {**found, "is_success": bool(found["is_success"])}

    @classmethod
    @abstractmethod
    def draw(cls, rng: np.random.Generator) -> TrueScene:
        """The start of an episode."""

    @classmethod
    @abstractmethod
    def act(cls, scenes: Scenes, actions: Tensor) -> Tensor:
        """Simulates a step with ``actions`` [n, A]. Returns the executed ones."""

    @classmethod
    def distances(cls, scenes: Scenes, goals: Tensor) -> Tensor:
        """How far scenes are from ``goals`` [n, 2], [n]; minus the reward. Default: of the first body, in metres."""
        return (scenes.centers()[:, 0, :2] - goals).norm(dim=-1)

    @classmethod
    def solved(cls, distances: Tensor) -> Tensor:
        """Whether scenes at ``distances`` [n] are solved, bool [n]. Default: where they are below ``reached``."""
        return distances < cls.reached

    @classmethod
    def ended(cls, distances: Tensor) -> Tensor:
        """Whether episodes end at ``distances`` [n], bool [n]: where they are solved."""
        return cls.solved(distances)


class Episodes:
    """n episodes of a task side by side.

    Args:
        task: the task.
        count: n.
        others: of :class:`TaskEnv`.

    Attributes:
        scenes: the simulated scenes.
        goals: [n, 2] metres.
        distances: [n], minus the rewards.
        executed: executed actions [n, A].
    """

    def __init__(
        self,
        task: type[TaskEnv],
        count: int,
        observation: str = "particles",
        image_size: int = 64,
        render_mode: str | None = None,
        backend: str = "truth",
        model: str | None = None,
        device: str = "cpu",
        **unknown: Any,
    ):
        for name in unknown:
            options = "observation", "image_size", "render_mode", "backend", "model", "device"
            known = f"it has {', '.join(options)}{did_you_mean(name, options)}"
            raise InputError(f"{task.__name__} has no option {name!r}; {known}")
        check_one_of("observation", observation, OBSERVATIONS)
        check_one_of("backend", backend, BACKENDS)
        check_one_of("render_mode", render_mode or RENDER_MODES[0], RENDER_MODES)
        check_whole("image_size", image_size)
        self.task, self.count, self.observation, self.rig = task, count, observation, task_rig(image_size)
        if backend == "model":
            if model is None and task.shipped not in pretrained.names():
                raise InputError('backend="model" needs model=PATH, a checkpoint of a trained simulator')
            simulator = Simulator.from_pretrained(model or task.shipped, device=device).requires_grad_(False)
            self.scenes = ModelScenes(simulator, count, task.max_bodies, image_size)
        elif model is not None or device != "cpu":
            raise InputError('model and device are of backend="model"; MuJoCo simulates the truth on the CPU')
        else:
            self.scenes = task.true_scenes(count, task.max_bodies)
        self._high = torch.tensor(task.max_action, dtype=torch.float64, device=self.scenes.device)
        self.goals = torch.zeros(count, 2, dtype=torch.float64, device=self.scenes.device)
        self.action_space = spaces.Box(-self._high.float().cpu().numpy(), self._high.float().cpu().numpy())
        self.observation_space = self._observations(image_size)
        self.executed: Tensor | None = None

    def _observations(self, image_size: int) -> spaces.Dict:
        parts: dict[str, spaces.Space] = {"goal": spaces.Box(-REACH, REACH, (2,), np.float32)}
        if self.task.actors is not None:
            parts[self.task.actors[0]] = spaces.Box(-REACH, REACH, self.task.actors[1], np.float32)
        if self.observation != "images":
            parts["particles"] = spaces.Box(-10.0, 10.0, (N_PARTICLES, 3), np.float32)
        if self.observation != "particles":
            parts["images"] = spaces.Box(0, 255, (N_VIEWS, image_size, image_size, 3), np.uint8)
        return spaces.Dict(parts)

    def begin(self, rngs: Mapping[int, np.random.Generator]) -> None:
        """Begins new episodes, drawn by the generators of their numbers."""
        drawn = {number: self.task.draw(rng) for number, rng in rngs.items()}
        points = {number: np.random.default_rng(rng.integers(2**63)) for number, rng in rngs.items()}
        self.scenes.reset(drawn, points)
        for number, scene in drawn.items():
            self.goals[number] = torch.from_numpy(scene.goal)
        if self.executed is None:
            self.executed = self._high.expand(self.count, -1).clone()
        self.executed[list(drawn)] = 0
        self._measure()

    def numbers(self, actions: Any) -> Tensor:
        """``actions`` of any kind as float64. Raises InputError if they are no real numbers."""
        try:
            if torch.as_tensor(actions).is_complex():
                raise TypeError
            return torch.as_tensor(actions, dtype=torch.float64, device=self.scenes.device)
        except (TypeError, ValueError, RuntimeError):
            raise InputError(f"action must be {len(self._high)} numbers; got {shown(actions)}") from None

    @torch.no_grad()
    def act(self, actions: Tensor) -> None:
        """Simulates a step with ``actions`` [n, A].

        Raises:
            InputError: an action is not inside the bounds, or no episode has begun.
        """
        if self.executed is None:
            raise InputError("step was called before reset")
        if actions.shape != (self.count, len(self._high)) or not bool((actions.abs() <= self._high + 1e-6).all()):
            bounds = ", ".join(f"{high:g}" for high in self.task.max_action)
            wanted = f"{len(self._high)} numbers of at most {bounds} in absolute value"
            raise InputError(f"action must be {wanted}; got {shown(actions.tolist())}")
        self.executed = self.task.act(self.scenes, actions)
        self._measure()

    def _measure(self) -> None:
        self.distances = self.task.distances(self.scenes, self.goals)
        self.solved, self.ended = self.task.solved(self.distances), self.task.ended(self.distances)

    def pictures(self) -> np.ndarray:
        """Images of the first camera, uint8 [n, H, W, 3]."""
        if self.executed is None:
            raise InputError("render was called before reset")
        return self.scenes.images(self.rig)[:, 0].cpu().numpy()

    def observe(self) -> dict[str, Tensor]:
        """Observations [n, ...]."""
        found = {"goal": self.goals.float()}
        if self.task.actors is not None:
            name, shape = self.task.actors
            found[name] = self.scenes.actors()[..., : shape[-1]].reshape(self.count, *shape).float()
        if self.observation != "images":
            found["particles"] = self.scenes.points()
        if self.observation != "particles":
            found["images"] = self.scenes.images(self.rig)
        return found

    def info(self) -> dict[str, Tensor]:
        """Facts [n, ...]; the centers of bodies that a scene does not have are infinite: NaN would not equal itself."""
        centers = self.scenes.centers()[..., :2].nan_to_num(torch.inf, torch.inf, -torch.inf)
        return {"is_success": self.solved, "centers": centers, "velocity": self.executed.clone()}


class TaskVectorEnv(VectorEnv):
    """Episodes of a task side by side; a learned simulator predicts them in one batch.

    Of a learned simulator, observations, rewards, flags and infos are tensors on its device, without copies
    (``metadata["torch"]``); of the truth, arrays. Environment i equals a single one of seed ``seed + i``.

    Args:
        num_envs: number of environments, n.
        max_episode_steps: steps until an episode is truncated; None: never.
        autoreset_mode: as in Gymnasium: NEXT_STEP, SAME_STEP or DISABLED, or its value.
        others: as of a single environment.

    Raises:
        InputError: as of a single environment.
    """

    task: ClassVar[type[TaskEnv]]

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options,
    ):
        check_whole("num_envs", num_envs)
        check_whole("max_episode_steps", 1 if max_episode_steps is None else max_episode_steps)
        mode = getattr(autoreset_mode, "value", autoreset_mode)
        check_one_of("autoreset_mode", mode, [known.value for known in AutoresetMode])
        self._episodes = Episodes(self.task, num_envs, **options)
        self.mode, self.num_envs = AutoresetMode(mode), num_envs
        self._torch = not isinstance(self._episodes.scenes, TrueScenes)
        self.metadata = {**self.task.metadata, "torch": self._torch, "autoreset_mode": self.mode}
        self.render_mode, self._most_steps = options.get("render_mode"), max_episode_steps
        self.single_observation_space = self._episodes.observation_space
        self.single_action_space = self._episodes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.scenes, self._rngs = self._episodes.scenes, {}
        self._steps, self._over = np.zeros(num_envs, np.int64), np.zeros(num_envs, bool)

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:
        """Random generators of the environments."""
        return tuple(self._generator(number)[0] for number in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int, ...]:
        """Seeds of ``np_random``."""
        return tuple(self._generator(number)[1] for number in range(self.num_envs))

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None):
        """The first observations of new episodes, and infos.

        Args:
            seed: of environment i: ``seed + i``, or element i; None: the random numbers go on.
            options: "reset_mask", bool [n]: environments to reset. Default: all.

        Raises:
            InputError: seeds or mask are of a wrong kind or length, or the first reset is not of all environments.
        """
        seed = np.asarray(seed).tolist()  # of an array, too, Python's integers
        if not isinstance(seed, list):
            seed = [seed + i if isinstance(seed, int) else seed for i in range(self.num_envs)]
        if unknown := set(options or {}) - {"reset_mask"}:
            raise InputError(f"reset: the options have reset_mask alone; got {shown(sorted(map(str, unknown)))}")
        chosen = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        if len(seed) != self.num_envs or chosen.shape != (self.num_envs,) or chosen.dtype != bool:
            raise InputError(f"seed and reset_mask must be of {self.num_envs} environments")
        if self._episodes.executed is None and not chosen.all():
            raise InputError("reset_mask: the first reset must be of all environments")
        seeded = {number: seed[number] for number in chosen.nonzero()[0].tolist() if seed[number] is not None}
        for number, value in seeded.items():
            check_whole(f"seed of environment {number}", value, 0)
        self._rngs |= {number: seeding.np_random(value) for number, value in seeded.items()}
        self._begin(chosen)
        return self._given(self._episodes.observe()), self._given(self._infos(self._episodes.info(), chosen))

    def step(self, actions: Tensor | np.ndarray):
        """One step of all environments: observations, rewards [n], terminations [n], truncations [n], infos.

        Args:
            actions: [n, A].

        Raises:
            InputError: an action is not inside the bounds, or an environment has ended and must be reset.
        """
        episodes, over = self._episodes, self._over
        if self.mode is AutoresetMode.DISABLED and over.any():
            raise InputError(f"environments {over.nonzero()[0].tolist()} have ended; reset them with reset_mask")
        actions, begun = episodes.numbers(actions), torch.from_numpy(over).to(self.scenes.device)
        if actions.shape == self.action_space.shape:
            actions = actions.masked_fill(begun[:, None], 0)  # the step after an end ignores the action
        if not over.all():
            episodes.act(actions)
        self._begin(over)
        self._steps += ~over
        rewards = (-episodes.distances).masked_fill(begun, 0.0)
        terminated = episodes.ended & ~begun
        late = self._steps >= (np.inf if self._most_steps is None else self._most_steps)
        truncated = torch.from_numpy(late).to(self.scenes.device)
        self._over = late | terminated.cpu().numpy()
        infos, observed = {}, episodes.observe()
        if self.mode is AutoresetMode.SAME_STEP and self._over.any():
            infos = self._final(observed)
            self._begin(self._over)
            observed = episodes.observe()
        infos |= self._infos(episodes.info(), np.ones(self.num_envs, bool))
        return tuple(self._given(value) for value in (observed, rewards, terminated, truncated, infos))

    def render(self) -> tuple[np.ndarray, ...] | None:
        """uint8 [H, W, 3] of the first camera of each environment; None without a render mode."""
        return None if self.render_mode is None else tuple(self._episodes.pictures())

    def _generator(self, number: int) -> tuple[np.random.Generator, int]:
        if number not in self._rngs:
            self._rngs[number] = seeding.np_random()
        return self._rngs[number]

    def _begin(self, chosen: np.ndarray) -> None:
        if chosen.any():
            self._episodes.begin({number: self._generator(number)[0] for number in chosen.nonzero()[0].tolist()})
        self._steps[chosen] = 0
        self._over = self._over & ~chosen

    def _final(self, observed: dict[str, Tensor]) -> dict[str, Any]:
        """Infos with the last observations and infos of the episodes that have ended."""
        final = np.full(self.num_envs, None, dtype=object)
        for number in self._over.nonzero()[0].tolist():
            final[number] = {name: value[number] for name, value in observed.items()}
        found = {"final_obs": final, "final_info": self._infos(self._episodes.info(), self._over)}
        return self._infos(found, self._over)

    def _given(self, value: Any) -> Any:
        """``value``, nested in dictionaries and arrays of objects, with arrays instead of tensors for the truth."""
        if self._torch:
            return value
        if isinstance(value, dict):
            return {name: self._given(one) for name, one in value.items()}
        if isinstance(value, np.ndarray) and value.dtype == object:
            value[:] = [self._given(one) for one in value]
        return value.numpy() if isinstance(value, Tensor) else value

    def _infos(self, found: dict[str, Any], chosen: np.ndarray) -> dict[str, Any]:
        return {**found, **{f"_{name}": chosen.copy() for name in found}}

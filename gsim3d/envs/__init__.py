"""Gymnasium environments: push, throw and cover, in MuJoCo or in a learned simulator.

``import gsim3d.envs`` registers them::

    import gymnasium, gsim3d.envs
    env = gymnasium.make("gsim3d/PushToGoal-v0")
    envs = gymnasium.make_vec("gsim3d/PushToGoal-v0", num_envs=8, backend="model", model="path/to/checkpoint")

They need the packages gymnasium and MuJoCo: ``pip install 'gsim3d[envs]'``.
"""

from gsim3d.errors import InputError
from gsim3d.synth.mujoco_engine import load_mujoco

try:
    import gymnasium

    load_mujoco()
except ImportError as error:
    raise InputError(f"gsim3d.envs needs more packages: pip install 'gsim3d[envs]' ({error})") from None

from gsim3d.envs.cloth import ClothCover
from gsim3d.envs.hybrid import HybridScene
from gsim3d.envs.push import PushClear, PushToGoal
from gsim3d.envs.tasks import TaskVectorEnv
from gsim3d.envs.throw import ThrowToTarget

__all__ = ["ClothCover", "HybridScene", "PushClear", "PushToGoal", "ThrowToTarget"]

_MAX_STEPS = {PushToGoal: 60, PushClear: 60, ThrowToTarget: None, ClothCover: 60}  # five seconds
for _env, _max_steps in _MAX_STEPS.items():
    _vector = f"{_env.__name__}Vector"  # names in a spec are of the form module:class
    globals()[_vector] = type(_vector, (TaskVectorEnv,), {"task": _env, "__module__": __name__})
    gymnasium.register(
        f"gsim3d/{_env.__name__}-v0",
        entry_point=f"{__name__}:{_env.__name__}",
        vector_entry_point=f"{__name__}:{_vector}",
        max_episode_steps=_max_steps,
    )

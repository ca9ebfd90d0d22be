"""Gymnasium environments: a pusher that moves rigid bodies to goals.

``import gsim3d.envs`` registers them::

    import gymnasium, gsim3d.envs
    env = gymnasium.make("gsim3d/PushToGoal-v0")

They need the packages gymnasium and MuJoCo: ``pip install 'gsim3d[envs]'``.
"""

from gsim3d.errors import InputError

try:
    import gymnasium
except ImportError:
    raise InputError("gsim3d.envs needs the package gymnasium: pip install 'gsim3d[envs]'") from None

from gsim3d.envs.push import MAX_STEPS, PushClear, PushToGoal

__all__ = ["PushClear", "PushToGoal"]

for _env in (PushToGoal, PushClear):
    gymnasium.register(
        f"gsim3d/{_env.__name__}-v0", entry_point=f"gsim3d.envs.push:{_env.__name__}", max_episode_steps=MAX_STEPS
    )

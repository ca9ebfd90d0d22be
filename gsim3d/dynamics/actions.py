"""Action particles: the points of actors as further particles in the input of the dynamics.

In the input of the step from t to t + 1, each cloud has one particle for each point: at the point's position at the
cloud's step, with latents

    e[type] + W d / grid_size

of its learned embedding e and its displacement d to the next step, which is known also for the newest cloud and is its
velocity where particles have one. What the network predicts for action particles is not used.
"""

import torch
from torch import Tensor, nn

from gsim3d.dynamics.config import DynamicsConfig
from gsim3d.errors import InputError
from gsim3d.state import ASLEEP, DYNAMIC, VELOCITIES, Actions, Particles, constant, joined_clouds, take_runs

# Standard deviations of the initial weights. A point is one of hundreds of particles: of a single ball that moves as
# prescribed, the preset tiny learned nothing from displacements in 3000 steps with 0.5, and enough in 1000 with 2.5.
EMBEDDING, DISPLACEMENT = 0.5, 2.5


class ActionParticles(nn.Module):
    """Adds the points of actors to a history, and removes them from the step that was predicted from it.

    Attributes:
        embedding: latents of each type [n_types, channels], dynamic ones first.
        displacement: latents [3, channels] of a displacement of one cell along each axis.
    """

    def __init__(self, config: DynamicsConfig):
        super().__init__()
        self.types, self.cell, self.n_dynamic = config.actions, config.grid_size, config.dynamic_latents
        channels = config.dynamic_latents + config.static_latents
        self.embedding = nn.Parameter(torch.empty(len(self.types), channels).normal_(std=EMBEDDING))
        self.displacement = nn.Parameter(torch.empty(3, channels).normal_(std=DISPLACEMENT))

    def added(self, history: Particles, acting: tuple[str, ...]) -> Particles:
        """Returns ``history`` with the action particles, of the types ``acting``, of each cloud after its others.
        Raises InputError if the model does not know the type of a point."""
        return joined_clouds(history, self._points(history, acting))

    @staticmethod
    def removed(step: Particles) -> Particles:
        """Returns ``step`` without its action particles."""
        table, n_points = step.clouds, step.actions.n_points
        runs = [(begin, until - n_points) for begin, until in zip(table.starts, table.starts[1:], strict=False)]
        fields = {name: take_runs(value, runs) for name, value in step.row_fields().items()}
        return step.with_clouds(table.with_counts(until - begin for begin, until in runs), **fields)

    def _points(self, history: Particles, acting: tuple[str, ...]) -> Particles:
        """The action particles of all clouds; those that a scene does not have there are asleep."""
        actions, table, like = history.actions, history.clouds, history.means
        index = self._index(actions, acting)
        (now, types), (coming, coming_types) = actions.at(table), actions.at(table, 1)
        now, types = now.to(like), index[types]
        moved = torch.where((coming_types < 0)[..., None], 0, coming.to(like) - now)
        latents = self.embedding[types.clamp_min(0)] + ((moved / self.cell)[..., None] * self.displacement).sum(-2)
        latents = latents.flatten(0, 1).to(history.dynamic_latents)
        known = table.with_counts((actions.n_points,) * len(table))
        activity = torch.where(types.flatten() < 0, ASLEEP, DYNAMIC).to(torch.uint8)
        rows = now.flatten(0, 1), torch.ones_like(latents[:, 0]), *latents.tensor_split([self.n_dynamic], 1)
        moves = dict.fromkeys((n for n in VELOCITIES if getattr(history, n) is not None), moved.flatten(0, 1))
        return Particles(*rows, *known.tensors, activity=activity, origin=history.origin, known=known, **moves)

    def _index(self, actions: Actions, acting: tuple[str, ...]) -> Tensor:
        """int64: index into ``types`` of each of the actions' types; -1 (also its last entry): not acting."""
        if unknown := [name for name in actions.names if name not in self.types]:
            known = ", ".join(self.types)
            raise InputError(f"actions: the model does not know the type {unknown[0]!r}; it has {known}")
        index = tuple(self.types.index(name) if name in acting else -1 for name in actions.names)
        return constant((*index, -1), actions.types.device)  # a type of -1 reads the last entry

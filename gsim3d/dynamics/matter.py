"""What may move of the newest step of every scene: all that rows are told looks at the same."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from gsim3d.dynamics.rigid import Lattice
from gsim3d.dynamics.samples import Few, Padded, Rows, Samples, squares, weights
from gsim3d.state import FROZEN, Particles, constant, newest_clouds

EVEN = 0.15  # of the windows' length: standard deviation of those in which rows are counted
APART = 0.2  # of the windows' length: less than half as far as the middles of two bodies are apart


class Matter:
    """The rows that may move, and samples of them. No gradients.

    everything: rows [B, M] of the newest clouds, those that may move are wanted.
    few: how the m rows of which more is computed stand among them.
    rows, samples: those; places of samples count from ``here`` [B, 1, 3], the mean of theirs.
    places: [B, m, 3] of the rows, from there as well.
    nodes, window: [B, G, 3] of a lattice, and [B, G, S] how much each sample counts around a node; where a ``length``
        is given. Of rows that know their ``body`` all of that count, and nothing else: nodes are places of bodies. Of
        others it is a Gaussian of ``length`` metres. ``evenly``: as much as the surface that it stands for, as more
        rows are seen of the top of a body.
    """

    def __init__(
        self,
        history: Particles,
        grid_size: float,
        length: float | None = None,
        most: int | None = None,
        evenly: bool = False,
    ):
        self.newest = newest_clouds(history.clouds)
        self._counts = [history.clouds.count(q) for q in self.newest]
        with torch.no_grad(), torch.autocast(history.means.device.type, enabled=False):
            self.everything = Rows(Padded(history, self.newest, grid_size), history)
            self.few = Few(self.everything.wanted, most)
            self.rows = self.everything.only(self.few)
            self.samples = Samples(self.rows)
            self.here = self.samples.mean[:, None]
            self.samples.seen_from(self.here)
            self.places = self.rows.places - self.here
            if length is not None:
                self._at, self._sampled, size = self.places, self.samples.places, length
                if history.body is not None:
                    self._at, size = self._from_here(history, history.body), APART * length
                    self._sampled = self.samples.take(self._at)
                self._lattice = Lattice(self._sampled, self.samples.known)
                self.nodes = self._lattice.nodes
                counts = squares(self.nodes, self._sampled) * (-0.5 / size**2)
                if evenly:
                    counts = counts - self.samples.crowd(EVEN * length).log()[:, None]
                self.window = weights(counts, self.samples.known)

    def _from_here(self, history: Particles, places: Tensor) -> Tensor:
        """[B, m, 3] of ``places`` [N, 3] of all rows."""
        table, rows = history.clouds, self.rows
        scenes = constant(tuple(table.scenes[q] for q in self.newest), places.device)
        found = places.detach()[rows.rows].double() - history.origin[scenes][:, None]
        return torch.where(rows.wanted[:, :, None], found, 0).to(self.here.dtype) - self.here

    def of_rows(self, *values: Tensor) -> tuple[Tensor, ...]:
        """[B, m, 3] of the rows, of each of ``values`` [B, G, 3] of the nodes."""
        return self._lattice.at(self._at, *values)

    def of_samples(self, *values: Tensor) -> tuple[Tensor, ...]:
        """[B, S, 3], as :meth:`of_rows`."""
        return self._lattice.at(self._sampled, *values)

    @classmethod
    def of(
        cls,
        history: Particles,
        grid_size: float,
        length: float | None = None,
        most: int | None = None,
        evenly: bool = False,
    ) -> Matter | None:
        """None where the newest clouds have no rows.

        most: rows of a scene that may move, if that is known.
        """
        clouds = history.clouds
        any_rows = any(clouds.count(q) for q in newest_clouds(clouds))
        return cls(history, grid_size, length, most, evenly) if any_rows else None

    def awake(self, history: Particles) -> Tensor:
        """bool [N], packed, rows of the newest clouds that neither sleep nor are outside of the workspace."""
        return self.together(self.everything.wanted | self.everything.that_are(history, FROZEN).wanted)

    def padded(self, values: Tensor) -> Tensor:
        """[B, m, C] of ``values`` [N, C] of the rows of the newest clouds, packed."""
        return self.few.take(self.apart(values))

    def packed(self, values: Tensor) -> Tensor:
        """[N, ...] of ``values`` [B, m, ...]; 0 of rows that cannot move."""
        return self.together(self.few.put(values))

    def apart(self, values: Tensor) -> Tensor:
        """[B, M, C] of ``values`` [N, C] of the rows of the newest clouds, packed."""
        most = self.everything.rows.shape[1]
        return torch.stack([F.pad(part, (0, 0, 0, most - len(part))) for part in values.split(self._counts)])

    def together(self, values: Tensor) -> Tensor:
        """[N, ...] of ``values`` [B, M, ...]."""
        return torch.cat([values[b, :n] for b, n in enumerate(self._counts)])

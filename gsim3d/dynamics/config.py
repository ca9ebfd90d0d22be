"""The shape of the dynamics model."""

from __future__ import annotations

from dataclasses import dataclass

from gsim3d.errors import check_ranges
from gsim3d.ops.curve import PyramidSpec

PREDICTS = ("from_newest", "from_previous", "absolute")
BACKGROUNDS = ("symmetric", "asymmetric", "relightable")
STEM_KERNEL, BLOCK_KERNEL = 5, 3  # edges of the convolutions, in cells
MAX_HISTORY_BITS = 32  # that the geometry counts
MOST_WAVES = 16  # further ones are shorter than rounding


@dataclass(frozen=True)
class DynamicsConfig:
    """S stages; every per-stage tuple starts at the finest.

    State:
        dynamic_latents, static_latents: channels of Particles.dynamic_latents and .static_latents.
        explicit: particles carry their own Gaussian parameters (quats, scales, sh), and all of them change with time.
        sh_degree: of explicit particles.
        scale_min, scale_max: metres, limits of explicit scales.
        predicts: "from_newest": the network predicts how much each later state differs from the newest one of the
            history; "from_previous": from the state one step before it; "absolute": the state itself.
        steps_per_call: steps that one call of the network predicts.
        max_step: metres; one step moves a particle by this at most along each axis. None: no limit, and none to how
            much a scale changes.
        max_latent_step: the same for each dynamic latent. None: no limit.
        position_features: the network also sees positions relative to the scene's origin (in units of
            ``position_length`` metres) and inside the cell. Learning where the ground is takes far less data so;
            without it the network knows particles by their neighbours only, and motion does not depend on the place.
        position_waves: of the positions the network also sees sines and cosines of so many wavelengths, from 4
            ``position_length`` down, each half as long as the one before: attention can then find what is at a given
            distance, as a body over its shadow.
        contact_length: metres, more than a step moves. The network sees where frozen matter is that a particle may meet
            (:func:`gsim3d.dynamics.contact.contact`). None: it has to find that out from the places of both.
        lights: directions towards lamps far away, where they begin; training turns them. The network sees how much
            movable matter is between a particle and each, now and where it was encoded
            (:func:`gsim3d.dynamics.shade.shade`), and predicts by how much more light reaches it now: colours are
            multiplied by that. Empty: where shadows fall has to be found out from the places of all.
        surfaces: with ``lights``: particles are lit as the surfaces that they make, by the direction of those and by
            shadows, beside a light that comes from everywhere (:func:`gsim3d.dynamics.daylight.daylight`).
        motion_length: metres, about the radius of a body. The network sees how the matter around a particle has moved
            (:func:`gsim3d.dynamics.motion.motion`), and predicts how much of that is kept along each axis and what is
            added to it: without a force bodies fly on. None: it has to read velocities off the places in its history.
        velocity: with ``motion_length`` particles carry their velocity: encoded ones as images tell it
            (:func:`gsim3d.dynamics.follow.follow`), simulated ones their last step. What goes on is the rigid motion of
            a window of these, and a row's own is a third motion (:func:`gsim3d.dynamics.momentum.momentum`). Gradients
            flow through both, so that an impulse is blamed for all that follows from it.
        deformation: with ``motion_length`` particles remember where they were when the simulation began. The network
            sees how they would have to move for the shape that bodies had then
            (:func:`gsim3d.dynamics.deformation.deformation`), and predicts how much more or less of that they do than
            a share that keeps shapes: what an elastic body does next cannot be told without it.
        turning: with ``velocity``: what is drawn turns with the matter around its particle, as its shape and harmonics
            would not by themselves (:func:`gsim3d.dynamics.momentum.turned`).
        gravity: metres a step, of every step, where it begins; training adjusts it. With ``velocity``, ``deformation``
            and ``contact_length``: what touches nothing frozen flies on, turns and falls, whatever is predicted, and
            encoded rows in flight have the velocity of their last step (:mod:`gsim3d.dynamics.flight`). None: what is
            predicted counts everywhere.
        pushes: with ``gravity``: the background stops rows that would get behind it, with friction; what rows of a body
            do to each other changes neither its momentum nor its spin (:mod:`gsim3d.dynamics.push`). Of places nothing
            is predicted but shares of the motions that rows are told and of the way back to their shape: how damped and
            how stiff bodies are, and not where they go. Bodies are told apart when they are encoded
            (:mod:`gsim3d.dynamics.bodies`).
        solid: with ``pushes``: what stops some rows of a body stops it as a whole in the same step, as bodies that are
            not soft need it where they fall far in a step.
    Geometry:
        grid_size: metres, edge of a cell at stage 0.
        history_bits: a history has 1 to 2^history_bits steps.
        strides, merge_windows: S - 1 powers of two: how much coarser the next stage is, how many time slots it merges.
        patch_sizes: rows that attend to each other.
        time_embedding: merged steps are told apart by a learned vector.
    Network:
        encoder_depths, encoder_channels, encoder_heads: S each.
        decoder_depths, decoder_channels, decoder_heads: S - 1 each, stages 0 to S - 2.
        mlp_ratio: hidden channels of a block's MLP over its channels.
        norm: "layer", or "batch" as published: evaluation uses running statistics, training those of the call's rows.
        zero_init: the last layer starts at zero: an untrained model that predicts differences predicts none.
        background: "symmetric": frozen rows are rows like others to the network, and their latents change;
            "asymmetric": frozen rows of the newest step read each other only, never change, and are computed once a
            rollout; the others read both (:mod:`gsim3d.dynamics.background`); "relightable": the network sees frozen
            rows in the newest step only and as they were when the simulation began; it predicts by how much their
            latents differ from that now, so that the errors of shadows do not add up; likewise the looks of bodies,
            where a plan lets them change. Weights fit all; train as you simulate.
    Training:
        drop_path: share of rows that skip a branch of a block, growing from 0 at the first block.
        shuffle_orders: the four curves of a stage change places at random.
        checkpointing: blocks are computed again in the backward pass instead of being kept.
    """

    dynamic_latents: int = 32
    static_latents: int = 32
    explicit: bool = False
    sh_degree: int = 3
    scale_min: float = 0.0002
    scale_max: float = 0.1
    predicts: str = "from_newest"
    steps_per_call: int = 1
    max_step: float | None = 0.5
    max_latent_step: float | None = None
    position_features: bool = False
    position_length: float = 1.0
    position_waves: int = 0
    motion_length: float | None = None
    velocity: bool = False
    deformation: bool = False
    turning: bool = False
    pushes: bool = False
    solid: bool = False
    gravity: tuple[float, float, float] | None = None
    contact_length: float | None = None
    lights: tuple[tuple[float, float, float], ...] = ()
    surfaces: bool = False
    grid_size: float = 0.004
    history_bits: int = 2
    strides: tuple[int, ...] = (4, 2, 2, 2)
    merge_windows: tuple[int, ...] = (2, 2, 2, 8)
    patch_sizes: tuple[int, ...] = (1024,) * 5
    time_embedding: bool = True
    encoder_depths: tuple[int, ...] = (2, 2, 2, 6, 2)
    encoder_channels: tuple[int, ...] = (32, 64, 128, 256, 512)
    encoder_heads: tuple[int, ...] = (2, 4, 8, 16, 32)
    decoder_depths: tuple[int, ...] = (2, 2, 2, 2)
    decoder_channels: tuple[int, ...] = (64, 64, 128, 256)
    decoder_heads: tuple[int, ...] = (4, 4, 8, 16)
    mlp_ratio: int = 4
    norm: str = "batch"
    zero_init: bool = False
    background: str = "symmetric"
    drop_path: float = 0.3
    shuffle_orders: bool = True
    checkpointing: bool = False

    def __post_init__(self):
        n = self.n_stages
        sizes = {
            "strides": n - 1, "merge_windows": n - 1, "patch_sizes": n,
            "encoder_depths": n, "encoder_heads": n,
            "decoder_depths": n - 1, "decoder_channels": n - 1, "decoder_heads": n - 1,
        }  # fmt: skip
        for name, size in sizes.items():
            if len(getattr(self, name)) != size:
                raise ValueError(
                    f"DynamicsConfig: {name} must have {size} entries, for {n} stages; got {getattr(self, name)}"
                )
        for name in ("encoder", "decoder"):
            for channels, heads in zip(getattr(self, f"{name}_channels"), getattr(self, f"{name}_heads"), strict=True):
                if channels % heads:
                    raise ValueError(f"DynamicsConfig: {name}_channels {channels} cannot be split into {heads} heads")
        if self.norm not in ("layer", "batch"):
            raise ValueError(f'DynamicsConfig: norm must be "layer" or "batch"; got {self.norm!r}')
        if self.predicts not in PREDICTS:
            raise ValueError(f"DynamicsConfig: predicts must be one of {', '.join(PREDICTS)}; got {self.predicts!r}")
        if not 0 <= self.history_bits <= MAX_HISTORY_BITS:
            raise ValueError(
                f"DynamicsConfig: history_bits must be from 0 to {MAX_HISTORY_BITS}; got {self.history_bits}"
            )
        if self.background not in BACKGROUNDS:
            raise ValueError(
                f"DynamicsConfig: background must be one of {', '.join(BACKGROUNDS)}; got {self.background!r}"
            )
        if self.is_asymmetric and self.norm == "batch":
            raise ValueError('DynamicsConfig: background="asymmetric" needs norm="layer"')
        if self.is_relightable and self.explicit:
            raise ValueError('DynamicsConfig: background="relightable" needs a model that is not explicit')
        if self.motion_length is not None and (self.predicts == "absolute" or not self.motion_length > 0):
            raise ValueError(
                'DynamicsConfig: motion_length must be positive, and predicts "from_newest" or "from_previous"; '
                f"got {self.motion_length} and {self.predicts!r}"
            )
        for name in ("velocity", "deformation"):
            if getattr(self, name) and self.motion_length is None:
                raise ValueError(f"DynamicsConfig: {name} needs motion_length")
        if self.contact_length is not None and (self.is_asymmetric or not self.contact_length > 0):
            raise ValueError(
                'DynamicsConfig: contact_length must be positive, and background "symmetric" or "relightable"; '
                f"got {self.contact_length} and {self.background!r}"
            )
        if any(len(light) != 3 or not any(light) for light in self.lights) or self.lights and self.is_asymmetric:
            raise ValueError(
                'DynamicsConfig: lights must be directions (x, y, z), and background "symmetric" or "relightable"; '
                f"got {self.lights} and {self.background!r}"
            )
        needed = (self.velocity, self.deformation, self.contact_length is not None, self.steps_per_call == 1)
        if self.gravity is not None and not (len(self.gravity) == 3 and all(needed)):
            raise ValueError(
                "DynamicsConfig: gravity must be an acceleration (x, y, z), of a model with velocity, deformation and "
                f"contact_length and one step a call; got {self.gravity}"
            )
        if self.pushes and self.gravity is None:
            raise ValueError("DynamicsConfig: pushes needs gravity")
        if self.solid and not self.pushes:
            raise ValueError("DynamicsConfig: solid needs pushes")
        if self.turning and (self.explicit or not self.velocity or self.steps_per_call > 1):
            raise ValueError("DynamicsConfig: turning needs velocity, a latent look (not explicit) and one step a call")
        if self.surfaces and not self.lights:
            raise ValueError("DynamicsConfig: surfaces needs lights")
        if not 0 <= self.position_waves <= MOST_WAVES or self.position_waves and not self.position_features:
            raise ValueError(
                f"DynamicsConfig: position_waves must be from 0 to {MOST_WAVES}, and 0 without position_features; "
                f"got {self.position_waves}"
            )
        if self.steps_per_call < 1:
            raise ValueError(f"DynamicsConfig: steps_per_call must be at least 1; got {self.steps_per_call}")
        lengths = ("position_length", "motion_length", "contact_length", "grid_size", "scale_max")
        check_ranges(self, **dict.fromkeys(lengths, (1e-6, 1e6)), scale_min=(0, self.scale_max))
        check_ranges(self, **dict.fromkeys(("max_step", "max_latent_step"), (0, 1e6)))
        check_ranges(self, **dict.fromkeys(("gravity", "lights"), (-1e6, 1e6)), drop_path=(0, 1), sh_degree=(0, 3))
        check_ranges(self, **dict.fromkeys(("dynamic_latents", "static_latents"), (0, 10**4)), mlp_ratio=(1, 100))
        counts = ("strides", "merge_windows", "patch_sizes", "encoder_heads", "decoder_heads", "steps_per_call")
        check_ranges(self, **dict.fromkeys((*counts, "encoder_channels", "decoder_channels"), (1, 10**5)))
        check_ranges(self, **dict.fromkeys(("encoder_depths", "decoder_depths"), (0, 100)))

    @property
    def n_stages(self) -> int:
        return len(self.encoder_channels)

    @property
    def place_channels(self) -> int:
        """Channels of what is predicted of places beside shares of motions."""
        return 0 if self.pushes else 3

    @property
    def is_asymmetric(self) -> bool:
        return self.background == "asymmetric"

    @property
    def is_relightable(self) -> bool:
        return self.background == "relightable"

    @property
    def origin_of_scene(self) -> bool:
        """Whether cells are counted from the origin of a scene, so that scenes do not see each other."""
        return True

    @property
    def slots_from_newest(self) -> bool:
        """Whether steps are counted back from the newest, so that it has one place in histories of any length."""
        return True

    @property
    def max_opacity(self) -> float:
        """The largest opacity of a particle."""
        return 1.0

    @property
    def frozen_turn(self) -> bool:
        """Whether frozen explicit particles change their orientation."""
        return False

    def pyramid_spec(self, history_bits: int) -> PyramidSpec:
        """What the geometry op needs to know, for a history of up to 2^history_bits steps."""
        return PyramidSpec(
            grid_size=self.grid_size,
            slot_bits=history_bits,
            strides=tuple(self.strides),
            merge_windows=tuple(self.merge_windows),
            patch_sizes=tuple(self.patch_sizes),
            kernel_sizes=((STEM_KERNEL, BLOCK_KERNEL),) + ((BLOCK_KERNEL,),) * (self.n_stages - 1),
            release=not self.origin_of_scene,
        )

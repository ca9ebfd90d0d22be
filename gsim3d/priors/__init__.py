"""Priors: hand-made physics for the learned dynamics, each a module with attributes, features and gains.

``DynamicsConfig.priors`` lists the priors of a model in order of application. It is empty by default.
"""

from gsim3d.priors.base import Motion, Prior, PriorConfig, PriorList, StepContext
from gsim3d.priors.contact import Contact, ContactConfig
from gsim3d.priors.gravity import Gravity, GravityConfig
from gsim3d.priors.inertia import Inertia, InertiaConfig
from gsim3d.priors.lighting import DirectionalLightConfig, LambertianLight, OcclusionLight
from gsim3d.priors.position_waves import PositionWaves, PositionWavesConfig
from gsim3d.priors.proximity import Proximity, ProximityConfig
from gsim3d.priors.segmentation import Segmentation, SegmentationConfig
from gsim3d.priors.shape_matching import ShapeMatching, ShapeMatchingConfig
from gsim3d.priors.velocity import Velocity, VelocityConfig
from gsim3d.priors.velocity_from_images import VelocityFromImages, VelocityFromImagesConfig

__all__ = [
    "Contact",
    "ContactConfig",
    "DirectionalLightConfig",
    "Gravity",
    "GravityConfig",
    "Inertia",
    "InertiaConfig",
    "LambertianLight",
    "Motion",
    "OcclusionLight",
    "PositionWaves",
    "PositionWavesConfig",
    "Prior",
    "PriorConfig",
    "PriorList",
    "Proximity",
    "ProximityConfig",
    "Segmentation",
    "SegmentationConfig",
    "ShapeMatching",
    "ShapeMatchingConfig",
    "StepContext",
    "Velocity",
    "VelocityConfig",
    "VelocityFromImages",
    "VelocityFromImagesConfig",
]

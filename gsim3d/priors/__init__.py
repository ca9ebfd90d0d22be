"""Hand-made physics: priors that a learned dynamics may be given, each a module with attributes, inputs and gains.

A model has none by default. ``DynamicsConfig.priors`` lists those of a model, in the order in which they apply.
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
    "VelocityFromImages",
    "VelocityFromImagesConfig",
]

"""The arm and its world: specification, simulation, sensing, control and deployment."""

from mjx_softarm.spec import ArmSpec, SpecError

__all__ = ["ArmSpec", "SpecError"]
__version__ = "0.1.0"

"""A trained policy on an arm, without JAX: read the exported file, act, and talk to the hardware."""

from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.runtime import PolicyRunner, Reference
from mjx_softarm.export import Policy, PolicyFileError, load_policy

__all__ = ["ArmIO", "Policy", "PolicyFileError", "PolicyRunner", "Reference", "load_policy"]

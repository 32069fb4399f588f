"""A trained policy on an arm, without JAX: read the exported file, act, and talk to the hardware."""

from mjx_softarm.archive import SealedFileError
from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.deploy.runtime import PolicyRunner, Reference
from mjx_softarm.export import Policy, load_policy

__all__ = ["ArmIO", "Policy", "PolicyRunner", "Reference", "SealedFileError", "load_policy"]

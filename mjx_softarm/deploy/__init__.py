"""A trained policy on an arm, without JAX: read the exported file, act, and talk to the hardware."""

from mjx_softarm._support.archive import SealedFileError
from mjx_softarm.deploy.arm_io import ArmIO
from mjx_softarm.policy.file import Policy, load_policy
from mjx_softarm.policy.runtime import PolicyRunner, Reference

__all__ = ["ArmIO", "Policy", "PolicyRunner", "Reference", "SealedFileError", "load_policy"]

"""A policy and its control loop as C++ sources: a header with all numbers, two programs, a CMake file."""

from __future__ import annotations

from importlib import resources

from mjx_softarm.deploy.controller import Controller
from mjx_softarm.deploy.safety import Fault, Response
from mjx_softarm.export.computations import parts
from mjx_softarm.export.cpp_functions import Numbers, function
from mjx_softarm.export.golden import FLAGS, PROGRAM_VERSION
from mjx_softarm.mdp.observation import rate_ticks
from mjx_softarm.policy.file import file_entries
from mjx_softarm.policy.reach import N_STEPS, begin
from mjx_softarm.sensing.load import HIGHEST, JUMP, LOWEST, N_AVERAGED, N_JUMPS, QUANTILE

_TEMPLATES = ("softarm.hpp.in", "rows.cpp", "example.cpp", "CMakeLists.txt")


def sources(controller: Controller, policy_sha256: str) -> dict[str, str]:
    """Return the text of each file by its name."""
    # Functions and numbers of the policy.
    policy, config = controller.policy, controller.config
    numbers = Numbers(file_entries(policy))
    functions = [function(name, part, numbers) for name, part in parts(controller).items()]
    faults = [f"  {fault.name} = 1u << {k},  // {fault.response.value}" for k, fault in enumerate(Fault)]
    vents = [fault.name for fault in Fault if fault.response is Response.VENT]
    most_kg = float(policy.load_estimator.load_scale_kg)
    # Values of the templates' marks.
    values = {
        "SHA256": policy_sha256,
        "PROGRAM_VERSION": PROGRAM_VERSION,
        "N_FLAGS": len(FLAGS),
        "N_SPRINGS": policy.spec.n_springs,
        "N_CHAMBERS": policy.spec.n_chambers,
        "RATE": f"{policy.rate_hz:g}",
        "PERIOD": repr(controller.dt_s),
        "UNIT": policy.sensor.unit,
        "FAULTS": "\n".join(faults),
        "N_FAULTS": len(Fault),
        "VENTS": " | ".join([*vents, "NOT_FINITE"]),
        "NUMBERS": numbers.text(),
        "PARTS": "\n".join(functions),
        "WINDOW": controller.window,
        "N_ACTIONS": policy.n_actions,
        "ACTION": repr(float(policy.action_s)),
        "RATE_TICKS": rate_ticks(policy.rate_hz),
        "LOST_TICKS": config.lost_ticks,
        "LATE_TICKS": config.late_ticks,
        "REST_TICKS": config.rest_windows * controller.window,
        "MOVING_TICKS": config.moving_windows * controller.window,
        "TIMEOUT": repr(config.settle_timeout_s),
        "SEARCH": begin(policy, 1).size,
        "SEARCH_STEPS": N_STEPS,
        "THRESHOLD": repr(policy.reward.threshold),
        "OBSERVES_LOAD": str(controller.observes_payload).lower(),
        "OWN_LOAD": repr(policy.spec.mass.payload_kg),
        "QUANTILE": repr(QUANTILE),
        "LEAST_LOAD": repr(LOWEST * most_kg),
        "GREATEST_LOAD": repr(HIGHEST * most_kg),
        "LOAD_KNOWN": repr(config.load_known * most_kg),
        "OVERLOAD": repr(config.overload * most_kg),
        "JUMP": repr(JUMP * most_kg),
        "N_JUMPS": N_JUMPS,
        "N_AVERAGED": N_AVERAGED,
        "LEAST_SHARE": repr(min(config.shares)),
        "MAX_SHIFT": ", ".join(map(repr, config.shift_limit.tolist())),
        "N_CORRECTIONS": config.n_corrections,
        "CORRECTION_SHARE": repr(config.correction_share),
        "GOAL": ", ".join(f"{value:.1f}" for value in policy.workspace[0]),
    }
    # Fill the templates.
    texts = {}
    for template in _TEMPLATES:
        text = resources.files("mjx_softarm").joinpath(f"export/templates/{template}").read_text("utf-8")
        for key, value in values.items():
            text = text.replace(f"@{key}@", str(value))
        texts[template.removesuffix(".in")] = text
    return texts

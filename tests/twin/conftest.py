"""Commands for twins."""

import numpy as np

KPA = np.array([-12.0, 3, -20, -5, -30, 4, 2, -9, -14])
PRESSURES_KPA = np.array([np.zeros(9), KPA, [5, -20, -8, -3, 8, -25, -15, 6, -6]])


def hold(arm, pressure_kpa, duration_s):
    """Write pressures, one for each chamber or one number for nine, over a time; return the arm."""
    for _ in range(round(50 * duration_s)):
        arm.write_pressures(np.full(9, pressure_kpa) if np.isscalar(pressure_kpa) else pressure_kpa)
    return arm

"""Errors of a calibration; `mjx_softarm.logs.checks` has the errors of logs."""

from mjx_softarm._support.errors import InputError


class FitError(InputError):
    """Fit that the data do not allow; the message names what came and what was expected."""

"""Errors of a calibration, besides those of logs."""

from mjx_softarm._support.errors import InputError


class FitError(InputError):
    """Fit that the data do not allow; the message names what came and what was expected."""

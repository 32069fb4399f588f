"""What can keep a calibration from its end, besides logs that cannot be used."""

from mjx_softarm._support.errors import InputError


class FitError(InputError):
    """A fit that the data do not allow; the message says what was expected and what came."""

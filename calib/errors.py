"""What can keep a calibration from its end, besides logs that cannot be used."""


class FitError(ValueError):
    """A fit that the data do not allow; the message says what was expected and what came."""

"""The base of all errors that a user can put right."""


class InputError(ValueError):
    """An input that cannot be used; the message names the input, what was got and what was expected."""

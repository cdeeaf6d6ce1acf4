"""What can be wrong with recorded data; re-exported by schema.py."""


class DataError(ValueError):
    """Recorded data that cannot be used; the message names the file, what was expected and how to go on."""


class DataWarning(UserWarning):
    """Recorded data that can be used in part; the message counts what is left out."""

"""What a user's mistake raises, and what is said of an assumption: one line that names the file and the finding."""

from __future__ import annotations


class InputError(ValueError):
    """An input is not usable; the message is a line that can be shown to the user as it is."""


class InputWarning(UserWarning):
    """An input was ambiguous and a convention was assumed; the message is a line that says which."""

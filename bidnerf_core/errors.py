"""What a user's mistake is told as: one line that names the file, the finding and the expectation."""

from __future__ import annotations


class InputError(ValueError):
    """Something that was given is not usable; the message is fit to be shown as it is."""

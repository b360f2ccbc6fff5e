"""What an ``InputError`` says, compared field by field."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from bidnerf_core.errors import InputError


class Caught:
    """The error that ``refused`` caught, known once its block has ended."""

    error: InputError


@contextmanager
def refused(
    *,
    where: object = None,
    found: object = None,
    expected: object = None,
    error: type[InputError] = InputError,
) -> Iterator[Caught]:
    """Assert that the block raises ``error``, whose message is one line and whose fields contain what is given.

    Each given value must be in the field of its name as a whole token: 1 is not in "-1", "1.5" or "11", and
    "a.json" is in "/data/a.json" but not in "/data/aa.json", "a.json.bak" or "a.json/b"::

        with refused(where=path, found="fx is -1", expected="positive") as caught:
            read_camera(path)
        assert type(caught.error) is InputError
    """
    caught = Caught()
    with pytest.raises(error) as raised:
        yield caught
    caught.error = raised.value
    message = str(caught.error)
    assert len(message.splitlines()) == 1, f"the message is not one line: {message!r}"
    for field, given in (("where", where), ("found", found), ("expected", expected)):
        value = getattr(caught.error, field)
        assert given is None or (value is not None and contains(value, given)), (
            f"{str(given)!r} is not in {field} = {value!r} of: {message}"
        )


def contains(text: str, given: object) -> bool:
    """Return whether ``str(given)`` is in ``text`` and is no part of a longer word, number or file name there."""
    token = str(given)
    before = r"(?<![\w.-])" if isinstance(given, int | float) else r"(?<!\w)(?<!\d\.)"
    pattern = (before if re.match(r"\w", token) else "") + re.escape(token)
    return re.search(pattern + (r"(?![.-]?\w|/)" if re.search(r"\w$", token) else ""), text) is not None

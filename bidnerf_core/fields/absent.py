"""The field of a map that has none: it takes the place of one, and says so when it is used."""

from __future__ import annotations

from typing import NoReturn

from torch import nn

from bidnerf_core.errors import InputError
from bidnerf_core.fields.contract import RadianceField
from bidnerf_core.fields.sampling import trained_field


class NoField(nn.Module):
    """The field of a map of landmarks alone. Sampling or querying it raises ``InputError``, which says how to add one."""

    def sampler(self, *_: object) -> NoReturn:
        raise InputError(
            "the map has no radiance field, which this needs; 'bidnerf train DATA --out MAP' adds one"
        )

    query = sampler


def has_field(field: RadianceField) -> bool:
    """Return whether there is a field behind the name, see ``NoField``."""
    return not isinstance(trained_field(field), NoField)

"""The run-time checker that the tests put on every annotated function of the project."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

# An int is welcome where a float is asked for (PEP 484); beartype says otherwise by default.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))

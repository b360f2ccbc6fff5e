"""Other protocols by which clients may ask for poses, as plugins of the group ``bidnerf.services``.

A protocol's name is its path: the service answers it at ``/NAME``, and at ``/maps/MAP/NAME`` for a map. A GET is answered with
``{"status": "running"}``, and a POST with what the plugin makes of its JSON.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from bidnerf_core.registry import Plugins, interface_defects

if TYPE_CHECKING:
    from pydantic import BaseModel

    from bidnerf_core.maps import Map
    from bidnerf_core.results import Answer
    from bidnerf_core.service.models import Upload


class ServiceProtocol(Protocol):
    """A protocol of the service. The process that listens imports it too, so its module must not import PyTorch."""

    @property
    def summary(self) -> str:
        """One line that says what is answered."""

    @property
    def request(self) -> type[BaseModel]:
        """The model of a request, which has been checked when ``answer`` is called."""

    @property
    def response(self) -> type[BaseModel]:
        """The model of an answer, for the description."""

    @property
    def media_type(self) -> str:
        """The type of answers to clients that accept its first part, before the semicolon; others get ``application/json``."""

    def answer(
        self, body: dict[str, Any], scene: Map, localize: Callable[[Upload], tuple[Answer, dict[str, Any]]]
    ) -> dict[str, Any]:
        """Return the JSON of an answer.

        ``body`` is the JSON of the request. ``localize`` finds the pose of a photo in the map ``scene``, and returns it also
        as the JSON of ``bidnerf localize``. Raises ``InputError``, answered with 422, and ``Refused``.
        """


PROTOCOLS: Plugins[ServiceProtocol] = Plugins(
    "services",
    partial(
        interface_defects,
        attributes=("summary", "request", "response", "media_type"),
        methods={"answer": ("body", "scene", "localize")},
    ),
)

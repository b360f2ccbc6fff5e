"""Interface of further protocols for requesting poses, which are plugins of the group ``bidnerf.services``.

The name of a protocol is its path: the service answers at ``/NAME``, and at ``/maps/MAP/NAME`` for the map ``MAP``. A GET
request returns ``{"status": "running"}``, and a POST request returns the plugin's answer to the JSON that was sent.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from bidnerf_core.registry import Plugins, interface_defects

if TYPE_CHECKING:
    from pydantic import BaseModel

    from bidnerf.results import Answer
    from bidnerf.service.models import Upload
    from bidnerf_core.maps import Map


class ServiceProtocol(Protocol):
    """Interface of a service protocol. The listening process imports it too, so its module must not import PyTorch."""

    @property
    def summary(self) -> str:
        """One line that describes the answers of the protocol."""

    @property
    def request(self) -> type[BaseModel]:
        """The model of a request; the request is validated against it before ``answer`` is called."""

    @property
    def response(self) -> type[BaseModel]:
        """The model of an answer, for the OpenAPI description."""

    @property
    def media_type(self) -> str:
        """The media type of answers to clients that accept its part before the semicolon; other clients get ``application/json``."""

    def answer(
        self, body: dict[str, Any], scene: Map, localize: Callable[[Upload], tuple[Answer, dict[str, Any]]]
    ) -> dict[str, Any]:
        """Return the JSON object that answers a request.

        ``body`` is the JSON object of the request. ``localize`` finds the pose of a photo in the map ``scene``, and
        returns the answer together with its JSON as printed by ``bidnerf localize``. May raise ``InputError``, which
        the service reports with status 422, or ``Refused``, which has a status of its own.
        """


SERVICES: Plugins[ServiceProtocol] = Plugins(
    "services",
    partial(
        interface_defects,
        attributes=("summary", "request", "response", "media_type"),
        methods={"answer": ("body", "scene", "localize")},
    ),
)

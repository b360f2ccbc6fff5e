"""The OpenAPI description of the service: every path, parameter, status and header."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from bidnerf_core.service.requests import LONGEST_NAME
from bidnerf_core.service.settings import ServiceLimits
from bidnerf_core.settings import LARGEST_SEED

NUMBER, TEXT, COUNT = {"type": "number"}, {"type": "string"}, {"type": "integer", "minimum": 0}
NULLABLE, OBJECT = {"type": ["number", "null"]}, {"type": "object"}
JSON, PROBLEM = "application/json", "application/problem+json"
DEFAULT_MAP = "by default the one that the photo shows"
ERRORS = {
    400: "The request is malformed: the detail states what was found and what is expected.",
    401: "The request does not carry the token of the service.",
    403: "Without a token, only programs on the service's own machine may send requests.",
    404: "There is no such map.",
    408: "The request did not arrive in time.",
    413: "The request is too large.",
    422: "The photo cannot be read or localized at all, or what is known about it contradicts it.",
    429: "The service is full.",
    500: "An error in the service itself, which its log describes.",
    503: "No worker is currently alive.",
    504: "The answer took too long.",
}
HEADERS = {
    "Cache-Control": "Answers are never cached: no-store.",
    "Content-Security-Policy": "Nothing in an answer is ever run or framed.",
    "X-Content-Type-Options": "The type of an answer is not to be guessed: nosniff.",
    "Retry-After": "Whole seconds after which to try again.",
    "WWW-Authenticate": "How to authenticate: Bearer.",
}
ALWAYS = ("Cache-Control", "Content-Security-Policy", "X-Content-Type-Options")
"""Headers of every response."""
ALSO = {401: ("WWW-Authenticate",), 429: ("Retry-After",), 503: ("Retry-After",)}
"""Further headers by status."""


def description(maps: Sequence[str], limits: ServiceLimits, protected: bool = False) -> dict[str, Any]:
    """Return the OpenAPI description of a service with these maps; clients of a ``protected`` one need its token."""
    at_map = {"parameters": [_in_path(maps)]}
    one, several = _Responses(401 if protected else 403), len(maps) > 1
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "bidnerf",
            "version": version("bidnerf"),
            "description": "Poses of photos in radiance fields. Poses are camera to world with OpenCV axes (x right, y down, z"
            f" forward). A request has at most {limits.max_megabytes:g} MiB, an image at most {limits.max_megapixels:g}"
            f" megapixels. Errors are {PROBLEM}; a method that a path lacks results in 405.",
        },
        "paths": {
            "/": {"get": one.get("The version, the maps and where this description is.", "Service")},
            "/health": {"get": one.get("Whether the service is up; needs no token.", "Health", 503, open=True)},
            "/metrics": {"get": one.get("Counters and times for Prometheus.", TEXT, kind="text/plain")},
            "/openapi.json": {"get": one.get("This description.", OBJECT)},
            "/maps": {"get": one.get("The maps by name, with facts about each.", {**OBJECT, "additionalProperties": _ref("Map")})},
            "/maps/{map}": at_map | {"get": one.get("Facts about a map.", "Map", 404)},
            "/localize": {"post": _localize(one, maps)},
            "/maps/{map}/localize": at_map | {"post": _localize(one, None)},
            "/geopose": {"get": _running(one), "post": _geopose(one, _map_parameter(maps, several))},
            "/maps/{map}/geopose": at_map | {"get": _running(one, 404), "post": _geopose(one, [])},
        },
        "components": {
            "schemas": SCHEMAS,
            "headers": {name: {"description": text, "required": True, "schema": _header(name)} for name, text in HEADERS.items()},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}} if protected else {},
        },
        "security": [{"token": []}] if protected else [],
    }  # fmt: skip


class _Responses:
    """The responses of a service which refuses strangers with the status ``refusal``."""

    def __init__(self, refusal: int) -> None:
        self._refusal = refusal

    def of(
        self, summary: str, content: Mapping[str, Any], *errors: int, open: bool = False
    ) -> dict[str, Any]:
        """Return all responses: that of success, with its content by media type, and those of ``errors``."""
        refusals = [] if open and self._refusal == 401 else [self._refusal]
        problem = {PROBLEM: {"schema": _ref("Problem")}}
        return {"200": {"description": summary, "content": content, "headers": _headers(200)}} | {
            str(status): {"description": ERRORS[status], "content": problem, "headers": _headers(status)}
            for status in sorted((*errors, *refusals, 500))
        }

    def get(self, summary: str, schema: Any, *errors: int, kind: str = JSON, open: bool = False) -> Any:
        """Return an operation without parameters; ``schema`` may be the name of one."""
        content = {kind: {"schema": _ref(schema) if isinstance(schema, str) else schema}}
        said = {"summary": summary, "responses": self.of(summary, content, *errors, open=open)}
        return said | ({"security": []} if open else {})


def _ref(name: str) -> dict[str, str]:
    return {"$ref": f"#/components/schemas/{name}"}


def _headers(status: int) -> dict[str, Any]:
    names = (*ALWAYS, *ALSO.get(status, ()))
    return {name: {"$ref": f"#/components/headers/{name}"} for name in names}


def _header(name: str) -> dict[str, Any]:
    return {"type": "integer", "minimum": 1} if name == "Retry-After" else TEXT


def _object(required: Mapping[str, Any], optional: Mapping[str, Any] | None = None, **more: Any) -> Any:
    return {"type": "object", "required": [*required], "properties": {**required, **(optional or {})}, **more}


def _rows(count: int, **more: Any) -> dict[str, Any]:
    def exactly(items: Any) -> dict[str, Any]:
        return {"type": "array", "items": items, "minItems": count, "maxItems": count}

    return exactly(exactly(NUMBER)) | more


# Requests.


def _in_path(maps: Sequence[str]) -> Any:
    return {"name": "map", "in": "path", "required": True, "schema": {"type": "string", "enum": [*maps]}}


def _map_parameter(maps: Sequence[str], required: bool) -> list[Any]:
    schema = {"type": "string", "enum": [*maps]}
    return [{"name": "map", "in": "query", "required": required, "schema": schema}]


FIELDS: dict[str, Any] = {
    "name": {**TEXT, "minLength": 1, "maxLength": LONGEST_NAME, "description": "the frame's name in the answer"},
    "focal": {**NUMBER, "minimum": 0.001, "maximum": 1e9, "description": "focal length in pixels of the stored image"},
    "hfov": {**NUMBER, "minimum": 0.001, "maximum": 179.999, "description": "horizontal field of view in degrees"},
    "depth_unit": {**NUMBER, "minimum": 1e-9, "maximum": 1e9, "description": "metres per step of the depth image"},
    "seed": {"type": "integer", "minimum": 0, "maximum": LARGEST_SEED, "description": "seed of every random choice"},
    "camera": {**TEXT, "description": "the content of a camera file: transforms.json, cameras.json or cameras.txt"},
    "start": {**TEXT, "description": "JSON with a 4x4 T_world_camera to start from"},
}  # fmt: skip


def _localize(responses: _Responses, maps: Sequence[str] | None) -> Any:
    chosen = {"map": {"type": "string", "enum": [*maps], "description": DEFAULT_MAP}} if maps else {}
    file = {"type": "string", "format": "binary"}
    depth = {**file, "description": "a depth image, or the .npy of an array: planar z"}
    form = _object(
        {"photo": {**file, "description": "an image file"}},
        {"depth": depth, **chosen, **FIELDS},
        additionalProperties=False,
    )
    return {
        "summary": "Find the pose of a photo.",
        "description": "The response is that of 'bidnerf localize --json', in several maps if none is named. Never use a pose whose"
        " 'converged' is false. Each field is given once, in the query or in the form; at most one of focal, hfov and camera.",
        "parameters": [
            {"name": n, "in": "query", "schema": schema} for n, schema in (chosen | FIELDS).items()
        ],
        "requestBody": {
            "required": True,
            "content": {
                "multipart/form-data": {"schema": form}, "image/*": {"schema": file}, "application/octet-stream": {"schema": file},
            },
        },
        "responses": responses.of(
            "The pose, and whether it can be trusted.", {JSON: {"schema": _ref("Localization")}},
            400, 404, 408, 413, 422, 429, 504,
        ),
    }  # fmt: skip


def _running(responses: _Responses, *errors: int) -> Any:
    schema = _object({"status": {"type": "string", "enum": ["running"]}})
    return responses.get("Whether the endpoint is up.", schema, *errors)


def _geopose(responses: _Responses, parameters: list[Any]) -> Any:
    answered = {"schema": _ref("GeoPose")}
    return {
        "summary": "Find the pose of a photo on the earth (OSCP GeoPose Protocol, version 2).",
        "description": "A map without an anchor responds with localpose, in the map's frame, instead of"
        " geopose. The quaternion rotates from x forward, y left, z up at the camera. An"
        " untrusted pose results in status 422.",
        "parameters": parameters,
        "requestBody": {"required": True, "content": {JSON: {"schema": _ref("GeoPoseRequest")}}},
        "responses": responses.of(
            "The pose and its accuracy.", {JSON: answered, "application/vnd.oscp+json;version=2.0": answered},
            400, 404, 408, 413, 422, 429, 504,
        ),
    }  # fmt: skip


# Schemas.


def _axes(*names: str) -> Any:
    return _object(dict.fromkeys(names, NUMBER))


LOCALIZATION = _object(
    {
        "frame": TEXT,
        "T_world_camera": _rows(4, description="camera to world"),
        "converged": {"type": "boolean", "description": "whether the pose can be trusted"},
        "outcome": TEXT, "reason": TEXT, "steps": COUNT, "seconds": NUMBER,
        "covariance": _rows(
            6, type=["array", "null"], description="of a right update at the camera: translation before rotation"
        ),
        "loss": NULLABLE, "method": TEXT, "focal_factor": NULLABLE, "intrinsics": {"type": ["object", "null"]},
        "confidence": NULLABLE, "unit": {"type": "string", "enum": ["metres", "units"]}, "backend": TEXT,
        "error": {"type": "null"},
    },
    {
        "map": {**TEXT, "description": "of several maps, the one that the photo shows"},
        "similarity": {**NUMBER, "description": "of the photo and that map"},
        "runner_up": {"type": ["object", "null"], "description": "the second best of several maps"},
    },
)  # fmt: skip
POSITION = _axes("lon", "lat", "h")
QUATERNION = _axes(*"xyzw")
READING = _object(
    {"imageBytes": {**TEXT, "minLength": 1, "description": "an image file, or pixels of imageFormat, in base64"}},
    {
        "sensorId": TEXT, "imageFormat": TEXT,
        "size": {
            "type": "array", "items": {"type": "integer", "minimum": 1, "maximum": 1_000_000}, "minItems": 2, "maxItems": 2,
            "description": "width and height",
        },
        "params": _object({}, {"model": TEXT, "modelParams": {"type": "array", "items": NUMBER}}),
    },
)  # fmt: skip
SENSOR = _object({}, {"id": TEXT, "type": TEXT})
PRIOR = _object({"geopose": _object({"position": POSITION, "quaternion": QUATERNION})})
SCHEMAS: dict[str, Any] = {
    "Localization": LOCALIZATION,
    "Problem": _object({"title": TEXT, "status": {"type": "integer"}, "detail": TEXT}, {"localization": _ref("Localization")}, description="RFC 9457"),
    "Service": _object({"bidnerf": TEXT, "maps": {"type": "array", "items": TEXT}, "description": TEXT}),
    "Health": _object({"status": {"type": "string", "enum": ["ok"]}, "workers": COUNT, "waiting": COUNT}),
    "Map": _object({
        "backend": TEXT, "cameras": COUNT, "landmarks": COUNT, "surfels": COUNT, "unit": {"type": "string", "enum": ["metres", "units"]},
        "distances": {"type": "boolean", "description": "whether its photos determine distances"},
        "bounds": OBJECT, "complete": {"type": "boolean", "description": "whether its training was finished"},
        "bidnerf": {**TEXT, "description": "the version that wrote it"}, "anchor": {"type": ["object", "null"]},
    }),
    "GeoPoseRequest": _object(
        {"sensorReadings": _object({"cameraReadings": {"type": "array", "items": READING, "minItems": 1, "maxItems": 1}})},
        {
            "id": TEXT, "timestamp": NUMBER, "type": TEXT, "sensors": {"type": "array", "items": SENSOR},
            "priorPoses": {"type": "array", "items": PRIOR},
        },
    ),
    "GeoPose": _object(
        {
            "id": TEXT, "timestamp": NUMBER,
            "accuracy": {
                "type": ["object", "null"], "description": "standard deviations: metres along each axis, degrees about each",
                "required": ["position", "orientation"], "properties": {"position": NUMBER, "orientation": NUMBER},
            },
            "type": {"type": "string", "enum": ["geopose", "localpose"]},
        },
        {
            "geopose": _object({"position": POSITION, "quaternion": QUATERNION}),
            "localpose": _object({"position": _axes(*"xyz"), "quaternion": QUATERNION}),
            "localization": _ref("Localization"),
        },
    ),
}  # fmt: skip

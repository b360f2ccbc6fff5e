"""The OpenAPI description of the service."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from bidnerf_core.service.requests import LONGEST_NAME
from bidnerf_core.service.settings import ServiceConfig
from bidnerf_core.settings import LARGEST_SEED

NUMBER, TEXT = {"type": "number"}, {"type": "string"}
MATRIX = {"type": "array", "items": {"type": "array", "items": NUMBER}}
DEFAULT_MAP = "by default the one that the photo shows"
ERRORS = {
    400: "The request is malformed: the detail states what was found and what is expected.",
    401: "The service has a token, and the request does not carry it.",
    403: "Without a token, only programs on the service's own machine may send requests.",
    404: "There is no such map.",
    408: "The request did not arrive in time.",
    413: "The request is too large.",
    422: "The photo cannot be read or localized at all.",
    429: "The service is full; Retry-After states when to try again.",
    503: "No worker is currently alive.",
    504: "The answer took too long.",
}


def description(maps: Sequence[str], config: ServiceConfig) -> dict[str, Any]:
    """Return the OpenAPI description of a service with these maps."""
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "bidnerf",
            "version": version("bidnerf"),
            "description": "Poses of photos in radiance fields. Poses are camera to world with OpenCV axes (x right, y down, z"
            f" forward). A request has at most {config.max_megabytes:g} MiB, an image at most {config.max_megapixels:g}"
            " megapixels.",
        },
        "paths": {
            "/health": {"get": _get("Whether the service is up; needs no token.", {"type": "object"}, open=True, also=(503,))},
            "/metrics": {"get": _get("Counters and times for Prometheus.", TEXT, "text/plain")},
            "/maps": {"get": _get("The maps by name, with information about each.", {"type": "object"})},
            "/maps/{map}": {"parameters": [_in_path(maps)], "get": _get("A map.", {"type": "object"}, also=(404,))},
            "/localize": {"post": _localize(maps)},
            "/maps/{map}/localize": {"parameters": [_in_path(maps)], "post": _localize(None)},
            "/geopose": {"post": _geopose(maps), "get": _get("Whether the endpoint is up.", {"type": "object"})},
            "/maps/{map}/geopose": {"parameters": [_in_path(maps)], "post": _geopose(None)},
        },
        "components": {
            "schemas": {"Localization": _localization(), "Problem": _problem(), "GeoPose": _geopose_answer()},
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{"token": []}, {}],
    }  # fmt: skip


def _get(
    summary: str, schema: Any, kind: str = "application/json", open: bool = False, also: Sequence[int] = ()
) -> Any:
    responses = {"200": {"description": summary, "content": {kind: {"schema": schema}}}}
    return {"summary": summary, "responses": responses | _errors(*([] if open else [401, 403]), *also)}


def _errors(*statuses: int) -> dict[str, Any]:
    content = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {str(status): {"description": ERRORS[status], "content": content} for status in statuses}


def _in_path(maps: Sequence[str]) -> Any:
    return {"name": "map", "in": "path", "required": True, "schema": {"type": "string", "enum": [*maps]}}


def _fields() -> dict[str, Any]:
    return {
        "name": {
            **TEXT,
            "minLength": 1,
            "maxLength": LONGEST_NAME,
            "description": "the frame's name in the answer",
        },
        "focal": {
            **NUMBER,
            "minimum": 0.001,
            "maximum": 1e9,
            "description": "focal length in pixels of the stored image",
        },
        "hfov": {
            **NUMBER,
            "minimum": 0.001,
            "maximum": 179.999,
            "description": "horizontal field of view in degrees",
        },
        "depth_unit": {
            **NUMBER,
            "minimum": 1e-9,
            "maximum": 1e9,
            "description": "metres per step of the depth image",
        },
        "seed": {
            "type": "integer",
            "minimum": 0,
            "maximum": LARGEST_SEED,
            "description": "seed of every random choice",
        },
        "camera": {
            **TEXT,
            "description": "the content of a camera file: transforms.json, cameras.json or cameras.txt",
        },
        "start": {**TEXT, "description": "JSON with a 4x4 T_world_camera to start from"},
    }


def _query(maps: Sequence[str] | None) -> list[Any]:
    chosen = {"map": {"type": "string", "enum": [*maps], "description": DEFAULT_MAP}} if maps else {}
    return [{"name": n, "in": "query", "schema": schema} for n, schema in (chosen | _fields()).items()]


def _localize(maps: Sequence[str] | None) -> Any:
    file = {"type": "string", "format": "binary"}
    form = {
        "type": "object", "required": ["photo"], "additionalProperties": False,
        "properties": {
            "photo": {**file, "description": "an image file"},
            "depth": {**file, "description": "a depth image, or the .npy of an array: planar z"},
            **({"map": {"type": "string", "enum": [*maps], "description": DEFAULT_MAP}} if maps else {}), **_fields(),
        },
    }  # fmt: skip
    answer = {"application/json": {"schema": {"$ref": "#/components/schemas/Localization"}}}
    return {
        "summary": "Find the pose of a photo.",
        "description": "The response is that of 'bidnerf localize --json', in several maps if none is named. Never use a pose whose 'converged' is"
                " false.",
        "parameters": _query(maps),
        "requestBody": {
            "required": True,
            "content": {
                "multipart/form-data": {"schema": form}, "image/*": {"schema": file}, "application/octet-stream": {"schema": file},
            },
        },
        "responses": {"200": {"description": "The pose, and whether it can be trusted.", "content": answer}}
        | _errors(400, 401, 403, 404, 408, 413, 422, 429, 503, 504),
    }  # fmt: skip


def _geopose(maps: Sequence[str] | None) -> Any:
    reading = {
        "type": "object", "required": ["imageBytes"],
        "properties": {
            "imageBytes": {**TEXT, "description": "an image file, or pixels of imageFormat, in base64"},
            "imageFormat": TEXT, "size": {"type": "array", "items": {"type": "integer", "minimum": 1}},
            "params": {
                "type": "object",
                "properties": {"model": TEXT, "modelParams": {"type": "array", "items": NUMBER}},
            },
        },
    }  # fmt: skip
    request = {
        "type": "object", "required": ["sensorReadings"],
        "properties": {
            "id": TEXT, "timestamp": NUMBER, "type": TEXT, "sensors": {"type": "array"},
            "sensorReadings": {
                "type": "object", "required": ["cameraReadings"],
                "properties": {"cameraReadings": {"type": "array", "items": reading, "minItems": 1, "maxItems": 1}},
            },
            "priorPoses": {"type": "array", "items": {"type": "object"}},
        },
    }  # fmt: skip
    schema = {"schema": {"$ref": "#/components/schemas/GeoPose"}}
    answered = {"application/json": schema, "application/vnd.oscp+json;version=2.0": schema}
    return {
        "summary": "Find the pose of a photo on the earth (OSCP GeoPose Protocol, version 2).",
        "description": "A map without an anchor responds with localpose, in the map's frame, instead of"
        " geopose. The quaternion rotates from x forward, y left, z up at the camera. An"
        " untrusted pose results in status 422.",
        "parameters": [
            p | {"required": len(maps or ()) > 1, "schema": {"type": "string", "enum": [*(maps or ())]}}
            for p in _query(maps)
            if p["name"] == "map"
        ],
        "requestBody": {"required": True, "content": {"application/json": {"schema": request}}},
        "responses": {"200": {"description": "The pose and its accuracy.", "content": answered}}
        | _errors(400, 401, 403, 404, 408, 413, 422, 429, 503, 504),
    }


def _localization() -> Any:
    nullable = {"type": ["number", "null"]}
    properties = {
        "frame": TEXT,
        "T_world_camera": {**MATRIX, "description": "4x4, camera to world"},
        "converged": {"type": "boolean", "description": "whether the pose can be trusted"},
        "outcome": TEXT, "reason": TEXT, "steps": {"type": "integer"}, "seconds": NUMBER,
        "covariance": {
            **MATRIX, "type": ["array", "null"],
            "description": "6x6, of a right update at the camera: translation before rotation",
        },
        "loss": nullable, "method": TEXT, "focal_factor": nullable, "intrinsics": {"type": ["object", "null"]},
        "confidence": nullable, "backend": TEXT, "error": {"type": ["object", "null"]},
    }  # fmt: skip
    return {"type": "object", "required": list(properties), "properties": properties}


def _problem() -> Any:
    properties = {"title": TEXT, "status": {"type": "integer"}, "detail": TEXT}
    return {
        "type": "object",
        "description": "RFC 9457",
        "required": list(properties),
        "properties": properties,
    }


def _geopose_answer() -> Any:
    def axes(names: str) -> Any:
        return {"type": "object", "required": [*names], "properties": dict.fromkeys(names, NUMBER)}

    place = {
        "type": "object",
        "required": ["lon", "lat", "h"],
        "properties": dict.fromkeys(("lon", "lat", "h"), NUMBER),
    }
    accuracy = {
        "type": ["object", "null"], "description": "standard deviations: metres along each axis, degrees about each",
        "properties": {"position": NUMBER, "orientation": NUMBER},
    }  # fmt: skip
    return {
        "type": "object", "required": ["id", "timestamp", "accuracy", "type"],
        "properties": {
            "id": TEXT, "timestamp": NUMBER, "accuracy": accuracy, "type": {"enum": ["geopose", "localpose"]},
            "geopose": {"type": "object", "properties": {"position": place, "quaternion": axes("xyzw")}},
            "localpose": {"type": "object", "properties": {"position": axes("xyz"), "quaternion": axes("xyzw")}},
            "localization": {"$ref": "#/components/schemas/Localization"},
        },
    }  # fmt: skip

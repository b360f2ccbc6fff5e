"""Models of requests and responses, which validate requests and provide the OpenAPI schemas."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    model_validator,
)
from pydantic_core import PydanticCustomError

from bidnerf_core.errors import InputError, spelling_hint
from bidnerf_core.settings import LARGEST_SEED, WIDEST_HFOV

LONGEST_NAME = 200
"""Maximum number of characters of a name in an answer."""
CAMERA_FIELDS = ("focal", "hfov", "camera")
"""The parameters with which a request can state the camera of its photo."""
ABSENT: Any = None
"""The default of values that may be left out but must not be null."""


class Refused(Exception):
    """Raised to refuse a request; carries the HTTP status, a ``detail``, headers, and further JSON fields."""

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None, **more: Any) -> None:
        super().__init__(detail)
        self.status, self.detail, self.headers, self.more = status, detail, dict(headers or {}), more


@dataclass(frozen=True)
class Upload:
    """A photo and its metadata, as sent in a request. No value in it is ever used as a file name."""

    parameters: Mapping[str, Any] = field(default_factory=dict)  # the fields of ``PhotoForm`` that were given
    files: Mapping[str, bytes] = field(default_factory=dict)  # "photo" and perhaps "depth"

    @property
    def name(self) -> str:
        """The name of the frame in the answer."""
        return str(self.parameters.get("name") or "photo")

    @property
    def seed(self) -> int:
        """The seed of the search."""
        return int(self.parameters.get("seed") or 0)


def _require_decimal(value: Any) -> Any:
    """Accept only plain ASCII decimal numbers; Python's ``float`` also accepts underscores and digits of other scripts."""
    if isinstance(value, str) and not re.fullmatch(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", value, re.ASCII):
        raise PydanticCustomError("number", "a number")
    return value


Model = TypeVar("Model", bound=BaseModel)
Number = Annotated[float, BeforeValidator(_require_decimal)]


def _drop_null_defaults(schema: dict[str, Any]) -> None:
    for each in schema["properties"].values():
        if each.get("default", 0) is None:
            del each["default"]


class PhotoForm(BaseModel):
    """A photo and what may be known about it, as a form; all fields but the files may also be in the query of a request."""

    model_config = ConfigDict(extra="forbid", json_schema_extra=_drop_null_defaults)

    map: str = Field(ABSENT, description="by default the one that the photo shows")
    name: str = Field(ABSENT, min_length=1, max_length=LONGEST_NAME, description="the frame's name in the answer")
    focal: Number = Field(ABSENT, ge=1e-3, le=1e9, description="focal length in pixels of the stored image")
    hfov: Number = Field(ABSENT, ge=0, le=WIDEST_HFOV, description="horizontal field of view in degrees, over 3")
    depth_unit: Number = Field(ABSENT, ge=1e-9, le=1e9, description="metres per step of the depth image")
    seed: Annotated[int, BeforeValidator(_require_decimal)] = Field(
        ABSENT, ge=0, le=LARGEST_SEED, description="seed of every random choice"
    )
    camera: str = Field(ABSENT, description="the content of a camera file, such as transforms.json or cameras.txt")
    start: str = Field(ABSENT, description="JSON with a 4x4 T_world_camera to start from")

    photo: bytes = Field(description="an image file")
    depth: bytes = Field(ABSENT, description="a depth image, or the .npy of an array: planar z")

    @model_validator(mode="after")
    def _has_one_camera(self) -> PhotoForm:
        given = [name for name in CAMERA_FIELDS if name in self.model_fields_set]
        if len(given) > 1:
            raise PydanticCustomError(
                "cameras", f"{' and '.join(given)} are given, expected one of {', '.join(CAMERA_FIELDS)}"
            )
        return self


EXPECTED_VALUES = {
    "greater_than_equal": "a number from {ge:g} up",
    "less_than_equal": "a number up to {le:g}",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_parsing_size": "a whole number",
    "int_from_float": "a whole number",
    "string_type": "text",
    "string_too_short": "{min_length} or more characters",
    "string_too_long": "{max_length} or fewer characters",
    "list_type": "a list",
    "too_short": "{min_length} or more values",
    "too_long": "{max_length} or fewer values",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "model_type": "a JSON object",
    "dict_type": "a JSON object",
}
"""What was expected, in words, by pydantic's error type; errors of other types already have a message of ours."""


def validate(model: type[Model], values: Any) -> Model:
    """Validate ``values`` as an instance of ``model``. Raises an ``InputError`` that names the first invalid value."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        # An unknown name comes first: it may be what is missing, misspelt.
        first = min(error.errors(include_url=False), key=lambda each: each["type"] != "extra_forbidden")
    name, kind = ".".join(map(str, first["loc"])), first["type"]
    if kind == "extra_forbidden":
        known = list(model.model_fields)
        hint = spelling_hint(name, known, f", expected any of {', '.join(known)}")
        raise InputError(f"unknown parameter {abbreviate(name)}{hint}")
    if kind == "missing":
        raise InputError(f"no {name!r}", expected="all that the description requires")
    text = first["msg"].removeprefix("Value error, ")
    text = EXPECTED_VALUES[kind].format(**first.get("ctx", {})) if kind in EXPECTED_VALUES else text
    if kind == "cameras":  # concerns several fields, which the message names
        raise InputError(text)
    raise InputError(f"{name or 'the body'} is {abbreviate(first['input'])}", expected=text)


def abbreviate(value: Any) -> str:
    """Return a value as one line of JSON, truncated if it is long."""
    shown = json.dumps(value, default=str)
    return shown if len(shown) <= 60 else shown[:57] + "..."


# Responses. These models describe what is sent, but are not used to build it.


class MapFacts(BaseModel):
    """Facts about a map."""

    backend: str | None = Field(description="of its field, or null if it has landmarks only")
    cameras: int = Field(ge=0)
    landmarks: int = Field(ge=0)
    surfels: int = Field(ge=0)
    unit: Literal["metres", "units"]
    distances: bool = Field(description="whether its photos determine distances")
    bounds: dict[str, Any]
    complete: bool = Field(description="whether its training was finished")
    bidnerf: str = Field(description="the version that wrote it")
    anchor: dict[str, Any] | None


Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]
Row6 = Annotated[list[float], Field(min_length=6, max_length=6)]


class LocalizationBody(BaseModel):
    """The pose of a photo, and whether it can be trusted: the JSON of 'bidnerf localize'."""

    model_config = ConfigDict(title="Localization", json_schema_extra=_drop_null_defaults)

    frame: str
    T_world_camera: Annotated[list[Row4], Field(min_length=4, max_length=4)] | None = Field(
        description="camera to world, or null in a refused answer that found no pose"
    )
    converged: bool = Field(description="whether the pose can be trusted")
    outcome: str
    reason: str
    steps: int = Field(ge=0)
    seconds: float
    covariance: Annotated[list[Row6], Field(min_length=6, max_length=6)] | None = Field(
        description="of a right update at the camera: translation before rotation"
    )
    loss: float | None
    method: str
    focal_factor: float | None
    intrinsics: dict[str, Any] | None
    confidence: float | None
    unit: Literal["metres", "units"]
    backend: str
    error: None
    map: str = Field(ABSENT, description="of several maps, the one that the photo shows")
    similarity: float = Field(ABSENT, description="share of the photo's voting keypoints that recognise that map")
    runner_up: dict[str, Any] | None = Field(ABSENT, description="the second best of several maps")


class ErrorBody(BaseModel):
    """An error (RFC 9457)."""

    title: str
    status: int
    detail: str
    localization: LocalizationBody = Field(ABSENT)

"""The GeoPose Protocol of the Open AR Cloud, version 2: its requests, its answers, and the plugin of the service.

https://github.com/OpenArCloud/oscp-geopose-protocol. The process that listens imports this module, which therefore does
without PyTorch; the answers are made in ``answers``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class _Part(BaseModel):
    """A part of a request: keys that are null count as missing, and numbers are not texts.

    Keys that are not declared are ignored: clients also send readings of sensors that do not help here.
    """

    model_config = ConfigDict(strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _without_nulls(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        return {key: value for key, value in values.items() if value is not None}


class Position(_Part):
    """A place: degrees, and metres above the ellipsoid WGS 84."""

    lon: float
    lat: float
    h: float


class Quaternion(_Part):
    """A unit quaternion."""

    x: float
    y: float
    z: float
    w: float

    @model_validator(mode="after")
    def _has_unit_length(self) -> Quaternion:
        length = math.hypot(self.x, self.y, self.z, self.w)
        if not 0.9 < length < 1.1:
            raise ValueError(f"length 1, not {length:.3g}")
        return self


class GeoPose(_Part):
    """A pose on the earth: the quaternion rotates from x forward, y left, z up at the camera to east, north and up there."""

    position: Position
    quaternion: Quaternion


class Prior(_Part):
    """An earlier pose."""

    geopose: GeoPose


class CameraParameters(_Part):
    """A camera model of COLMAP, and its parameters."""

    model: str = "UNKNOWN_CAMERA"
    modelParams: list[float] = Field([], max_length=20)


class Orientation(_Part):
    """How the image is to be shown."""

    mirrored: bool = False
    rotation: float = 0.0


class Reading(_Part):
    """An image of a camera."""

    sensorId: str = ""
    imageFormat: str = ""
    imageBytes: str = Field(min_length=1, description="an image file, or pixels of imageFormat, in base64")
    size: list[Annotated[int, Field(ge=1, le=1_000_000)]] = Field(
        None, min_length=2, max_length=2, description="width and height"
    )
    params: CameraParameters = CameraParameters()
    imageOrientation: Orientation = Orientation()


class SensorReadings(_Part):
    """The readings of a request."""

    cameraReadings: list[Reading] = Field(min_length=1, max_length=1)


class Sensor(_Part):
    """A sensor of the device."""

    id: str = ""
    type: str = ""


class GeoPoseRequest(_Part):
    """A request of the protocol."""

    id: str = ""
    timestamp: float = 0.0
    type: str = ""
    sensors: list[Sensor] = Field([], max_length=100)
    sensorReadings: SensorReadings
    priorPoses: list[Prior] = Field([], max_length=100)


class Accuracy(BaseModel):
    """Standard deviations: metres along each axis, degrees about each."""

    position: float
    orientation: float


class LocalPosition(BaseModel):
    """A position in the map's frame."""

    x: float
    y: float
    z: float


class LocalPose(BaseModel):
    """A pose in the map's frame."""

    position: LocalPosition
    quaternion: Quaternion


class GeoPoseAnswer(BaseModel):
    """An answer of the protocol, with the JSON of 'bidnerf localize'."""

    id: str
    timestamp: float
    accuracy: Accuracy | None
    type: Literal["geopose", "localpose"]
    geopose: GeoPose = Field(None, description="of a map with an anchor")
    localpose: LocalPose = Field(None, description="of a map without an anchor")
    localization: dict[str, Any]


class GeoPoseProtocol:
    """The protocol as a plugin of the group ``bidnerf.services``."""

    summary = "Find the pose of a photo on the earth (OSCP GeoPose Protocol, version 2)."
    request, response = GeoPoseRequest, GeoPoseAnswer
    media_type = "application/vnd.oscp+json;version=2.0"

    def answer(self, body: dict[str, Any], scene: Any, localize: Callable[[Any], Any]) -> dict[str, Any]:
        """Return the answer to a request, see ``answers.answer``."""
        from bidnerf_geopose.answers import answer

        return answer(scene.anchor, GeoPoseRequest.model_validate(body), localize)


GEOPOSE = GeoPoseProtocol()

"""GPS positions of photos: they tell which photos are near each other, and give a model its frame and its scale."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from PIL.ExifTags import GPS, IFD

from bidnerf.structure.colmap import ListedPhoto, to_sim3d
from bidnerf_core.errors import InputError
from bidnerf_core.geometry import fit_most

LEAST_POSITIONS = 8
"""Smallest number of positions that agree with a model, and by which it is aligned."""
SPREAD = 5.0
"""Smallest ratio of the cameras' extent, along the shorter axis of their plane, to the median distance from their positions by GPS."""


@dataclass(frozen=True)
class GeoFrame:
    """A projected coordinate system in which a model lies: coordinates of the model plus ``origin``, in metres."""

    crs: str  # such as EPSG:32632: UTM, with the altitude as the receiver stated it
    origin: tuple[float, float, float]  # easting, northing, altitude
    deviation: float  # metres: median distance of the cameras from their positions by GPS
    photos: int  # number of photos with such a position


def read_position(file: Path) -> tuple[float, float, float] | None:
    """Return latitude, longitude (degrees) and altitude (metres; 0 if unknown) according to a photo's EXIF; None without them."""
    try:
        with Image.open(file) as image:
            tags = image.getexif().get_ifd(IFD.GPSInfo)
        latitude, longitude = (
            sum(float(part) / 60**power for power, part in enumerate(tags[value])) * (-1 if tags[side] in "SW" else 1)
            for value, side in ((GPS.GPSLatitude, GPS.GPSLatitudeRef), (GPS.GPSLongitude, GPS.GPSLongitudeRef))
        )
        altitude = float(tags.get(GPS.GPSAltitude, 0)) * (-1 if tags.get(GPS.GPSAltitudeRef) in (1, b"\x01") else 1)
    except Exception:  # Pillow's parser may raise anything; EXIF is optional
        return None
    position = latitude, longitude, altitude
    is_usable = all(map(math.isfinite, position)) and abs(latitude) <= 84 and abs(longitude) <= 180
    return position if is_usable and (latitude or longitude) else None


def project_positions(photos: Mapping[int, ListedPhoto], pycolmap: Any) -> tuple[dict[int, np.ndarray], str]:
    """Return the positions (UTM, metres) of the photos that have one, by number, and the name of the coordinate system.

    All positions are projected in the zone of the first one.
    """
    read = {number: read_position(photo.file) for number, photo in photos.items()}
    known = {number: position for number, position in read.items() if position is not None}
    if not known:
        return {}, ""
    metres, zone = pycolmap.GPSTransform().ellipsoid_to_utm(np.array([*known.values()]))
    south = next(iter(known.values()))[0] < 0
    return dict(zip(known, metres, strict=True)), f"EPSG:{(32700 if south else 32600) + zone}"


def align_to_gps(model: Any, photos: Mapping[int, ListedPhoto], pycolmap: Any) -> GeoFrame | None:
    """Move, turn and scale a model so that its cameras are where GPS says; return None, without a change, where GPS says too little.

    GPS bends nothing: its errors of metres are far larger than those of the model.
    """
    positions, crs = project_positions({number: photos[number] for number in model.reg_image_ids()}, pycolmap)
    if len(positions) < LEAST_POSITIONS:
        return None
    origin = np.floor(np.median([*positions.values()], axis=0))
    given = torch.from_numpy(np.array([*positions.values()]) - origin)
    centres = torch.tensor(np.array([model.image(number).projection_center() for number in positions]))
    try:
        similarity, away, agree = fit_most(centres, given)
    except InputError:  # no similarity fits
        return None
    extent = torch.linalg.svdvals(given[agree] - given[agree].mean(0))[1] / math.sqrt(len(given))
    if agree.sum() < LEAST_POSITIONS or extent < SPREAD * away.median():  # a straight path leaves a rotation open
        return None
    model.transform(to_sim3d(similarity, pycolmap))
    east, north, up = map(float, origin)
    return GeoFrame(crs, (east, north, up), round(float(away.median()), 3), len(positions))

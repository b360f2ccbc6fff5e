"""Places on the earth: geodetic coordinates on the WGS 84 ellipsoid, and local east-north-up frames.

Earth-centred coordinates (ECEF) are in metres, latitudes and longitudes in degrees, and heights in metres
above the ellipsoid, not above sea level. Everything is float64: float32 resolves only half a metre at the
earth's radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from bidnerf_core.errors import InputError
from bidnerf_core.geometry import SE3

SEMI_MAJOR = 6378137.0
"""Metres (NGA.STND.0036, table 3.1)."""
FLATTENING = 1 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2 - FLATTENING)


@dataclass(frozen=True)
class Geodetic:
    """A place: latitude and longitude in degrees, height in metres above the ellipsoid."""

    latitude: float
    longitude: float
    height: float

    def __post_init__(self) -> None:
        """Raise ``InputError`` for coordinates that no place near the earth has."""
        bounds = (("latitude", 90.0), ("longitude", 180.0), ("height", 1e6))  # degrees, and metres
        for name, most in bounds:
            value = getattr(self, name)
            if not abs(value) <= most:
                raise InputError(f"{name} is {value}", expected=f"{-most:g} to {most:g}")

    @property
    def ecef(self) -> Float[Tensor, "3"]:
        """The place in earth-centred coordinates (metres)."""
        latitude, longitude = math.radians(self.latitude), math.radians(self.longitude)
        normal = _prime_vertical_radius(latitude)
        from_axis = (normal + self.height) * math.cos(latitude)
        along = ((1 - ECCENTRICITY_SQUARED) * normal + self.height) * math.sin(latitude)
        place = (from_axis * math.cos(longitude), from_axis * math.sin(longitude), along)
        return torch.tensor(place, dtype=torch.float64)

    @property
    def T_ecef_enu(self) -> SE3:
        """The local frame at this place: x east, y north, z up."""
        latitude, longitude = math.radians(self.latitude), math.radians(self.longitude)
        sin_a, cos_a, sin_o, cos_o = (
            math.sin(latitude),
            math.cos(latitude),
            math.sin(longitude),
            math.cos(longitude),
        )
        east, north, up = (
            (-sin_o, cos_o, 0.0),
            (-sin_a * cos_o, -sin_a * sin_o, cos_a),
            (cos_a * cos_o, cos_a * sin_o, sin_a),
        )
        return SE3(torch.tensor([east, north, up], dtype=torch.float64).mT, self.ecef)


def geodetic(ecef: Float[Tensor, "3"]) -> Geodetic:
    """Convert an earth-centred point to geodetic coordinates (Bowring 1976, iterated)."""
    x, y, z = (float(value) for value in ecef)
    from_axis = math.hypot(x, y)
    reduced = math.atan2(z, (1 - FLATTENING) * from_axis)
    polar, second = SEMI_MAJOR * (1 - FLATTENING), ECCENTRICITY_SQUARED / (1 - ECCENTRICITY_SQUARED)
    latitude = 0.0
    for _ in range(6):  # near the ellipsoid, each step gains three digits or more
        latitude = math.atan2(
            z + second * polar * math.sin(reduced) ** 3,
            from_axis - ECCENTRICITY_SQUARED * SEMI_MAJOR * math.cos(reduced) ** 3,
        )
        reduced = math.atan2((1 - FLATTENING) * math.sin(latitude), math.cos(latitude))
    # This form is as accurate at the poles as at the equator.
    sin, cos = math.sin(latitude), math.cos(latitude)
    height = from_axis * cos + z * sin - SEMI_MAJOR**2 / _prime_vertical_radius(latitude)
    return Geodetic(math.degrees(latitude), math.degrees(math.atan2(y, x)), height)


def _prime_vertical_radius(latitude: float) -> float:
    """Return the ellipsoid's prime vertical radius of curvature (metres) at a latitude in radians."""
    return SEMI_MAJOR / math.sqrt(1 - ECCENTRICITY_SQUARED * math.sin(latitude) ** 2)

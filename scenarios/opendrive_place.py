"""Where an OpenDRIVE map lies in a scene's local frame: by the map's geographic origin and the scene's pose on the earth."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import F64

# WGS 84 ellipsoid (NIMA TR8350.2).
SEMI_MAJOR_M = 6378137.0
FLATTENING = 1.0 / 298.257223563


def T_local_map(geo_reference: str, T_earth_local: F64) -> F64:
    """Return the ``(4, 4)`` transform from map coordinates to the local frame, as AlpaSim places a map.

    The map's coordinates are taken as east, north, up at the ``lat_0``, ``lon_0`` (and ``alt_0`` or ``h_0``) of its projection string;
    the projection itself is not applied. Without a usable origin the map lies in the local frame as it is.

    Args:
        geo_reference: PROJ string of the map.
        T_earth_local: ``(4, 4)`` pose of the local frame in earth-centred, earth-fixed coordinates.
    """
    origin = geographic_origin(geo_reference)
    if origin is None:
        return np.eye(4)
    return np.asarray(np.linalg.inv(T_enu_earth(*origin) @ T_earth_local), dtype=np.float64)


def geographic_origin(geo_reference: str) -> tuple[float, float, float] | None:
    """Return latitude and longitude in degrees and height in metres of a PROJ string; None where it names none or an impossible one."""
    values: dict[str, float] = {}
    for word in geo_reference.split():
        key, _, text = word.partition("=")
        name = next((n for n in ("lat_0", "lon_0", "alt_0", "h_0") if key.startswith(f"+{n}")), None)
        try:
            if name is not None:
                values["alt_0" if name == "h_0" else name] = float(text)
        except ValueError:
            continue  # AlpaSim passes over words it cannot read; real files hold some
    if "lat_0" not in values or "lon_0" not in values or abs(values["lat_0"]) > 90 or abs(values["lon_0"]) > 180:
        return None
    return values["lat_0"], values["lon_0"], values.get("alt_0", 0.0)


def T_enu_earth(lat_deg: float, lon_deg: float, height_m: float) -> F64:
    """Return the ``(4, 4)`` transform from earth-centred coordinates to east, north, up at a place."""
    lat, lon = np.deg2rad(lat_deg), np.deg2rad(lon_deg)
    e2 = FLATTENING * (2.0 - FLATTENING)
    n = SEMI_MAJOR_M / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    place = np.array(
        [(n + height_m) * np.cos(lat) * np.cos(lon), (n + height_m) * np.cos(lat) * np.sin(lon), (n * (1.0 - e2) + height_m) * np.sin(lat)]
    )
    east = [-np.sin(lon), np.cos(lon), 0.0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    out = np.eye(4)
    out[:3, :3] = [east, north, up]
    out[:3, 3] = -out[:3, :3] @ place
    return out

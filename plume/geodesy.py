"""Local metres to latitude and longitude and back.

It is PX4's projection about home: spherical, azimuthal, equidistant (Snyder 1987, p. 195).
"""

import math

EARTH_RADIUS_M = 6_371_000.0
# Latitude and longitude of the simulated vehicle's home, degrees: that of PX4's simulation.
HOME = (47.397742, 8.545594)


def to_global(home_lat_deg: float, home_lon_deg: float, north_m: float, east_m: float) -> tuple[float, float]:
    """Return (latitude, longitude) in degrees of the point this far north and east of home."""
    arc = math.hypot(north_m, east_m) / EARTH_RADIUS_M
    if arc == 0.0:
        return home_lat_deg, home_lon_deg
    lat0, bearing = math.radians(home_lat_deg), math.atan2(east_m, north_m)
    sine = math.cos(arc) * math.sin(lat0) + math.sin(arc) * math.cos(lat0) * math.cos(bearing)
    lat = math.asin(min(max(sine, -1.0), 1.0))  # at a pole it rounds beyond 1
    turn = math.atan2(
        math.sin(arc) * math.sin(bearing),
        math.cos(lat0) * math.cos(arc) - math.sin(lat0) * math.sin(arc) * math.cos(bearing),
    )
    lon_deg = home_lon_deg + math.degrees(turn)
    return math.degrees(lat), lon_deg if abs(lon_deg) <= 180.0 else math.remainder(lon_deg, 360.0)


def to_local(home_lat_deg: float, home_lon_deg: float, lat_deg: float, lon_deg: float) -> tuple[float, float]:
    """Return (north, east) of a latitude and longitude, in metres from home; the inverse of `to_global`."""
    lat0, lat, turn = math.radians(home_lat_deg), math.radians(lat_deg), math.radians(lon_deg - home_lon_deg)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(turn)
    east = math.cos(lat) * math.sin(turn)
    # (north, east) has length sin(arc); the projection scales it to length arc. atan2 is precise at small
    # arcs, acos is not.
    sine = math.hypot(north, east)
    cosine = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(turn)
    scale = EARTH_RADIUS_M * (math.atan2(sine, cosine) / sine if sine > 0.0 else 1.0)
    return north * scale, east * scale


def home_from(
    origin: tuple[float, float, float], home: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Return (north, east, down) m of home from a local frame's origin.

    Both are given as latitude and longitude, degrees, and altitude, m.
    """
    north, east = to_local(origin[0], origin[1], home[0], home[1])
    return north, east, origin[2] - home[2]

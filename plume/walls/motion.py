"""How things move among buildings, carried by wind or moved by eddies, and what sees what: compiled loops.

tops: (nx, ny) and levels: (L,) as in `Cells`.  flow: (L, nx, ny, 8) as `flow_around` returns it.
frame: (9,), see its indices below.  Beyond the grid nothing stands, and the wind is the given one.
"""

import math

from plume.compiled import subroutine
from plume.elementary import Array
from plume.numerics import exp, log1p
from plume.walls.cells import CELL_M, FREE

# Of `frame`: the grid's edges, m; the velocity of the air far away, m/s; the box around all buildings, m.
GRID_WEST, GRID_SOUTH, AIR_X, AIR_Y, BOX_WEST, BOX_SOUTH, BOX_EAST, BOX_NORTH, BOX_TOP = range(9)
GAP_M = (
    1e-9  # what stops at the face of a cell stands so far from it, so that rounding does not bring it through
)
MOST_CELLS = 10_000  # that the wind carries something through at once


@subroutine
def top_at(tops: Array, i: int, j: int) -> float:
    """Return z of the roof over cell (i, j), wherever it is, m; FREE where nothing stands."""
    nx, ny = tops.shape
    return tops[i, j] if 0 <= i < nx and 0 <= j < ny else FREE


@subroutine
def cell_of(x: float, y: float, frame: Array) -> tuple[int, int]:
    """Return the cell (i, j) of a place, in the grid or beyond it."""
    i = math.floor((x - frame[GRID_WEST]) / CELL_M)
    j = math.floor((y - frame[GRID_SOUTH]) / CELL_M)
    return int(i), int(j)


@subroutine
def within(x: float, y: float, i: int, j: int, frame: Array) -> tuple[float, float]:
    """Return (x, y), rounded into the cell (i, j) that it is in."""
    west, south = frame[GRID_WEST] + i * CELL_M, frame[GRID_SOUTH] + j * CELL_M
    x = min(max(x, west + GAP_M), west + CELL_M - GAP_M)
    return x, min(max(y, south + GAP_M), south + CELL_M - GAP_M)


@subroutine
def faces_of(
    z: float, i: int, j: int, flow: Array, levels: Array, frame: Array
) -> tuple[float, float, float, float]:
    """Return the air's speed at the west, east, south and north face of cell (i, j) at height z, m/s."""
    air_x, air_y = frame[AIR_X], frame[AIR_Y]
    _, nx, ny, _ = flow.shape
    level = 0
    while level < len(levels) and z >= levels[level]:
        level += 1
    if level == len(levels) or not (0 <= i < nx and 0 <= j < ny):
        return air_x, air_x, air_y, air_y
    f = flow[level, i, j]
    return (
        air_x * f[0] + air_y * f[4],
        air_x * f[1] + air_y * f[5],
        air_x * f[2] + air_y * f[6],
        air_x * f[3] + air_y * f[7],
    )


@subroutine
def velocity_at(
    x: float, y: float, z: float, flow: Array, levels: Array, frame: Array
) -> tuple[float, float]:
    """Return the air's velocity, m/s: in a cell each component is linear in its own direction."""
    i, j = cell_of(x, y, frame)
    west, east, south, north = faces_of(z, i, j, flow, levels, frame)
    a = (x - frame[GRID_WEST]) / CELL_M - i
    b = (y - frame[GRID_SOUTH]) / CELL_M - j
    return west + (east - west) * a, south + (north - south) * b


@subroutine
def seconds_to(distance: float, speed: float, growth: float) -> float:
    """Return the time to a distance, of a speed that grows by `growth` a metre; inf if it stops before."""
    w = growth * distance / speed
    if w <= -1.0:
        return math.inf
    return distance / speed * (1.0 - 0.5 * w if abs(w) < 1e-8 else log1p(w) / w)


@subroutine
def way_of(speed: float, growth: float, seconds: float) -> float:
    """Return the way in a time, of a speed that grows by `growth` a metre."""
    w = growth * seconds
    if abs(w) < 1e-4:
        return speed * seconds * (1.0 + w * (0.5 + w / 6.0))
    return speed * seconds * (exp(w) - 1.0) / w


@subroutine
def exit_of(place: float, west: float, east: float) -> tuple[float, float, int]:
    """Return when the air leaves a cell in one direction, s, how its speed grows, 1/s, and to which side.

    place: m from the western (or southern) face.  west, east: speeds at the faces, m/s.
    """
    growth = (east - west) / CELL_M
    speed = west + growth * place
    if speed > 0.0 and east > 0.0:
        return seconds_to(CELL_M - place, speed, growth), growth, 1
    if speed < 0.0 and west < 0.0:
        return seconds_to(place, -speed, growth), growth, -1
    return math.inf, growth, 0


@subroutine
def slab(place: float, way: float, low: float, high: float) -> tuple[float, float]:
    """Return the shares of a way, from `place` on, at which it enters low … high and leaves it again."""
    if way == 0.0:
        return (-math.inf, math.inf) if low <= place <= high else (math.inf, -math.inf)
    one, other = (low - place) / way, (high - place) / way
    return min(one, other), max(one, other)


@subroutine
def overlap(
    x: float,
    y: float,
    z: float,
    dx: float,
    dy: float,
    dz: float,
    box: tuple[float, float, float, float, float],
) -> tuple[float, float]:
    """Return the shares of a way (dx, dy, dz) at which it enters a box and leaves it, or (1, 0).

    box: west, south, east, north and top; it has no bottom.
    """
    west, south, east, north, top = box
    in_x, out_x = slab(x, dx, west, east)
    in_y, out_y = slab(y, dy, south, north)
    in_z, out_z = slab(z, dz, -math.inf, top)
    begin = max(max(in_x, in_y), max(in_z, 0.0))
    end = min(min(out_x, out_y), min(out_z, 1.0))
    return (begin, end) if begin <= end else (1.0, 0.0)


@subroutine
def carried(
    x: float, y: float, z: float, seconds: float, flow: Array, levels: Array, frame: Array
) -> tuple[float, float]:
    """Return where the wind carries (x, y) in some seconds, from cell to cell in closed form (Pollock 1988).

    No air goes through a wall, so nothing that it carries does.
    """
    air_x, air_y = frame[AIR_X], frame[AIR_Y]
    _, nx, ny, _ = flow.shape
    west, south = frame[GRID_WEST], frame[GRID_SOUTH]
    if len(levels) == 0 or z >= levels[-1]:
        return x + air_x * seconds, y + air_y * seconds
    east, north = west + nx * CELL_M, south + ny * CELL_M
    dx, dy = air_x * seconds, air_y * seconds
    entry, _ = overlap(x, y, z, dx, dy, 0.0, (west, south, east, north, math.inf))
    x, y, left = x + entry * dx, y + entry * dy, seconds * (1.0 - entry)
    i, j = cell_of(x, y, frame)
    for _ in range(MOST_CELLS):
        if left <= 0.0:
            break
        at_x, at_y = west + i * CELL_M, south + j * CELL_M
        low_x, high_x, low_y, high_y = faces_of(z, i, j, flow, levels, frame)
        until_x, growth_x, side_x = exit_of(x - at_x, low_x, high_x)
        until_y, growth_y, side_y = exit_of(y - at_y, low_y, high_y)
        now = min(left, max(min(until_x, until_y), 0.0))
        left -= now
        x += way_of(low_x + growth_x * (x - at_x), growth_x, now)
        y += way_of(low_y + growth_y * (y - at_y), growth_y, now)
        if left <= 0.0:
            break
        if until_x <= until_y:
            i += side_x
            x = west + (i if side_x > 0 else i + 1) * CELL_M
        else:
            j += side_y
            y = south + (j if side_y > 0 else j + 1) * CELL_M
        if not (0 <= i < nx and 0 <= j < ny):
            return x + air_x * left, y + air_y * left
    return within(x, y, i, j, frame)


@subroutine
def face_after(place: float, way: float, edge: float, cell: int) -> tuple[float, float]:
    """Return the shares of a way at which it meets the next face of a cell, and from there each other face.

    place: coordinate, m.  edge: the grid's edge.
    """
    if way == 0.0:
        return math.inf, math.inf
    face = edge + (cell + (1 if way > 0.0 else 0)) * CELL_M
    return (face - place) / way, CELL_M / abs(way)


@subroutine
def moved(
    x: float, y: float, z: float, dx: float, dy: float, dz: float, tops: Array, frame: Array
) -> tuple[float, float, float, float, float, float]:
    """Return where a way from (x, y, z) leads, and for each axis −1.0 if it then goes back, else 1.0.

    Walls and roofs reflect it, as they do light.
    """
    box = (frame[BOX_WEST], frame[BOX_SOUTH], frame[BOX_EAST], frame[BOX_NORTH], frame[BOX_TOP])
    begin, end = overlap(x, y, z, dx, dy, dz, box)
    if begin > end:
        return x + dx, y + dy, z + dz, 1.0, 1.0, 1.0
    i, j = cell_of(x, y, frame)
    until_x, more_x = face_after(x, dx, frame[GRID_WEST], i)
    until_y, more_y = face_after(y, dy, frame[GRID_SOUTH], j)
    back_x, back_y, back_z = 1.0, 1.0, 1.0
    turn_x, turn_y, turn_z = 0.0, 0.0, 0.0  # shares of the way at the last reflections, at x, y, z
    while True:
        top = top_at(tops, i, j)
        until_z = turn_z + (top - z) / dz if dz < 0.0 and top > FREE else math.inf
        share = min(min(until_x, until_y), until_z)
        if share >= 1.0:
            break
        if until_z == share:
            z, turn_z, dz, back_z = top, share, -dz, -back_z
            continue
        height = z + dz * (share - turn_z)
        if until_x == share:
            side = 1 if dx > 0.0 else -1
            if top_at(tops, i + side, j) > height:
                x = frame[GRID_WEST] + (i + (1 if side > 0 else 0)) * CELL_M
                turn_x, dx, back_x = share, -dx, -back_x
            else:
                i += side
            until_x = share + more_x
        else:
            side = 1 if dy > 0.0 else -1
            if top_at(tops, i, j + side) > height:
                y = frame[GRID_SOUTH] + (j + (1 if side > 0 else 0)) * CELL_M
                turn_y, dy, back_y = share, -dy, -back_y
            else:
                j += side
            until_y = share + more_y
    x, y = within(x + dx * (1.0 - turn_x), y + dy * (1.0 - turn_y), i, j, frame)
    z = max(z + dz * (1.0 - turn_z), top_at(tops, i, j) + GAP_M)
    return x, y, z, back_x, back_y, back_z


@subroutine
def sees(
    x: float, y: float, z: float, to_x: float, to_y: float, to_z: float, tops: Array, frame: Array
) -> bool:
    """Return whether no building stands between two places."""
    dx, dy, dz = to_x - x, to_y - y, to_z - z
    box = (frame[BOX_WEST], frame[BOX_SOUTH], frame[BOX_EAST], frame[BOX_NORTH], frame[BOX_TOP])
    share, end = overlap(x, y, z, dx, dy, dz, box)
    if share > end:
        return True
    i, j = cell_of(x + share * dx, y + share * dy, frame)
    until_x, more_x = face_after(x, dx, frame[GRID_WEST], i)
    until_y, more_y = face_after(y, dy, frame[GRID_SOUTH], j)
    while True:
        until = min(min(until_x, until_y), end)
        if min(z + share * dz, z + until * dz) < top_at(tops, i, j):
            return False
        if until >= end:
            return True
        share = until
        if until_x == until:
            i, until_x = i + (1 if dx > 0.0 else -1), until_x + more_x
        else:
            j, until_y = j + (1 if dy > 0.0 else -1), until_y + more_y

# SPDX-FileCopyrightText: 2026 The dlo_calibration authors
# SPDX-License-Identifier: Apache-2.0

"""
Photographs of a DLO on a table, rendered so that the truth is known.

The table is the plane z = 0, z points up, and all lengths are in metres.  A lens without thickness looks at
it; rays that hit the DLO or a hand are found exactly (both are chains of capsules), so that the outline of a
tube is the true one.  Light adds up linearly; the picture gets blur, noise and a gamma of 2.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import cv2
import numpy as np

STEP = 8  # px between the pixels whose rays are computed; between them they are interpolated
SUBPIXELS = np.array([(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)])
TILE = 2048  # px, side of the picture of a ground
GRAIN = 0.0004  # m of one pixel of the ground
SHADE = 0.001  # m of one pixel of a shadow
DLO, SKIN = 0, 1


@dataclass(frozen=True)
class Camera:
    """
    A camera that looks at a point of the table.

    :param size: width and height [px].
    :param focal_length: [px].
    :param tilt: angle between the view and the vertical [rad].
    :param turn: angle around the vertical [rad]: at 0 the camera stands at the side of -y, x to the right.
    :param roll: angle around the view [rad].
    :param distance: from the point that it looks at [m].
    :param target: that point (x, y) [m].
    :param distortion: k1, k2, p1, p2, k3, as OpenCV's and as plumb_bob of ROS.
    """

    size: tuple[int, int] = (4000, 3000)
    focal_length: float = 2900.0
    tilt: float = 0.0
    turn: float = 0.0
    roll: float = 0.0
    distance: float = 0.7
    target: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def matrix(self):
        """Return the matrix (3, 3) of the lens [px]."""
        width, height = self.size
        return np.array([[self.focal_length, 0, (width - 1) / 2], [0, self.focal_length, (height - 1) / 2],
                         [0, 0, 1]])

    @property
    def rotation(self):
        """Return the rotation (3, 3) from the table's axes to right, down, forward."""
        def around(angle, i, j):
            turned = np.eye(3)
            turned[i, i] = turned[j, j] = math.cos(angle)
            turned[i, j], turned[j, i] = math.sin(angle), -math.sin(angle)
            return turned
        down = np.diag([1.0, -1.0, -1.0])
        return around(self.roll, 0, 1) @ around(-self.tilt, 1, 2) @ down @ around(self.turn, 0, 1)

    @property
    def position(self):
        """Return where the camera is (3,) [m]."""
        return np.array([*self.target, 0.0]) - self.distance * self.rotation[2]

    def project(self, points):
        """Return the pixels (n, 2) of points (n, 3) [m]."""
        seen = (np.asarray(points, dtype=float) - self.position) @ self.rotation.T
        flat = self._distorted(seen[:, :2] / seen[:, 2:])
        return flat * self.focal_length + self.matrix[:2, 2]

    def on_plane(self, pixels, height=0.0):
        """Return the points (n, 3) [m] at a height (one, or (n,)) that are seen at pixels (n, 2)."""
        flat = self.undistorted(pixels)
        rays = np.column_stack([flat, np.ones(len(flat))]) @ self.rotation
        reach = (np.broadcast_to(height, len(rays)) - self.position[2]) / rays[:, 2]
        return self.position + reach[:, None] * rays

    def undistorted(self, pixels):
        """Return where an ideal lens of focal length 1 shows pixels (n, 2)."""
        distorted = (np.asarray(pixels, dtype=float) - self.matrix[:2, 2]) / self.focal_length
        flat = distorted.copy()
        for _ in range(40):
            flat += distorted - self._distorted(flat)
        return flat

    def _distorted(self, flat):
        k1, k2, p1, p2, k3 = self.distortion
        x, y = flat.T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.column_stack([x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                                y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])

    def rays(self):
        """Return undistorted coordinates (h, w, 2) of every STEP-th pixel, beginning at -STEP."""
        width, height = self.size
        u, v = np.meshgrid(*(np.arange(-STEP, side + 2 * STEP, STEP) for side in (width, height)))
        return self.undistorted(np.column_stack([u.ravel(), v.ravel()])).reshape(*u.shape, 2)


@dataclass(frozen=True)
class Sheet:
    """
    A picture that lies flat on the table.

    :param image: (h, w) or (h, w, 3) uint8, its first row is the sheet's upper edge.
    :param size: width and height [m].
    :param corner: the lower left corner (x, y) [m].
    :param turn: of the sheet around that corner [rad].
    """

    image: np.ndarray
    size: tuple[float, float]
    corner: tuple[float, float]
    turn: float = 0.0


@dataclass(frozen=True)
class Hand:
    """
    A hand above a point of the table, whose arm comes from a direction.

    :param place: (x, y) [m] below the finger tips.
    :param direction: [rad] towards the arm.
    :param height: of the finger tips [m].
    """

    place: tuple[float, float]
    direction: float = -1.5
    height: float = 0.012


@dataclass(frozen=True)
class Look:
    """
    What the scene looks like; colours are sRGB, 0 to 1.

    :param ground: plain, wood, cloth or checked.
    :param second_colour: of stripes or of a braid's strands.
    :param pattern: plain, striped or braided.
    :param pitch: of the pattern, along the DLO [m].
    :param highlight: 0 (matt) to 1 (glossy).
    :param lamp: azimuth and elevation [rad].
    :param shadow: share of the light that comes from the lamp.
    :param noise: standard deviation, of 255.
    :param blur: standard deviation [px].
    """

    ground: str = 'plain'
    ground_colour: tuple[float, float, float] = (0.8, 0.8, 0.78)
    ground_contrast: float = 0.15
    colour: tuple[float, float, float] = (0.75, 0.15, 0.1)
    second_colour: tuple[float, float, float] = (0.9, 0.9, 0.9)
    pattern: str = 'plain'
    pitch: float = 0.02
    highlight: float = 0.3
    lamp: tuple[float, float] = (2.0, 0.9)
    shadow: float = 0.5
    noise: float = 2.0
    blur: float = 0.8
    hands: tuple[Hand, ...] = ()
    sheets: tuple[Sheet, ...] = ()


def photograph(camera, curve, radius, look, seed=0):
    """
    Render a photograph (height, width, 3) uint8 of a DLO.

    :param curve: (n, 3) [m], the middle line; without a DLO, None.
    """
    generator = np.random.default_rng(seed)
    rays = camera.rays()
    lamp = np.array([math.cos(look.lamp[1]) * math.cos(look.lamp[0]),
                     math.cos(look.lamp[1]) * math.sin(look.lamp[0]), math.sin(look.lamp[1])])
    places = _table_map(rays, camera.rotation, camera.position, *camera.size)
    middle = np.float32(TILE / 4)
    tile = _ground(look, generator, TILE if camera.size[0] > 2000 else TILE // 2)
    image = cv2.remap(tile, places * np.float32(1 / GRAIN) + middle, None, cv2.INTER_LINEAR,
                      borderMode=cv2.BORDER_REFLECT)
    for sheet in look.sheets:
        _lay(image, sheet, places)
    capsules = _capsules(curve, radius, look.hands)
    if len(capsules):
        for high, softness in ((False, 0.35), (True, 0.25)):
            _shadow(image, places, capsules[(capsules[:, 8] == SKIN) == high], lamp, look.shadow, softness)
    # The light falls off towards the corners, and is a little stronger on one side.
    height, width = image.shape[:2]
    v, u = np.mgrid[-1:1:height // 100 * 1j, -1:1:width // 100 * 1j]
    falling = (1 - 0.12 * (u * u + v * v) + 0.08 * (u * lamp[0] - v * lamp[1])).astype(np.float32)
    image *= cv2.resize(falling, (width, height))[..., None]
    if len(capsules):
        _draw(image, camera, rays, capsules, radius, look, lamp, generator)
    if look.blur:
        image = cv2.GaussianBlur(image, (0, 0), look.blur)
    image = cv2.sqrt(np.clip(image, 0, 1, out=image)) * np.float32(255)
    spare = generator.standard_normal((523, 701, 3), dtype=np.float32) * np.float32(look.noise)
    for top in range(0, height, len(spare)):
        row = np.roll(spare, generator.integers(701), axis=1)
        part = image[top:top + len(spare)]
        part += np.tile(row, (1, -(-width // 701), 1))[:len(part), :width]
    return cv2.convertScaleAbs(np.clip(image, 0, 255, out=image))


def _linear(colour):
    return np.square(np.asarray(colour, dtype=np.float32))


def _ground(look, generator, side):
    """Return the picture of the ground (side, side, 3), linear."""
    def noise(across, along):
        """Return smooth noise of about unit size, with correlation lengths [m]."""
        small = [max(2, round(side * GRAIN / length)) for length in (across, along)]
        size = [min(count, side) for count in small]
        return cv2.resize(generator.standard_normal(size, dtype=np.float32), (side, side),
                          interpolation=cv2.INTER_CUBIC)

    v, u = np.mgrid[:side, :side].astype(np.float32) * np.float32(GRAIN)
    if look.ground == 'wood':
        rings = 3.0 * noise(0.05, 0.4) + v * 160 + 0.3 * noise(0.02, 0.2)
        value = 0.5 * np.sin(rings) + 0.35 * noise(0.0012, 0.03) + 0.3 * noise(0.006, 0.12)
        value = value * 0.7 + 0.8 * np.sign(np.sin(v * 9)) * 0.4 - 1.5 * (np.abs(np.sin(v * 9)) < 0.012)
    elif look.ground == 'cloth':
        value = (0.5 * np.sin(u * 2 * np.pi / 0.0016) * np.sin(v * 2 * np.pi / 0.0016)
                 + 0.35 * noise(0.0008, 0.0008) + 0.5 * noise(0.08, 0.05))
    elif look.ground == 'checked':
        value = 0.7 * np.sign(np.sin(u * np.pi / 0.037)) + 0.7 * np.sign(np.sin(v * np.pi / 0.037))
        value += 0.3 * noise(0.0008, 0.0008)
    else:
        value = 0.3 * noise(0.3, 0.3) + 0.12 * noise(0.004, 0.004) + 0.12 * noise(0.0008, 0.0008)
    colour = np.asarray(look.ground_colour, dtype=np.float32)
    tint = np.array([1.0, 0.95, 0.85], dtype=np.float32) * look.ground_contrast
    tile = _linear(np.clip(colour + value[..., None] * tint * colour.mean(), 0.01, 1))
    return cv2.GaussianBlur(tile, (0, 0), 0.7)


def _lay(image, sheet, places):
    """Lay a sheet on the ground; it is filtered for the resolution at its middle."""
    height, width = sheet.image.shape[:2]
    cosine, sine = math.cos(sheet.turn), math.sin(sheet.turn)
    x, y = places[..., 0] - sheet.corner[0], places[..., 1] - sheet.corner[1]
    u = (cosine * x + sine * y) * (width / sheet.size[0]) - 0.5
    v = height - 0.5 - (cosine * y - sine * x) * (height / sheet.size[1])
    inside = (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    if not inside.any():
        return
    fineness = math.sqrt(width * height / inside.sum())
    picture = np.square((sheet.image if sheet.image.ndim == 3 else sheet.image[..., None].repeat(3, axis=2))
                        .astype(np.float32) / 255)
    if fineness > 1:
        picture = cv2.GaussianBlur(picture, (0, 0), 0.4 * fineness, borderType=cv2.BORDER_REPLICATE)
    u, v = u[inside], v[inside]
    side = 1024
    count = -(-len(u) // side) * side
    u, v = (np.resize(coordinate, count).reshape(-1, side).astype(np.float32) for coordinate in (u, v))
    colours = [cv2.remap(picture, u[k:k + 1024], v[k:k + 1024], cv2.INTER_LINEAR,
                         borderMode=cv2.BORDER_REPLICATE) for k in range(0, len(u), 1024)]
    image[inside] = 0.85 * np.concatenate(colours).reshape(-1, 3)[:inside.sum()]


def _capsules(curve, radius, hands):
    """Return rows of start (3), end (3), radius, arc length at the start [m], and DLO or SKIN."""
    rows = []
    if curve is not None:
        curve = np.asarray(curve, dtype=float)
        # The caps are round, but the DLO ends where the curve does.
        arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        at = np.linspace(radius, arc[-1] - radius, max(3, int(arc[-1] / max(0.0015, radius / 2))))
        points = np.column_stack([np.interp(at, arc, column) for column in curve.T])
        rows += [(*a, *b, radius, s, DLO) for a, b, s in zip(points[:-1], points[1:], at, strict=False)]
    for hand in hands:
        away = np.array([math.cos(hand.direction), math.sin(hand.direction), 0.0])
        side = np.array([-away[1], away[0], 0.0])
        tip = np.array([*hand.place, hand.height])
        up = np.array([0.0, 0.0, 1.0])
        palm = tip + 0.095 * away + 0.05 * up
        for k, (spread, reach) in enumerate(((-0.5, 0.012), (-0.17, 0.0), (0.16, 0.004), (0.5, 0.02))):
            joint = tip + 0.05 * away + 0.04 * spread * side + 0.042 * up
            end = tip + 0.03 * spread * side + reach * away + (0.004 * k) * up
            knuckle = palm + 0.07 * spread * side
            rows += [(*end, *joint, 0.0078, 0, SKIN), (*joint, *knuckle, 0.0092, 0, SKIN)]
        thumb = tip + 0.03 * away - 0.045 * side + 0.02 * up
        rows += [(*(tip - 0.012 * side + 0.01 * away), *thumb, 0.009, 0, SKIN),
                 (*thumb, *(palm - 0.03 * side), 0.012, 0, SKIN)]
        for spread in (-0.35, -0.12, 0.12, 0.35):
            rows += [(*(palm + 0.07 * spread * side), *(palm + 0.07 * away + 0.05 * spread * side), 0.016, 0,
                      SKIN)]
        wrist = palm + 0.08 * away + 0.01 * up
        rows += [(*wrist, *(wrist + 0.5 * away + 0.05 * up), 0.028, 0, SKIN)]
    return np.array(rows).reshape(-1, 9)


def _mask(capsules, lamp, level, softness):
    """Return a shadow (h, w) on the plane z = level, and where its first pixel is (x, y) [m]."""
    def fall(points):
        return points[:, :2] - lamp[:2] / lamp[2] * (points[:, 2:] - level)

    starts, ends = fall(capsules[:, :3]), fall(capsules[:, 3:6])
    both = np.concatenate([starts, ends])
    low = np.clip(both.min(axis=0) - 0.06, -1.5, 1.5)
    size = np.ceil((np.clip(both.max(axis=0) + 0.06, -1.5, 1.5) - low) / SHADE).astype(int)
    mask = np.zeros((size[1], size[0]), dtype=np.uint8)
    placed = ((starts - low) / SHADE, (ends - low) / SHADE, capsules[:, 6] / SHADE)
    for a, b, radius in zip(*placed, strict=True):
        wide = max(1, round(2 * radius))
        pixels = (tuple(int(x) for x in np.rint(np.clip(p, -4000, 8000) * 16)) for p in (a, b))
        cv2.line(mask, *pixels, 255, wide, cv2.LINE_AA, 4)
    heights = np.maximum((capsules[:, 2] + capsules[:, 5]) / 2 - level, 0.001)
    blur = max(0.8, softness * np.median(heights) / SHADE)
    return cv2.GaussianBlur(mask.astype(np.float32) / 255, (0, 0), blur), low


def _shadow(image, places, capsules, lamp, share, softness):
    """Take light away from the ground: the lamp's behind an object, and that of the room below it."""
    if not len(capsules):
        return
    for direction, strength in ((lamp, share), (np.array([0, 0, 1.0]), 0.35)):
        mask, low = _mask(capsules, direction, 0.0, softness)
        at = ((places - low.astype(np.float32)) * np.float32(1 / SHADE))
        dark = cv2.remap(mask, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        image *= 1 - np.float32(strength) * dark[..., None]


def _draw(image, camera, rays, capsules, radius, look, lamp, generator):
    """Draw the capsules over the ground."""
    height, width = image.shape[:2]
    near = np.zeros((height, width), dtype=np.uint8)
    starts, ends = camera.project(capsules[:, :3]), camera.project(capsules[:, 3:6])
    for a, b, row in zip(starts, ends, capsules, strict=True):
        depth = min((row[:3] - camera.position) @ camera.rotation[2],
                    (row[3:6] - camera.position) @ camera.rotation[2])
        if depth > 0.05:
            wide = round(2.9 * row[6] * camera.focal_length / depth / math.cos(camera.tilt)) + 8
            cv2.line(near, *(tuple(int(x) for x in np.rint(np.clip(p, -9000, 19000))) for p in (a, b)), 255,
                     min(wide, 2000))
    v, u = np.nonzero(near)
    order = np.zeros((height, width), dtype=np.int32)
    order[v, u] = np.arange(1, len(u) + 1)
    boxes = np.column_stack([np.minimum(starts, ends), np.maximum(starts, ends)])
    depth = np.full((len(u), 4), np.inf, dtype=np.float32)
    which = np.full((len(u), 4), -1, dtype=np.int32)
    place = np.zeros((len(u), 4, 4), dtype=np.float32)
    scale = 1.3 * camera.focal_length / math.cos(camera.tilt)
    _hit(order, capsules, boxes, scale, rays, camera.rotation, camera.position, depth, which, place)
    struck = which >= 0
    capsule = capsules[which[struck]]
    normals, arc = place[struck][:, :3], place[struck][:, 3]
    colour = _surface(capsule, normals, arc, radius, look, generator)
    direct = np.clip(normals @ lamp.astype(np.float32), 0, 1)
    sky = 0.55 + 0.45 * normals[:, 2]
    # The upper strand of a crossing shades the lower one.
    raised = capsules[(capsules[:, 8] == DLO) & (capsules[:, 2] > 1.5 * radius)]
    if len(raised):
        mask, low = _mask(raised, lamp, 2 * radius, 0.4)
        middle = (capsule[:, :2] + capsule[:, 3:5]) / 2 + radius * normals[:, :2]
        at = ((middle - low) / SHADE).astype(np.float32)
        dark = np.concatenate([
            cv2.remap(mask, part[None], None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[0]
            for part in np.split(at, range(30000, len(at), 30000))])
        dark[(capsule[:, 2] > 1.5 * radius) | (capsule[:, 8] == SKIN)] = 0
        direct, sky = direct * (1 - dark), sky * (1 - 0.4 * dark)
    view = (camera.position - (capsule[:, :3] + capsule[:, 3:6]) / 2).astype(np.float32)
    half = view / np.linalg.norm(view, axis=1, keepdims=True) + lamp.astype(np.float32)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shine = np.clip((normals * half).sum(axis=1), 0, 1) ** 50 * look.highlight * (capsule[:, 8] == DLO)
    lit = colour * ((1 - look.shadow) * sky + look.shadow * 1.15 * direct)[:, None] + 0.5 * shine[:, None]
    colours = np.repeat(image[v, u][:, None], 4, axis=1)
    colours[struck] = lit
    image[v, u] = colours.mean(axis=1)


def _surface(capsule, normals, arc, radius, look, generator):
    """Return the colours (n, 3), linear, of the places that rays hit."""
    colour = np.tile(_linear(look.colour), (len(arc), 1))
    if look.pattern != 'plain':
        along = capsule[:, 3:6] - capsule[:, :3]
        flat = np.column_stack([-along[:, 1], along[:, 0]])
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        angle = np.arctan2(normals[:, 2], (normals[:, :2] * flat).sum(axis=1))
        turn = arc / look.pitch * 2 * np.pi
        if look.pattern == 'striped':
            second = np.sin(turn + angle) > 0.4
        else:
            second = np.sin(turn + 2 * angle) * np.sin(turn - 2 * angle) > 0.25
            colour *= (1 - 0.3 * (np.abs(np.sin(2 * turn) * np.sin(4 * angle)) > 0.85))[:, None]
        colour[second] = _linear(look.second_colour)
    skin = capsule[:, 8] == SKIN
    tone = 1 + 0.06 * np.sin(capsule[:, 0] * 300) * np.sin(capsule[:, 1] * 280)
    colour[skin] = _linear((0.87, 0.66, 0.56)) * tone[skin, None]
    return colour * (1 + 0.04 * generator.standard_normal((len(arc), 1), dtype=np.float32))


def _ray(rays, u, v):
    """Interpolate the undistorted coordinates of pixels."""
    x, y = u / STEP + 1, v / STEP + 1
    i = np.clip(y.astype(int), 0, rays.shape[0] - 2)
    j = np.clip(x.astype(int), 0, rays.shape[1] - 2)
    y, x = (y - i)[..., None], (x - j)[..., None]
    above = (1 - x) * rays[i, j] + x * rays[i, j + 1]
    below = (1 - x) * rays[i + 1, j] + x * rays[i + 1, j + 1]
    interpolated = (1 - y) * above + y * below
    return interpolated[..., 0], interpolated[..., 1]


def _table_map(rays, rotation, position, width, height):
    """Return where on the table (x, y) [m] each pixel looks."""
    places = np.empty((height, width, 2), dtype=np.float32)
    for v in range(height):
        x, y = _ray(rays, np.arange(float(width)), np.full(width, float(v)))
        along = x[:, None] * rotation[0] + y[:, None] * rotation[1] + rotation[2]
        places[v] = position[:2] - (position[2] / np.minimum(along[:, 2:], -0.02)) * along[:, :2]
    return places


def _hit(order, capsules, boxes, scale, rays, rotation, position, depth, which, place):
    """Find the nearest capsule that the rays of each pixel hit; `place` is the normal and the arc length."""
    height, width = order.shape
    for k, capsule in enumerate(capsules):
        a, b, radius = capsule[:3] - position, capsule[3:6] - position, capsule[6]
        nearest = min(a @ rotation[2], b @ rotation[2]) - radius
        if nearest < 0.02:
            continue
        margin = radius * scale / nearest + 2
        left, top = max(0, int(boxes[k, 0] - margin)), max(0, int(boxes[k, 1] - margin))
        right, bottom = min(width, int(boxes[k, 2] + margin) + 1), min(height, int(boxes[k, 3] + margin) + 1)
        v, u = np.nonzero(order[top:bottom, left:right])
        row = order[top:bottom, left:right][v, u] - 1
        first, axis = rotation @ a, rotation @ (b - a)
        square, start, size = axis @ axis, first @ axis, first @ first
        for sub in range(4):
            x, y = _ray(rays, left + u + SUBPIXELS[sub, 0], top + v + SUBPIXELS[sub, 1])
            ray = np.column_stack([x, y, np.ones(len(x))])
            ray /= np.linalg.norm(ray, axis=1, keepdims=True)
            along, towards = ray @ axis, ray @ first
            # the cylinder: |t ray - a - s axis| = radius
            p = 1 - along * along / square
            q = towards - along * start / square
            root = q * q - p * (size - start * start / square - radius * radius)
            with np.errstate(divide='ignore', invalid='ignore'):
                t = (q - np.sqrt(root)) / p
                s = (t * along - start) / square
            hit = (root >= 0) & (p > 1e-12) & (s >= 0) & (s <= 1)
            best, at = np.where(hit, t, np.inf), np.where(hit, s, 0.0)
            for end in range(2):
                q = towards + end * along
                root = q * q - (size + end * (2 * start + square)) + radius * radius
                t = q - np.sqrt(np.maximum(root, 0))
                hit = (root >= 0) & (t < best)
                best, at = np.where(hit, t, best), np.where(hit, float(end), at)
            nearer = best < depth[row, sub]
            rows, best, at = row[nearer], best[nearer, None], at[nearer]
            depth[rows, sub], which[rows, sub] = best[:, 0], k
            place[rows, sub, :3] = (best * ray[nearer] - first - at[:, None] * axis) @ rotation / radius
            place[rows, sub, 3] = capsule[7] + at * math.sqrt(square)

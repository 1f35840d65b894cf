"""Light through a drop: Snell, Fresnel, what the drop sees, defocus, and colour encoding."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]

WATER = 1.333  # refractive index at 589 nm and 20 degrees Celsius

_DECODE = np.linspace(0.0, 1.0, 4097, dtype=np.float64)
_DECODE_TABLE = np.where(
    _DECODE <= 0.04045, _DECODE / 12.92, ((_DECODE + 0.055) / 1.055) ** 2.4
).astype(np.float32)


def srgb_to_linear(image: Image) -> Image:
    """Linear light of sRGB values in [0, 1] (IEC 61966-2-1), by a table of 4097 entries."""
    position = np.clip(image, 0.0, 1.0) * np.float32(4096)
    low = np.minimum(position.astype(np.int32), 4095)
    part = position - low
    return _DECODE_TABLE[low] * (1 - part) + _DECODE_TABLE[low + 1] * part


def linear_to_srgb(light: Image) -> Image:
    """sRGB values of linear light, clipped to [0, 1]."""
    clipped = np.clip(light, 0.0, 1.0).astype(np.float32)
    curve = 1.055 * cv2.pow(clipped, 1 / 2.4).reshape(clipped.shape) - 0.055
    return np.where(clipped <= 0.0031308, 12.92 * clipped, curve).astype(np.float32)


def refract(direction: NDArray, normal: NDArray, ratio: float) -> tuple[NDArray, NDArray[np.bool_]]:
    """Refracted unit directions (..., 3) and where the light is totally reflected (...) bool.

    direction, normal: (..., 3) unit vectors, normal on the far side (direction . normal > 0).
    ratio: index before the surface over index behind it (Snell). Where totally reflected, the
    direction returned is that of the mirrored ray.
    """
    cosine = np.sum(direction * normal, axis=-1)
    inside = 1 - ratio**2 * (1 - cosine**2)
    total = inside < 0
    bent = np.sqrt(np.maximum(inside, 0.0)) - ratio * cosine
    through = ratio * direction + bent[..., None] * normal
    mirrored = direction - 2 * cosine[..., None] * normal
    return np.where(total[..., None], mirrored, through), total


def fresnel(cosine: NDArray, ratio: float) -> NDArray:
    """Share of unpolarised light that passes a surface, in [0, 1]; 0 at total reflection.

    cosine: of the angle of incidence, on the side of the index in `ratio`'s numerator.
    """
    inside = 1 - ratio**2 * (1 - cosine**2)
    cosine_behind = np.sqrt(np.maximum(inside, 0.0))
    across = (ratio * cosine - cosine_behind) / (ratio * cosine + cosine_behind + 1e-9)
    along = (cosine - ratio * cosine_behind) / (cosine + ratio * cosine_behind + 1e-9)
    return np.where(inside < 0, 0.0, 1 - 0.5 * (across**2 + along**2))


def blur_diameter_px(
    focal_px: float, aperture_radius: float, pane_distance: float, focus_distance: float = np.inf
) -> float:
    """Diameter, in pixels, of the disc that a point of the pane becomes (thin lens).

    Lengths in metres. focal_px: focal length in pixels; the lens focuses on focus_distance.
    """
    return 2 * aperture_radius * focal_px * abs(1 / pane_distance - 1 / focus_distance)


@lru_cache(maxsize=256)
def disc_kernel(diameter: float) -> Image:
    """Disc of the given diameter in pixels, soft by one pixel at its edge, that sums to 1."""
    half = int(np.ceil(diameter / 2 + 0.5))
    axis = np.arange(-half, half + 1)
    distance = np.hypot(axis[:, None], axis[None, :])
    disc = np.clip(diameter / 2 - distance + 0.5, 0.0, 1.0).astype(np.float32)
    return disc / disc.sum()


def defocus(layer: Image, diameter: float) -> Image:
    """Layer (H, W, C) convolved with a disc; its border is taken as empty."""
    if diameter < 0.7:
        return layer
    return cv2.filter2D(layer, -1, disc_kernel(round(diameter, 1)), borderType=cv2.BORDER_CONSTANT)


@dataclass(frozen=True)
class Environment:
    """Linear light from every direction in front of the pane, as a stereographic map.

    The direction (x, y, z) lies at (x, y) / (1 + z); the map spans [-reach, reach] on both axes.
    turn (3, 3): takes the directions that are asked for into the map's frame, the camera's.
    """

    light: Image
    reach: float
    turn: NDArray | None = None

    def look(self, direction: NDArray) -> Image:
        """Light (..., 3) from unit directions (..., 3); those far behind the pane are clamped."""
        side = self.light.shape[0]
        scale = side / (2 * self.reach)
        flat = direction.reshape(-1, 3).astype(np.float32)
        if self.turn is not None:
            flat = flat @ self.turn.T.astype(np.float32)
        plane = flat[:, :2] / np.maximum(1 + flat[:, 2:], 0.2)
        place = np.clip(plane * scale + (side / 2 - 0.5), 0, side - 1)
        columns = 4096  # cv2.remap wants both sides below 32768
        rows = -(-len(place) // columns)
        padded = np.zeros((rows * columns, 2), np.float32)
        padded[: len(place)] = place
        seen = cv2.remap(
            self.light, padded.reshape(rows, columns, 2), None, cv2.INTER_LINEAR
        ).reshape(-1, 3)
        return seen[: len(place)].reshape(direction.shape)


@lru_cache(maxsize=8)
def _directions(side: int, reach: float) -> Image:
    axis = (np.arange(side) + 0.5) * (2 * reach / side) - reach
    x, y = np.meshgrid(axis, axis)
    square = x**2 + y**2
    return np.stack([2 * x, 2 * y, 1 - square], axis=-1).astype(np.float32) / (
        1 + square[..., None]
    ).astype(np.float32)


def make_environment(
    light: Image,
    focal_px: float,
    *,
    sky: NDArray | None = None,
    ground: NDArray | None = None,
    surroundings: Image | None = None,
    centre: tuple[float, float] | None = None,
    side: int = 256,
    reach: float = 1.1,
) -> Environment:
    """What lies before the pane: the photo where it shows it, a smooth guess of the rest around.

    light: (H, W, 3) linear light of the photo; centre: pixel (x, y) of its optical axis, by default
    the middle. Beyond its border the colours fade within about half its width into the means along
    the border, and from there into `sky` (3,) above and `ground` (3,) below; by default the brightest
    colour of the upper part and a dark one of the lower. surroundings: (h, w, 3) factors, about 1,
    that give the guess some structure.
    """
    height, width = light.shape[:2]
    middle = (width / 2, height / 2) if centre is None else centre
    small = cv2.resize(light, (48, 48), interpolation=cv2.INTER_AREA)
    if sky is None:
        sky = np.percentile(small[:24].reshape(-1, 3), 97, axis=0)
    if ground is None:
        ground = 0.7 * small[32:].reshape(-1, 3).mean(axis=0)
    toward = _directions(side, reach)
    depth = np.maximum(toward[..., 2], 0.05)
    u = toward[..., 0] / depth * focal_px + middle[0]
    v = toward[..., 1] / depth * focal_px + middle[1]
    behind = toward[..., 2] <= 0.05
    beyond = np.maximum(np.abs(u / width - 0.5), np.abs(v / height - 0.5)) - 0.5
    beyond = np.where(behind, 9.0, beyond).astype(np.float32)

    # Elevation decides between sky and ground, with a soft horizon.
    up = 1 / (1 + np.exp(12 * toward[..., 1]))
    far = up[..., None] * sky + (1 - up[..., None]) * ground
    far = far * (0.75 + 0.5 * np.clip(-toward[..., 1:2], 0, 1))
    if surroundings is not None:
        far = far * cv2.resize(surroundings, (side, side), interpolation=cv2.INTER_LINEAR)
    border = cv2.blur(small, (15, 15), borderType=cv2.BORDER_REPLICATE)
    at = [np.clip(c * 48 / n - 0.5, 0, 47).astype(np.float32) for c, n in ((u, width), (v, height))]
    near = cv2.remap(border, at[0], at[1], cv2.INTER_LINEAR)
    fade = np.clip(beyond / 0.5, 0, 1)[..., None]
    guess = near + (far - near) * (fade * fade * (3 - 2 * fade))

    # Photo pixels per map pixel, at the centre.
    photo = _sampled(light, u, v, step=2 * reach / side * focal_px * 2)
    inside = np.clip(-beyond / 0.04, 0, 1)[..., None]
    return Environment((photo * inside + guess * (1 - inside)).astype(np.float32), reach)


def _sampled(light: Image, u: NDArray, v: NDArray, step: float) -> Image:
    """The picture at its pixels (u, v), first scaled down where those lie `step` pixels apart."""
    height, width = light.shape[:2]
    scaled = light
    if step > 1.5:
        size = (max(round(width / step * 1.5), 2), max(round(height / step * 1.5), 2))
        scaled = cv2.resize(light, size, interpolation=cv2.INTER_AREA)
    sx, sy = scaled.shape[1] / width, scaled.shape[0] / height
    return cv2.remap(
        scaled,
        np.clip(u * sx - 0.5, 0, scaled.shape[1] - 1).astype(np.float32),
        np.clip(v * sy - 0.5, 0, scaled.shape[0] - 1).astype(np.float32),
        cv2.INTER_LINEAR,
    )


def through_drop(
    ray: NDArray, slope: NDArray, environment: Environment, *, rim_light: float = 0.4
) -> Image:
    """Linear light (N, 3) that reaches the camera through water.

    ray: (N, 3) unit directions from the camera. slope: (N, 2) of the water's height over the
    pane. The flat side bends the ray in, the curved one out. Totally reflected light, near steep
    rims, leaves the drop elsewhere after more reflections: it is taken from the mirrored
    direction, weakened to `rim_light`.
    """
    flat = np.zeros_like(ray)
    flat[:, 2] = 1.0
    inner, _ = refract(ray, flat, 1 / WATER)
    passed = fresnel(ray[:, 2], 1 / WATER)
    normal = np.concatenate([-slope, np.ones_like(slope[:, :1])], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    outer, total = refract(inner, normal, WATER)
    passed = passed * fresnel(np.sum(inner * normal, axis=1), WATER)
    outer[total, 2] = np.abs(outer[total, 2])
    share = np.where(total, rim_light, passed)
    return (environment.look(outer) * share[:, None]).astype(np.float32)

"""Builds textured triangle meshes from panels, boxes, tubes, turned shapes and leaves.

Frame of a place: metres, the mean camera at the origin, x right, y down, z forward.
A surface's texture runs u to the right and v down as seen from outside, and its normal points out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]  # float32 where it is stored
Vec = npt.ArrayLike
WHITE = (1.0, 1.0, 1.0)
UP = np.array([0, -1, 0], np.float32)


@dataclass(frozen=True)
class Lamp:
    """A point light: position (3,) in metres; radiant intensity (3,) in W/sr, linear RGB."""

    position: tuple[float, float, float]
    intensity: tuple[float, float, float]


@dataclass(frozen=True)
class TexturedMesh:
    """A triangle mesh of one material.

    vertices, normals (N, 3); uv (N, 2), v down, repeating unless within [0, 1]; tint (N, 3) factor
    on the texture; glow (N,) radiance that the surface itself gives off, times the albedo;
    faces (M, 3) int; texture (H, W, 3) linear albedo.
    """

    name: str
    vertices: Array
    normals: Array
    uv: Array
    tint: Array
    glow: Array
    faces: npt.NDArray[np.uint32]
    texture: Array


@dataclass(frozen=True)
class Cell:
    """One cell of a texture atlas: column and row of `columns` x `rows`."""

    column: int
    row: int
    columns: int
    rows: int

    def apply(self, uv: Array) -> Array:
        """Texture coordinates in [0, 1] moved into the cell, a hair inside its border."""
        inside = 0.01 + 0.98 * np.clip(uv, 0, 1)
        at = (inside + np.array([self.column, self.row])) / [self.columns, self.rows]
        return at.astype(np.float32)


def offset(x: float, y: float, z: float) -> npt.NDArray[np.float64]:
    """The vector (3,)."""
    return np.array([x, y, z], np.float64)


def lamp(position: Array, intensity: tuple[float, float, float]) -> Lamp:
    """The lamp at that position (3,)."""
    x, y, z = (float(c) for c in position)
    return Lamp((x, y, z), intensity)


def turn(yaw: float) -> Array:
    """Rotation (3, 3) by `yaw` radians about the vertical; positive turns +z towards +x."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)


def front(right: Array) -> tuple[Array, Array, float]:
    """Out of a front along the unit `right`, up, and its angle about the vertical."""
    out = np.cross(np.array([0, 1, 0], np.float32), right)
    return out, UP, float(np.arctan2(-right[2], right[0]))


def _unit(v: Array) -> Array:
    return (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)).astype(np.float32)


def grid_faces(rows: int, columns: int) -> npt.NDArray[np.uint32]:
    """Triangles (M, 3) between the points of a grid, row by row, seen from outside."""
    index = np.arange(rows * columns, dtype=np.uint32).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    both = np.stack([np.stack([a, c, b], -1), np.stack([a, d, c], -1)], 2)
    return both.reshape(-1, 3)


class Builder:
    """Collects pieces by material; `meshes` joins them."""

    def __init__(self, textures: dict[str, Array], step: float = 0.22) -> None:
        self.textures = textures
        self.step = step
        self._parts: dict[str, list[tuple[npt.NDArray[np.generic], ...]]] = {}

    def add(
        self, material: str, vertices: Vec, normals: Vec, uv: Vec, faces: Vec,
        tint: Vec = WHITE, glow: float = 0.0,
    ) -> None:  # fmt: skip
        """Adds a piece of one material; tint is (3,) or (N, 3)."""
        if material not in self.textures:
            raise KeyError(material)
        xyz = np.asarray(vertices, np.float32).reshape(-1, 3)
        tints = np.broadcast_to(np.asarray(tint, np.float32), xyz.shape)
        part = (xyz, _unit(np.asarray(normals, np.float32).reshape(-1, 3)),
                np.asarray(uv, np.float32).reshape(-1, 2), tints,
                np.full(len(xyz), glow, np.float32), np.asarray(faces, np.uint32))  # fmt: skip
        self._parts.setdefault(material, []).append(part)

    def panel(
        self, material: str, top_left: Vec, right: Vec, down: Vec, *, tile: float = 1.0,
        cell: Cell | None = None, tint: Vec = WHITE, glow: float = 0.0, step: float | None = None,
        shift: tuple[float, float] = (0.0, 0.0),
    ) -> None:  # fmt: skip
        """Parallelogram seen from outside; one texture per `tile` metres, or a `cell` of it."""
        o, a, b = (np.asarray(v, np.float32) for v in (top_left, right, down))
        la, lb = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        step = step or self.step
        na, nb = max(2, int(np.ceil(la / step)) + 1), max(2, int(np.ceil(lb / step)) + 1)
        t, s = np.meshgrid(np.linspace(0, 1, nb), np.linspace(0, 1, na), indexing="ij")
        s, t = s.ravel()[:, None], t.ravel()[:, None]
        normal = np.broadcast_to(np.cross(b, a), (na * nb, 3))
        uv = np.hstack([s, t]).astype(np.float32)
        uv = cell.apply(uv) if cell else uv * [la / tile, lb / tile] + np.asarray(shift)
        self.add(material, o + s * a + t * b, normal, uv, grid_faces(nb, na), tint, glow)

    def sheet(
        self, material: str, points: Vec, *, tile: float = 1.0, tint: Vec = WHITE, glow: float = 0.0
    ) -> None:
        """Curved surface through points (R, C, 3): rows downwards, columns to the right.

        tint: (3,) or (R * C, 3).
        """
        p = np.asarray(points, np.float32)
        right, down = np.gradient(p, axis=1), np.gradient(p, axis=0)
        run = [np.cumsum(np.linalg.norm(d, axis=2), axis=a) for d, a in ((right, 1), (down, 0))]
        uv = np.stack(run, -1) / tile
        normals = np.cross(down, right)
        self.add(material, p, normals, uv, grid_faces(*p.shape[:2]), tint, glow)

    def box(
        self, material: str, centre: Vec, size: Vec, *, yaw: float = 0.0, tile: float = 1.0,
        cell: Cell | None = None, tint: Vec = WHITE, glow: float = 0.0, step: float | None = None,
        shift: tuple[float, float] = (0.0, 0.0), tilt: Array | None = None,
    ) -> None:  # fmt: skip
        """Box (width x, height y, depth z) turned by `yaw`; a `cell` covers each face."""
        r = turn(yaw) if tilt is None else turn(yaw) @ tilt
        c, (w, h, d) = np.asarray(centre, np.float32), np.asarray(size, np.float32)
        x, y, z = r @ np.array([w, 0, 0]), r @ np.array([0, h, 0]), r @ np.array([0, 0, d])
        more: dict[str, Any] = {
            "tile": tile,
            "cell": cell,
            "tint": tint,
            "glow": glow,
            "step": step,
            "shift": shift,
        }
        self.panel(material, c - x / 2 - y / 2 - z / 2, x, y, **more)  # front, towards -z
        self.panel(material, c + x / 2 - y / 2 + z / 2, -x, y, **more)
        self.panel(material, c - x / 2 - y / 2 + z / 2, -z, y, **more)
        self.panel(material, c + x / 2 - y / 2 - z / 2, z, y, **more)
        self.panel(material, c - x / 2 - y / 2 + z / 2, x, -z, **more)  # top
        self.panel(material, c - x / 2 + y / 2 - z / 2, x, z, **more)

    def tube(
        self, material: str, points: Vec, radius: float | Vec, *, sides: int = 7, tile: float = 0.5,
        tint: Vec = WHITE, glow: float = 0.0,
    ) -> None:  # fmt: skip
        """Round tube along a polyline (K, 3), open at both ends."""
        p = np.asarray(points, np.float32)
        r = np.broadcast_to(np.asarray(radius, np.float32), (len(p),))[:, None, None]
        along = _unit(np.gradient(p, axis=0))
        helper = np.where(np.abs(along[:, 1:2]) > 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
        e1 = _unit(np.cross(along, helper).astype(np.float32))
        e2 = np.cross(along, e1)
        angle = np.linspace(0, 2 * np.pi, sides + 1)[None, :, None]
        n = e1[:, None] * np.cos(angle) + e2[:, None] * np.sin(angle)
        length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
        turnings = np.broadcast_to(np.linspace(0, 1, sides + 1), n.shape[:2])
        uv = np.stack([turnings, np.broadcast_to(length[:, None] / tile, n.shape[:2])], -1)
        self.add(material, p[:, None] + r * n, n, uv, grid_faces(len(p), sides + 1), tint, glow)

    def lathe(
        self, material: str, foot: Vec, profile: Vec, *, sides: int = 12, tint: Vec = WHITE,
        glow: float = 0.0, tile: tuple[float, float] = (1.0, 1.0),
    ) -> None:  # fmt: skip
        """Turned shape on `foot`; profile (K, 2) of radius and height, from top to bottom."""
        radius, height = np.asarray(profile, np.float32).T
        angle = np.linspace(0, 2 * np.pi, sides + 1)
        ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
        v = radius[:, None, None] * ring - height[:, None, None] * np.array([0, 1.0, 0])
        dr, dh = np.gradient(radius), np.gradient(height)
        n = -dh[:, None, None] * ring - dr[:, None, None] * np.array([0, 1.0, 0])
        u, w = np.meshgrid(angle / (2 * np.pi), np.linspace(0, 1, len(radius)))
        uv = np.stack([u * tile[0], w * tile[1]], -1)
        self.add(
            material, np.asarray(foot) + v, n, uv, grid_faces(len(radius), sides + 1), tint, glow
        )

    def ball(self, material: str, centre: Vec, radii: Vec, *, sides: int = 10, tint: Vec = WHITE,
             tile: tuple[float, float] = (2.0, 1.0), glow: float = 0.0) -> None:  # fmt: skip
        """Ellipsoid with half axes `radii` (3,)."""
        theta, phi = np.meshgrid(
            np.linspace(0, np.pi, sides // 2 + 2),
            np.linspace(0, 2 * np.pi, sides + 1),
            indexing="ij",
        )
        n = np.stack([np.sin(theta) * np.cos(phi), -np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
        uv = np.stack([phi / (2 * np.pi) * tile[0], theta / np.pi * tile[1]], -1)
        r = np.asarray(radii, np.float32)
        self.add(
            material, np.asarray(centre) + n * r, n / r, uv, grid_faces(*n.shape[:2]), tint, glow
        )

    def leaves(
        self, material: str, centres: Vec, outward: Vec, size: float, rng: np.random.Generator,
        *, tint: Vec = WHITE, spread: float = 0.25, slender: float = 0.55,
    ) -> None:  # fmt: skip
        """Leaves (four-cornered lozenges) at centres (N, 3), lit as if they faced `outward`."""
        c, out = np.asarray(centres, np.float32), _unit(np.asarray(outward, np.float32))
        n = len(c)
        axis = _unit(rng.standard_normal((n, 3)) + 0.6 * out + [0, 0.4, 0])
        side = _unit(np.cross(axis, _unit(rng.standard_normal((n, 3)) + offset(0, 0, 0.8))))
        long = size * rng.uniform(0.6, 1.3, (n, 1))
        corners = [-axis * long, side * long * slender, axis * long, -side * long * slender]
        v = np.stack([c + 0.5 * k for k in corners], 1)
        uv = np.broadcast_to(np.array([[0.5, 0], [1, 0.5], [0.5, 1], [0, 0.5]]), (n, 4, 2))
        faces = np.arange(n)[:, None, None] * 4 + np.array([[0, 1, 2], [0, 2, 3]])
        lift = np.exp(spread * rng.standard_normal((n, 1, 1)))
        warm = 1 + 0.15 * rng.standard_normal((n, 1, 3)) * [1, 0.3, 0.8]
        tints = np.clip(np.asarray(tint) * lift * warm, 0.05, 1.8)
        tints = np.broadcast_to(tints, (n, 4, 3)).reshape(-1, 3)
        normals = np.repeat(_unit(out + 0.35 * rng.standard_normal((n, 3))), 4, axis=0)
        self.add(material, v, normals, uv, faces.reshape(-1, 3), tints)

    def meshes(self) -> list[TexturedMesh]:
        """The pieces joined, one mesh per material, in the order of the materials' names."""
        out = []
        for name in sorted(self._parts):
            parts = self._parts[name]
            starts = np.cumsum([0] + [len(p[0]) for p in parts[:-1]])
            arrays = [np.concatenate([p[k] for p in parts]).astype(np.float32) for k in range(5)]
            faces = np.concatenate([p[5] + s for p, s in zip(parts, starts, strict=True)])
            v, n, uv, tint, glow = arrays
            faces = faces.astype(np.uint32)
            out.append(TexturedMesh(name, v, n, uv, tint, glow, faces, self.textures[name]))
        return out

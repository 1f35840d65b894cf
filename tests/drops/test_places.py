from __future__ import annotations

import numpy as np
import pytest

from pipeline.drops import places, places_street
from pipeline.drops.places_parts import Builder, Cell
from pipeline.errors import UserError


@pytest.fixture(scope="module", params=places.NAMES)
def place(request: pytest.FixtureRequest) -> places.Place:
    return places.build(request.param, 5)


def test_same_seed_same_place(place: places.Place) -> None:
    again = places.build(place.name, 5)
    for a, b in zip(place.meshes, again.meshes, strict=True):
        for field in ("vertices", "normals", "uv", "tint", "glow", "faces", "texture"):
            np.testing.assert_array_equal(getattr(a, field), getattr(b, field))
    np.testing.assert_array_equal(place.sky, again.sky)


def test_another_seed_another_layout() -> None:
    one, other = (places_street.build(np.random.default_rng(s)).meshes() for s in (1, 2))
    assert [len(m.vertices) for m in one] != [len(m.vertices) for m in other]


def test_meshes_are_valid(place: places.Place) -> None:
    for mesh in place.meshes:
        n = len(mesh.vertices)
        assert mesh.faces.min() >= 0 and mesh.faces.max() < n
        assert mesh.normals.shape == mesh.vertices.shape == mesh.tint.shape == (n, 3)
        assert mesh.uv.shape == (n, 2) and mesh.glow.shape == (n,)
        for values in (mesh.vertices, mesh.normals, mesh.uv, mesh.tint, mesh.texture):
            assert np.isfinite(values).all()
        assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-4
        assert mesh.texture.min() >= 0 and mesh.texture.max() <= 1
        assert mesh.tint.min() >= 0 and mesh.glow.min() >= 0


def test_atlases_are_never_read_outside_their_border(place: places.Place) -> None:
    atlases = [m for m in place.meshes if m.name in ("window", "sign", "poster", "spine")]
    for mesh in (m for m in atlases if m.name != "poster" or place.name == "street"):
        assert mesh.uv.min() > 0 and mesh.uv.max() < 1


def test_place_has_depth_and_nothing_touches_the_cameras(place: places.Place) -> None:
    points = np.concatenate([m.vertices for m in place.meshes])
    ahead = points[(points[:, 2] > 0.5) & (np.abs(points[:, 0]) < 0.55 * points[:, 2])]
    near, far = np.percentile(ahead[:, 2], [2, 99])
    assert near < 6.5 and far > 8
    assert np.linalg.norm(points, axis=1).min() > 1.0


def test_panel_faces_the_viewer_with_its_texture_upright() -> None:
    b = Builder({"a": np.ones((2, 2, 3), np.float32)})
    b.panel("a", [-1, -1, 5], [2, 0, 0], [0, 2, 0], cell=Cell(1, 0, 2, 1), step=3)
    (mesh,) = b.meshes()
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0, -1], (4, 1)), atol=1e-6)
    left, top = mesh.vertices[:, 0] < 0, mesh.vertices[:, 1] < 0
    np.testing.assert_allclose(mesh.uv[left, 0], 0.505, atol=1e-6)
    np.testing.assert_allclose(mesh.uv[top, 1], 0.01, atol=1e-6)
    a, c, d = (mesh.vertices[mesh.faces[0][k]] for k in range(3))
    assert np.cross(c - a, d - a) @ [0, 0, -1] > 0


def test_box_normals_point_out() -> None:
    b = Builder({"a": np.ones((2, 2, 3), np.float32)})
    b.box("a", [1, 2, 3], [1, 2, 0.5], yaw=0.4)
    (mesh,) = b.meshes()
    assert ((mesh.vertices - [1, 2, 3]) * mesh.normals).sum(1).min() > 0.2


def test_unknown_place_is_refused() -> None:
    with pytest.raises(UserError, match="atlantis"):
        places.build("atlantis", 1)


def _panels(monkeypatch: pytest.MonkeyPatch, name: str, seed: int) -> list[tuple[np.ndarray, ...]]:
    """Corner, right and down (3,) of every panel of the place, and what it is made of."""
    seen: list[tuple[np.ndarray, ...]] = []
    panel = Builder.panel

    def noted(
        self: Builder, material: str, corner: object, right: object, down: object, **more: object
    ) -> None:
        seen.append(tuple(np.asarray(v, np.float64) for v in (corner, right, down)))
        panel(self, material, corner, right, down, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(Builder, "panel", noted)
    places.build(name, seed)
    return seen


@pytest.mark.parametrize(
    ("name", "seed"),
    [("street", 3), ("street", 7), ("street", 100), ("diorama", 5), ("room", 12), ("harbour", 3)],
)
def test_no_two_surfaces_lie_in_one_plane(
    monkeypatch: pytest.MonkeyPatch, name: str, seed: int
) -> None:
    """Where two do, rounding decides which one a photo shows, and views contradict each other.

    What faces down or away from the cameras is left out: bottoms and backs of boxes, on the ground and
    inside walls. Joints of less than 0.02 square metres, of one material, may share a plane.
    """
    corner, right, down = (np.array(v) for v in zip(*_panels(monkeypatch, name, seed), strict=True))
    normal = np.cross(down, right)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    level = (normal * corner).sum(1)
    both = (normal @ normal.T > 1 - 1e-6) & (np.abs(level[:, None] - level) < 5e-4)
    both &= np.triu(np.ones(both.shape, bool), 1) & (normal[:, 1] < 0.9) & (level < 0)
    steps = (np.arange(8) + 0.5) / 8
    s, t = (v.ravel()[:, None] for v in np.meshgrid(steps, steps))
    for first, second in np.argwhere(both):
        for one, other in ((first, second), (second, first)):
            points = corner[one] + s * right[one] + t * down[one] - corner[other]
            frame = np.stack([right[other], down[other], normal[other]], 1)
            place = (points @ np.linalg.inv(frame).T)[:, :2]
            inside = ((place > 1e-3) & (place < 1 - 1e-3)).all(1).mean()
            assert inside * np.linalg.norm(np.cross(right[one], down[one])) < 0.02, corner[one]

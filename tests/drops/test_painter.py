"""Optics and painter: Snell, Fresnel, colour, defocus, composition, training pairs."""

from __future__ import annotations

import numpy as np
import pytest

from pipeline.drops.backgrounds import KINDS, sample_background
from pipeline.drops.optics import (
    WATER,
    defocus,
    fresnel,
    linear_to_srgb,
    make_environment,
    refract,
    srgb_to_linear,
)
from pipeline.drops.painter import paint, scatter
from pipeline.drops.pairs import sample_pair, sample_shots
from pipeline.drops.shape import Drop, coverage_raster


def test_refraction_obeys_snell() -> None:
    rng = np.random.default_rng(0)
    ray = rng.normal([0, 0, 2.5], 1.0, (500, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    normal = np.tile([0.0, 0.0, 1.0], (500, 1))
    bent, total = refract(ray, normal, WATER)
    sine_in = np.hypot(ray[:, 0], ray[:, 1])
    sine_out = np.hypot(bent[:, 0], bent[:, 1])
    assert np.allclose(sine_out[~total], WATER * sine_in[~total])
    assert np.allclose(np.linalg.norm(bent, axis=1), 1)
    forward = ray[:, 2] > 0
    assert (total == (sine_in * WATER > 1))[forward].all()
    assert total.any()
    back, none = refract(bent[~total], normal[~total], 1 / WATER)
    assert not none.any()
    assert np.allclose(back[forward[~total]], ray[~total][forward[~total]])


def test_fresnel_at_normal_incidence_and_beyond_the_critical_angle() -> None:
    passed = fresnel(np.array([1.0, 0.5]), WATER)
    assert passed[0] == pytest.approx(1 - ((WATER - 1) / (WATER + 1)) ** 2)
    assert passed[1] == 0  # 60 degrees in water: total


def test_colour_encoding_round_trips() -> None:
    values = np.linspace(0, 1, 256, dtype=np.float32).reshape(16, 16, 1).repeat(3, 2)
    assert np.abs(linear_to_srgb(srgb_to_linear(values)) - values).max() < 1e-3
    assert srgb_to_linear(np.full((1, 1, 3), 0.5, np.float32))[0, 0, 0] == pytest.approx(
        0.21404, abs=1e-4
    )


def test_environment_shows_the_photo_where_it_is() -> None:
    photo = np.zeros((60, 80, 3), np.float32)
    photo[:, 40:] = 1.0
    seen = make_environment(photo, 60.0)
    ray = np.array([[20.0, 0, 60], [-20.0, 0, 60]])
    light = seen.look(ray / np.linalg.norm(ray, axis=1, keepdims=True))
    assert light[0] == pytest.approx(np.ones(3), abs=0.02)
    assert light[1] == pytest.approx(np.zeros(3), abs=0.02)


def test_dry_pane_changes_nothing() -> None:
    image = np.random.default_rng(0).random((40, 50, 3), dtype=np.float32)
    out, coverage = paint(image, [], focal_px=60, pane_distance=0.1)
    assert np.array_equal(out, image)
    assert not coverage.any()


def test_drop_shows_the_scene_upside_down() -> None:
    image = np.full((160, 160, 3), 0.1, np.float32)
    image[:, 80:] = 0.8
    drop = Drop((0.0, 0.0), 0.008, np.radians(50))  # its focal length is 31 mm
    out, coverage = paint(image, [drop], focal_px=500, pane_distance=0.1)
    assert coverage[80, 80] == 1
    left, right = out[70:90, 60:74].mean(), out[70:90, 86:100].mean()
    assert left > right + 0.3
    top = image.transpose(1, 0, 2).copy()
    out, _ = paint(top, [drop], focal_px=500, pane_distance=0.1)
    assert out[60:74, 70:90].mean() > out[86:100, 70:90].mean() + 0.3
    # Closer than its focal length, a drop is a magnifying glass.
    near = Drop((0.0, 0.0), 0.03, np.radians(50))
    out, _ = paint(image, [near], focal_px=160, pane_distance=0.1)
    assert out[70:90, 86:100].mean() > out[70:90, 60:74].mean() + 0.3


def test_coverage_is_the_shape_seen_by_the_camera() -> None:
    image = np.full((120, 160, 3), 0.5, np.float32)
    drops = [Drop((0.01, -0.005), 0.008, 1.0, tail_length=2.0), Drop((-0.02, 0.01), 0.005, 0.8)]
    _, coverage = paint(image, drops, focal_px=200, pane_distance=0.1)
    seen = coverage_raster(drops, 0.04, 0.03, 0.0005)
    assert np.mean((coverage > 0.5) != seen) < 0.002
    out, blurred = paint(image, drops, focal_px=200, pane_distance=0.1, aperture_radius=0.002)
    assert blurred.sum() == pytest.approx(coverage.sum(), rel=1e-3)
    assert np.count_nonzero(blurred) > 1.3 * np.count_nonzero(coverage)
    assert np.array_equal(out[blurred == 0], image[blurred == 0])


def test_defocused_layer_is_composed_in_linear_light() -> None:
    image = np.full((64, 64, 3), 0.25, np.float32)
    drop = [Drop((0.0, 0.0), 0.01, np.radians(40))]
    kwargs = {"focal_px": 64.0, "pane_distance": 0.1, "highlight": 0.0, "sky_gain": 1.0}
    out, alpha = paint(image, drop, aperture_radius=0.008, **kwargs)  # type: ignore[arg-type]
    sharp, mask = paint(image, drop, **kwargs)  # type: ignore[arg-type]
    gain = srgb_to_linear(out) - srgb_to_linear(image) * (1 - alpha[..., None])
    layer = srgb_to_linear(sharp) - srgb_to_linear(image) * (1 - mask[..., None])
    assert gain.sum() == pytest.approx(layer.sum(), rel=0.02)


def test_defocus_keeps_the_sum() -> None:
    layer = np.zeros((41, 41, 4), np.float32)
    layer[20, 20] = 1
    spread = defocus(layer, 11.0)
    assert spread[..., 3].sum() == pytest.approx(1, rel=1e-4)
    assert spread[20, 20, 3] == pytest.approx(1 / (np.pi * 5.5**2), rel=0.03)


def test_scatter_covers_about_the_wanted_share() -> None:
    shares = []
    for seed in range(8):
        drops = scatter(np.random.default_rng(seed), (128, 128), 0.2, (4.0, 14.0))
        shares.append(coverage_raster(drops, 64, 64, 1.0).mean())
    assert np.mean(shares) == pytest.approx(0.2, abs=0.05)


def test_pairs_are_repeatable_and_sometimes_dry() -> None:
    background = sample_background(np.random.default_rng(4), 64)
    one, two = (sample_pair(np.random.default_rng(11), background) for _ in range(2))
    assert one[0].tobytes() == two[0].tobytes()
    assert one[1].tobytes() == two[1].tobytes()
    rng = np.random.default_rng(5)
    pairs = [sample_pair(rng, background, clean_share=0.3) for _ in range(16)]
    dry = [not coverage.any() for _, coverage in pairs]
    assert 1 <= sum(dry) <= 11
    for rainy, coverage in pairs:
        assert rainy.dtype == coverage.dtype == np.float32
        assert rainy.shape == (64, 64, 3) and coverage.shape == (64, 64)
        assert rainy.min() >= 0 and rainy.max() <= 1
        assert coverage.min() >= 0 and coverage.max() <= 1


def test_veils_are_fainter_than_drops() -> None:
    background = sample_background(np.random.default_rng(4), 96)
    changes = []
    for kind in ("drops", "veils"):
        rngs = [np.random.default_rng([0, k]) for k in range(12)]
        shots = [sample_shots(rng, background, clean_share=0, kind=kind) for rng in rngs]
        changes.append(np.concatenate([np.abs(wet - dry)[c > 0.05] for wet, dry, c in shots]))
    assert 0.01 < changes[1].mean() < 0.7 * changes[0].mean()


def test_films_have_no_outline_and_their_coverage_is_what_changed() -> None:
    background = sample_background(np.random.default_rng(4), 96)
    steepest, inside, outside = [], [], []
    for k in range(12):
        rng = np.random.default_rng([0, k])
        wet, dry, cover = sample_shots(rng, background, clean_share=0, kind="films")
        assert cover.dtype == wet.dtype == np.float32
        assert 0 <= cover.min() <= cover.max() <= 1 and 0 <= wet.min() <= wet.max() <= 1
        steepest.append(np.quantile(np.abs(np.diff(cover, axis=1)), 0.9))
        inside.append(np.abs(wet - dry)[cover > 0.3])
        outside.append(np.abs(wet - dry)[cover == 0])
    assert np.median(steepest) < 0.25  # a drop in focus goes from 0 to 1 within a pixel
    assert np.concatenate(inside).mean() > 3 * np.concatenate(outside).mean()


@pytest.mark.parametrize("kind", sorted(set(KINDS), key=lambda f: f.__name__))
def test_backgrounds_are_pictures(kind) -> None:  # type: ignore[no-untyped-def]
    picture = kind(np.random.default_rng(0), 64)
    assert picture.shape == (64, 64, 3)
    assert np.isfinite(picture).all()
    assert picture.std() > 0.005
    other = kind(np.random.default_rng(1), 64)
    assert not np.array_equal(picture, other)


def test_backgrounds_do_without_photos() -> None:
    picture = sample_background(np.random.default_rng(2), 80, photo_share=0.0)
    assert picture.dtype == np.float32
    assert picture.shape == (80, 80, 3)
    assert picture.min() >= 0 and picture.max() <= 1
    again = sample_background(np.random.default_rng(2), 80, photo_share=0.0)
    assert picture.tobytes() == again.tobytes()

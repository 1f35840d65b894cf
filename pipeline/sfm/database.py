"""Features and matches: the COLMAP database of one attempt, made the same way every time."""

from __future__ import annotations

import zlib  # noqa: F401  before pycolmap, see the package
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import pycolmap

from pipeline.errors import UserError
from pipeline.sfm.result import Matcher, Matching, Settings

Progress = Callable[[str, int, int], None]
SEQUENCE_OVERLAP = 10


def build_database(
    path: Path,
    image_dir: Path,
    mask_dir: Path | None,
    sizes: Mapping[str, tuple[int, int]],
    focal_px: Mapping[str, float],
    settings: Settings,
    *,
    seed: int,
    threads: int,
    progress: Progress,
    pairs: Sequence[tuple[str, str]] | None = None,
) -> Matching:
    """Writes a new database with cameras, features and verified matches; returns their counts.

    `pairs` are the images that are matched, by name; without them `settings.matcher` chooses.

    Images are entered in name order before any feature is computed, RANSAC is seeded, and features are
    matched on one thread, so that the content does not depend on `threads`. UserError when an image
    cannot be read.
    """
    path.unlink(missing_ok=True)
    pycolmap.set_random_seed(seed)
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if settings.masked and mask_dir is not None:
        reader.mask_path = str(mask_dir)
    pycolmap.Database.open(str(path)).close()
    _enter_images(path, image_dir, sizes, settings, reader)
    _set_focal_lengths(path, sizes, focal_px)
    _extract(path, image_dir, sorted(sizes), settings, reader, threads, progress)
    _match(path, settings, seed, progress, pairs)
    return read_matching(path)


def _enter_images(
    path: Path,
    image_dir: Path,
    sizes: Mapping[str, tuple[int, int]],
    settings: Settings,
    reader: pycolmap.ImageReaderOptions,
) -> None:
    """One camera per image, or one per size: pycolmap would drop a second size silently."""
    mode = pycolmap.CameraMode.PER_IMAGE
    groups: list[list[str]] = [sorted(sizes)]
    if settings.camera == "single":
        mode = pycolmap.CameraMode.SINGLE
        by_size = {size: [n for n in sorted(sizes) if sizes[n] == size] for size in sizes.values()}
        groups = [by_size[size] for size in sorted(by_size)]
    for group in groups:
        pycolmap.import_images(path, image_dir, camera_mode=mode, image_names=group, options=reader)
    with pycolmap.Database.open(str(path)) as database:
        entered = {image.name for image in database.read_all_images()}
    missing = sorted(sizes.keys() - entered)
    if missing:
        raise UserError(
            f"{', '.join(missing)} in {image_dir} could not be read as an image.",
            "Run `python -m stages.ingest` again.",
        )


def _set_focal_lengths(
    path: Path, sizes: Mapping[str, tuple[int, int]], focal_px: Mapping[str, float]
) -> None:
    """Starts each camera from the median focal length known for its images, where one is known."""
    with pycolmap.Database.open(str(path)) as database:
        users: dict[int, list[str]] = {}
        for image in database.read_all_images():
            users.setdefault(image.camera_id, []).append(image.name)
        for camera in database.read_all_cameras():
            known = sorted(focal_px[name] for name in users[camera.camera_id] if name in focal_px)
            if not known:
                continue
            focal = known[len(known) // 2]
            camera.params = [focal, camera.width / 2, camera.height / 2, 0.0]
            camera.has_prior_focal_length = True
            database.update_camera(camera)


def _extract(
    path: Path,
    image_dir: Path,
    names: Sequence[str],
    settings: Settings,
    reader: pycolmap.ImageReaderOptions,
    threads: int,
    progress: Progress,
) -> None:
    options = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False)
    options.max_image_size = settings.max_image_size or -1
    options.sift.max_num_features = settings.max_features
    options.sift.peak_threshold = settings.peak_threshold
    batch = max(4, 2 * threads)
    for start in range(0, len(names), batch):
        progress("features", start, len(names))
        pycolmap.extract_features(
            path,
            image_dir,
            image_names=list(names[start : start + batch]),
            reader_options=reader,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
    progress("features", len(names), len(names))


def pair_count(matcher: Matcher, total: int) -> int:
    """How many pairs of `total` images are matched, about."""
    return total * SEQUENCE_OVERLAP if matcher == "sequential" else total * (total - 1) // 2


def _match(
    path: Path,
    settings: Settings,
    seed: int,
    progress: Progress,
    pairs: Sequence[tuple[str, str]] | None,
) -> None:
    # On one thread: two of pycolmap 4.2's matchers at once find other matches in some of ten runs.
    options = pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    options.sift.max_ratio = settings.max_ratio
    verification = pycolmap.TwoViewGeometryOptions(filter_stationary_matches=settings.still)
    verification.ransac.random_seed = seed
    progress("matching", 0, 1)
    if pairs is not None:
        listed = path.with_name("pairs.txt")
        listed.write_text("".join(f"{first} {second}\n" for first, second in pairs), "utf-8")
        pycolmap.match_image_pairs(
            path,
            matching_options=options,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=listed),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    elif settings.matcher == "exhaustive":
        pycolmap.match_exhaustive(
            path,
            matching_options=options,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    else:
        pairing = pycolmap.SequentialPairingOptions(
            overlap=SEQUENCE_OVERLAP, loop_detection=False, num_threads=1
        )
        pycolmap.match_sequential(
            path,
            matching_options=options,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
    progress("matching", 1, 1)


def read_matching(path: Path) -> Matching:
    """Features per image and its best verified pair, from a database."""
    with pycolmap.Database.open(str(path)) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        keypoints = {
            name: int(database.num_keypoints_for_image(image_id))
            for image_id, name in sorted(names.items())
        }
        pair_ids, geometries = database.read_two_view_geometries()
    best = dict.fromkeys(keypoints, 0)
    partner: dict[str, str | None] = dict.fromkeys(keypoints)
    features: dict[str, set[int]] = {name: set() for name in keypoints}
    for pair_id, geometry in sorted(zip(pair_ids, geometries, strict=True), key=lambda p: p[0]):
        count = len(geometry.inlier_matches)
        first, second = (names[i] for i in pycolmap.pair_id_to_image_pair(pair_id))
        for side, (name, other) in enumerate(((first, second), (second, first))):
            features[name].update(geometry.inlier_matches[:, side].tolist())
            if count > best[name]:
                best[name], partner[name] = count, other
    matched = {name: len(found) for name, found in features.items()}
    return Matching(keypoints, best, partner, matched)

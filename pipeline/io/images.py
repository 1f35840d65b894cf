"""Photographs in, 8-bit RGB PNG inside."""

from __future__ import annotations

import io
import math
import warnings
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError, features

from pipeline.errors import UserError
from pipeline.io.atomic import write_bytes

PHOTO_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".jfif", ".png", ".tif", ".tiff", ".webp", ".bmp", ".heic", ".heif", ".avif"}
)
# Pillow goes by what is in a file, whatever its name: a drawing in PostScript would be run by Ghostscript.
FORMATS = ("JPEG", "PNG", "TIFF", "WEBP", "BMP", "GIF")
OPTIONAL = {"AVIF": ".avif", "HEIF": ".heic"}  # where the packages are
MAX_PIXELS = 200_000_000
# Pillow's own limit is 179 million, fewer than some phones' photos have; MAX_PIXELS is told in words.
Image.MAX_IMAGE_PIXELS = None
# EXIF orientation -> degrees counter-clockwise that make the stored pixels upright. The mirrored codes
# (2, 4, 5, 7) come from editing programs, not cameras; they are undone before the turn.
_TURN = {1: 0, 2: 0, 3: 180, 4: 180, 5: 270, 6: 270, 7: 90, 8: 90}
_MIRRORED = frozenset({2, 4, 5, 7})
_DIAGONAL_35MM = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class PhotoInfo:
    """What a photo's metadata says: turn to be upright (degrees counter-clockwise), focal length (px).

    `mirrored`: its file holds the pixels mirrored; see :func:`unmirrored`.
    """

    upright_turn: int
    focal_px: float | None
    mirrored: bool = False


def _decoded(path: Path, how: int) -> np.ndarray | None:
    """The pixels of a file as OpenCV reads them, BGR unless `how` says otherwise; None: it cannot."""
    try:
        return cv2.imread(str(path), how)
    except cv2.error:  # more pixels than it takes, if the file's header tells the truth
        return None


def read_image(
    path: Path, made_by: str = "ingest", size: tuple[int, int] | None = None
) -> np.ndarray:
    """An (H, W, 3) float32 RGB image in [0, 1] from a file that a stage wrote.

    UserError when it is missing or damaged, or not of `size` (width, height).
    """
    if not path.is_file():
        raise UserError(f"{path} does not exist.", f"Run `python -m stages.{made_by}` first.")
    pixels = _decoded(path, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise UserError(
            f"{path} is not a readable image.", f"Run `python -m stages.{made_by}` again."
        )
    if size is not None and pixels.shape[1::-1] != size:
        raise UserError(
            f"{path} is {pixels.shape[1]}x{pixels.shape[0]}, not {size[0]}x{size[1]}.",
            f"Run `python -m stages.{made_by}` again.",
        )
    return pixels.astype(np.float32) / np.float32(255)


def as_bytes(values: np.ndarray) -> np.ndarray:
    """Values in [0, 1] as 8 bits, clipped and rounded."""
    return np.rint(np.clip(values, 0.0, 1.0) * 255).astype(np.uint8)


def write_image(path: Path, rgb: np.ndarray) -> None:
    """Writes an (H, W, 3) RGB image, float in [0, 1] (clipped, rounded) or uint8, as an 8-bit PNG."""
    if rgb.dtype != np.uint8:
        rgb = as_bytes(rgb)
    done, data = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    if not done:
        raise OSError(f"{path}: the image could not be encoded")
    write_bytes(path, data.tobytes())


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) of the stored pixels, from the file's header; OSError when it tells none or too many."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=_formats()) as photo:
                width, height = photo.size
    except (SyntaxError, ValueError, RuntimeError, EOFError) as error:
        raise OSError(str(error)) from error
    if width * height > MAX_PIXELS:
        raise OSError(f"{path} claims {width}x{height} pixels")
    return width, height


@cache
def _formats() -> tuple[str, ...]:
    """The formats that photos are read in here, registered once in every process."""
    return FORMATS + tuple(kind for kind, suffix in OPTIONAL.items() if can_read(suffix))


@cache
def can_read(suffix: str) -> bool:
    """Whether photos with this lower-case suffix can be read here; HEIC needs an optional package."""
    if suffix in (".heic", ".heif"):
        try:
            from pillow_heif import register_heif_opener
        except ImportError:
            return False
        register_heif_opener()
    return suffix != ".avif" or bool(features.check("avif"))


def read_photo(path: Path) -> tuple[np.ndarray, PhotoInfo]:
    """The stored pixels of a user's photo, (H, W, 3) uint8 RGB as the sensor saw them, and its metadata.

    Grey, palette, RGBA (over black), CMYK, 16-bit and grey float files are converted to 8-bit RGB. UserError
    for what is not an image, is cut short, or has more than MAX_PIXELS.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=_formats()) as photo:
                if photo.width * photo.height > MAX_PIXELS:
                    raise UserError(
                        f"{path} has {photo.width}x{photo.height} pixels.",
                        f"At most {MAX_PIXELS:,} are read; scale it down.",
                    )
                photo.load()
                pixels, info = _sensor_pixels(photo), _photo_info(photo)
                if photo.format == "HEIF":  # decoded upright, whatever EXIF says beside
                    info = replace(info, upright_turn=_heif_turn(path))
                    pixels = turn(pixels, -info.upright_turn)
                return pixels, info
    except UserError:
        raise
    except UnidentifiedImageError:
        raise UserError(
            f"{path} is not an image that can be read.", "Remove it, or convert it to JPEG or PNG."
        ) from None
    except PermissionError as error:
        raise UserError(
            f"{path} cannot be read ({error.strerror}).", "Check its permissions."
        ) from None
    except (OSError, SyntaxError, ValueError, RuntimeError, EOFError) as error:
        raise UserError(  # the last two come from the libraries that read AVIF and HEIC
            f"{path} is damaged or cut short ({error}).", "Copy it again, or remove it."
        ) from None


def _heif_turn(path: Path) -> int:
    """Degrees counter-clockwise by which a HEIC's decoder turns what the sensor saw: its property `irot`."""
    with path.open("rb") as file:
        head = file.read(1 << 20)  # properties stand before the pictures
    at = head.find(b"\0\0\0\x09irot")
    return 0 if at < 0 else head[at + 8] % 4 * 90


def _sensor_pixels(photo: Image.Image) -> np.ndarray:
    if photo.mode.startswith(("I", "F")):
        values = np.nan_to_num(np.asarray(photo).astype(np.float64))
        scale = 255.0 / 65535.0 if values.max() > 255 else 1.0
        if photo.mode == "F" and values.max() <= 1:
            scale = 255.0
        grey = np.rint(np.clip(values * scale, 0, 255)).astype(np.uint8)
        pixels = np.repeat(grey[..., None], 3, axis=2)
    elif photo.has_transparency_data:
        black = Image.new("RGBA", photo.size, (0, 0, 0, 255))
        pixels = np.array(Image.alpha_composite(black, photo.convert("RGBA")).convert("RGB"))
    else:
        pixels = np.array(photo.convert("RGB"))
    info = _photo_info(photo)
    return unmirrored(pixels, info.upright_turn) if info.mirrored else pixels


def unmirrored(pixels: np.ndarray, upright_turn: int) -> np.ndarray:
    """`pixels` of a file that holds them mirrored as the sensor saw them; they may be a mask drawn over it.

    Those that are turned by a quarter to be upright are mirrored top to bottom, others left to right.
    """
    return np.ascontiguousarray(np.flip(pixels, axis=0 if upright_turn % 180 else 1))


def _orientation(photo: Image.Image) -> int:
    code = photo.getexif().get(ExifTags.Base.Orientation, 1)
    return code if code in _TURN else 1


def _photo_info(photo: Image.Image) -> PhotoInfo:
    exif = photo.getexif().get_ifd(ExifTags.IFD.Exif)
    try:
        equivalent = float(exif.get(ExifTags.Base.FocalLengthIn35mmFilm, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        equivalent = 0.0
    diagonal = math.hypot(*photo.size)
    focal = (
        equivalent / _DIAGONAL_35MM * diagonal
        if math.isfinite(equivalent) and equivalent > 0
        else None
    )
    orientation = _orientation(photo)
    return PhotoInfo(_TURN[orientation], focal, orientation in _MIRRORED)


def turn(pixels: np.ndarray, degrees: int) -> np.ndarray:
    """`pixels` turned counter-clockwise by a multiple of 90 degrees, contiguous."""
    if degrees % 90:
        raise ValueError(f"a turn is a multiple of 90 degrees, got {degrees}")
    return np.ascontiguousarray(np.rot90(pixels, (degrees // 90) % 4))


def resized(pixels: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """`pixels` scaled to `size` (width, height): by area averaging down, bicubically up."""
    height, width = pixels.shape[:2]
    if (width, height) == size:
        return pixels
    smaller = size[0] * size[1] < width * height
    return cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)


def shrink(pixels: np.ndarray, longest_side: int) -> np.ndarray:
    """`pixels` scaled down by area averaging until no side exceeds `longest_side`; never enlarged."""
    height, width = pixels.shape[:2]
    factor = longest_side / max(height, width)
    if factor >= 1.0:
        return pixels
    return resized(pixels, (max(1, round(width * factor)), max(1, round(height * factor))))


def write_photo(path: Path, rgb: np.ndarray, focal_px: float) -> None:
    """Writes an (H, W, 3) float RGB image as a JPEG that tells its focal length, as a camera's does."""
    pixels = as_bytes(rgb)
    exif = Image.Exif()
    equivalent = focal_px / math.hypot(*pixels.shape[:2]) * _DIAGONAL_35MM
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = max(1, round(equivalent))
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=95, subsampling=0, exif=exif)
    write_bytes(path, file.getvalue())

"""Fetches the clean photographs that the shipped weights were trained on, from Debian packages.

`python -m experiments.detector.photos OUT` writes OUT/train, OUT/more (those and sixteen further ones, for
weights/unet-difference.safetensors), OUT/unseen (kept for scoring: painted on, and dry) and OUT/dry (kept
for scoring, dry only), JPEG, longest side 1600. They are pictures of Debian's main archive, whose licences
allow all uses of the project; they are not part of it. Needs a machine with Debian 12 (`apt-get download`,
`dpkg-deb`).
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import urllib.request
from pathlib import Path

import cv2

BACKGROUNDS = "usr/share/backgrounds"
PLASMA = "usr/share/wallpapers/{}/contents/images/2560x1600.jpg"
OPENCV = "usr/share/doc/opencv-doc/examples"
# Which pictures of which package; the names are paths inside it, without their common beginning.
PHOTOS: dict[str, tuple[str, tuple[str, ...]]] = {
    "lomiri-wallpapers-16.04": (BACKGROUNDS, (
        "Bridge_by_Sander_Klootwijk.jpg", "Dragonfly_by_Bolly.jpg", "Picture_0B_by_freespace.jpg",
        "Picture_1A_by_freespace.jpg",
        "Wine_by_Jakkub_Mede.jpg", "aitzgorri_by_Aitzol_Berasategi.jpg", "free_by_Peter_Nerlich.jpg",
        "friends_by_Aitzol_Berasategi.jpg", "greentock_by_Peter_Nerlich.jpg",
        "life_by_Aitzol_Berasategi.jpg", "picosdeeuropa_by_Aitzol_Berasategi.jpg",
        "seeding_by_Clements_Engelhardt.jpg", "sunset_by_Aitzol_Berasategi.jpg",
    )),
    "lomiri-wallpapers-20.04": (BACKGROUNDS, ("Kleiber_by_Lukas_Baubkus.jpg",)),
    "mate-backgrounds": (f"{BACKGROUNDS}/mate/nature", (
        "Blinds.jpg", "Dune.jpg", "FreshFlower.jpg", "Garden.jpg", "GreenMeadow.jpg", "LadyBird.jpg",
        "Storm.jpg",
        "TwoWings.jpg", "Wood.jpg", "YellowFlower.jpg",
    )),
    "plasma-workspace-wallpapers": ("", tuple(PLASMA.format(name) for name in (
        "BytheWater", "ColorfulCups", "EveningGlow", "FallenLeaf", "Kite", "OneStandsOut",
        "DarkestHour", "Path", "summer_1am", "Grey",
    ))),
    "opencv-doc": (OPENCV, (
        "alphamat/input_images/plant.jpg", "data/aero1.jpg", "data/aloeL.jpg", "data/board.jpg",
        "data/building.jpg", "data/butterfly.jpg", "data/chicky_512.png", "data/fruits.jpg",
        "data/graf1.png", "data/home.jpg", "data/left.jpg", "data/leuvenA.jpg",
        "data/rubberwhale1.png", "data/smarties.png", "data/squirrel_cls.jpg", "data/stuff.jpg",
        "data/apple.jpg", "data/licenseplate_motion.jpg",
        "data/aero3.jpg", "data/baboon.jpg", "data/basketball1.png", "data/box_in_scene.png",
        "data/ela_original.jpg", "data/messi5.jpg", "data/orange.jpg",
        "data/text_defocus.jpg", "data/text_motion.jpg",
        "text/scenetext01.jpg", "text/scenetext02.jpg", "text/scenetext03.jpg",
        "text/scenetext04.jpg", "text/scenetext05.jpg", "text/scenetext06.jpg",
        "text/scenetext_segmented_word01.jpg", "text/scenetext_segmented_word02.jpg",
        "text/scenetext_segmented_word03.jpg", "text/scenetext_segmented_word04.jpg",
        "text/scenetext_segmented_word05.jpg",
    )),
}  # fmt: skip
# In OUT/more alone. A path names a package of another release of Debian's archive.
BUDGIE = "b/budgie-backgrounds/budgie-backgrounds_3.0-1_all.deb"
JXL = "libj/libjxl-testdata/libjxl-testdata_0.0~git20240106.ff8d743-2_all.deb"
ARCHIVE = "http://deb.debian.org/debian/pool/main/"
FURTHER: dict[str, tuple[str, tuple[str, ...]]] = {
    BUDGIE: (f"{BACKGROUNDS}/budgie", (
        "beacon-street-sunset.jpg", "canyon-wren.jpg", "casa-mila.jpg", "lake-sherburne.jpg",
        "oakland-zoo-otters.jpg", "perched-osprey.jpg", "roman-colosseum.jpg",
        "singaporean-cityscape.jpg", "tea-gardens.jpg",
    )),
    "palapeli-data": ("usr/share/palapeli/collection", (
        "castle-maintenon.jpg", "cincinnati-bridge.jpg", "european-honey-bee.jpg",
        "panther-chameleon-female.jpg",
    )),
    JXL: ("usr/share/libjxl-testdata", (
        "jxl/jpeg_reconstruction/bicycles_restarts.jpg",
        "external/wesaturate/500px/tmshre_riaphotographs_srgb8.png",
        "external/wesaturate/500px/u76c0g_bliznaca_srgb8.png",
    )),
}  # fmt: skip
# Never trained on: a street, a house, signs, a lawn with a barrier, mountains, an animal, a forest.
UNSEEN = ("leuvenA", "home", "scenetext01", "scenetext05", "picosdeeuropa_by_Aitzol_Berasategi",
          "squirrel_cls", "summer_1am", "Garden")  # fmt: skip
# Never trained or painted on: blurred grounds, text out of focus, a crowd, a leaf against the light, ...
DRY = ("Picture_0B_by_freespace", "Blinds", "aero3", "baboon", "basketball1", "box_in_scene",
       "ela_original", "messi5", "orange", "text_defocus", "text_motion")  # fmt: skip
LONGEST = 1600


def fetch(out: Path) -> None:
    """Downloads the packages and writes their photographs."""
    for packages, kinds in ((PHOTOS, ("train", "more")), (FURTHER, ("more",))):
        for package, (beginning, names) in packages.items():
            with tempfile.TemporaryDirectory() as folder:
                archive = _download(package, Path(folder))
                subprocess.run(["dpkg-deb", "-x", archive, folder], check=True)
                for name in names:
                    _keep(Path(folder) / beginning / name, package, out, kinds)


def _download(package: str, folder: Path) -> Path:
    """The package's file: of the release that is installed here, or of the archive where it is a path there."""
    if "/" in package:
        target = folder / Path(package).name
        urllib.request.urlretrieve(ARCHIVE + package, target)
        return target
    subprocess.run(["apt-get", "download", package], cwd=folder, check=True)
    (archive,) = folder.glob("*.deb")
    return archive


def _keep(source: Path, package: str, out: Path, kinds: tuple[str, ...]) -> None:
    photo = cv2.imread(str(source))
    if photo is None:
        raise SystemExit(f"{package} no longer holds {source.name}.")
    # The wallpapers of one package are all called by their size.
    stem = source.parts[-4] if source.stem[0].isdigit() else source.stem
    factor = LONGEST / max(photo.shape[:2])
    if factor < 1:
        photo = cv2.resize(photo, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    kinds = ("unseen",) if stem in UNSEEN else ("dry",) if stem in DRY else kinds
    for kind in kinds:
        target = out / kind / f"{stem}.jpg"
        target.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(target), photo, [cv2.IMWRITE_JPEG_QUALITY, 95])
        print(f"{package}: {target}")


def main() -> None:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    fetch(parser.parse_args().out)


if __name__ == "__main__":
    main()

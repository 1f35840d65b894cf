"""How the loop fares, round by round, on scenes whose truth is known.

    python -m experiments.loop --params params.yaml demo        # after `python -m stages.refine`
    python -m experiments.loop --run --params params.yaml demo  # runs the stage first

One line per scene and round: the glass, the share of pixels dropped, precision, recall and IoU against the
true coverage (> 0.05, or `--covered`), and the PSNR of held-out views of the brief fit on the round's
masks. `masks` is what the detector drew. For a scene without drops every dropped pixel is a false alarm: the
share is what counts.
`--picture FILE` also draws the middle photo of each scene beside its final mask.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np

from experiments.command import sentences
from pipeline.errors import UserError
from pipeline.evaluation.masks import mask_counts, mask_scores
from pipeline.evaluation.references import find_references, read_reference
from pipeline.evaluation.rounds import score_rounds
from pipeline.evaluation.score import Files
from pipeline.io.accounts import REFINE
from pipeline.io.atomic import read_json
from pipeline.io.images import as_bytes, read_image, write_image
from pipeline.io.masks import read_keep_mask
from pipeline.io.paths import ScenePaths
from pipeline.io.scene import read_images_json

COVERED = 0.05
FOUND, TOO_MUCH, MISSED = (0.0, 0.8, 0.0), (0.9, 0.0, 0.0), (0.1, 0.1, 1.0)


def table(root: Path, scene: str, covered: float = COVERED) -> list[str]:
    """The lines of one scene; a pixel is wet where its coverage is above `covered`."""
    paths = ScenePaths(root, scene)
    records = read_images_json(paths.images)
    clean = find_references(paths.truth / "clean", records) or {}
    coverage = find_references(paths.truth / "coverage", records) or {}
    files = {
        r.name: Files(r, paths.data / r.source, paths.images / r.name, paths.refine / r.name, None, None,
                      None, clean.get(r.name), coverage.get(r.name))
        for r in records
    }  # fmt: skip
    about = read_json(paths.refine / "refine.json", "refine", REFINE)
    shares, counts = [], []
    for name, one in files.items():
        drop_mask = ~read_keep_mask(paths.masks / name, one.record.size)
        shares.append(float(drop_mask.mean()))
        if one.coverage is not None:
            true = read_reference(one.coverage, one.record, one.source)[..., 0]
            counts.append(mask_counts(drop_mask, true, covered))
    drawn = {"coverage": float(np.mean(shares))}
    drawn |= mask_scores(counts)._asdict() if counts else {}
    lines = [_line(scene, "masks", drawn, "")]
    for number, numbers in score_rounds(paths.refine, files, covered).items():
        told = about["rounds"][number]
        window = f", over {told['window']} neighbours" if told.get("window") else ""
        lines.append(_line(scene, number, numbers, told["glass"] + window))
    return [*lines, f"| {scene} | ended: {about['why']} |"]


def picture(root: Path, scene: str, covered: float = COVERED) -> np.ndarray:
    """(H, 2W, 3): the middle photo, and again with what the mask found, marked too much, and missed."""
    paths = ScenePaths(root, scene)
    records = read_images_json(paths.images)
    record = records[len(records) // 2]
    photo = read_image(paths.images / record.name)
    drop_mask = ~read_keep_mask(paths.refine / record.name, record.size)
    covers = find_references(paths.truth / "coverage", [record]) or {}
    if record.name not in covers:
        raise UserError(
            f"{paths.truth / 'coverage'} has nothing of {record.name}.", "No --picture."
        )
    true = read_reference(covers[record.name], record, paths.data / record.source)[..., 0] > covered
    marked = photo.copy()
    for where, colour in (
        (drop_mask & true, FOUND), (drop_mask & ~true, TOO_MUCH), (~drop_mask & true, MISSED),
    ):  # fmt: skip
        marked[where] = 0.45 * marked[where] + 0.55 * np.array(colour, np.float32)
    return np.concatenate([photo, marked], axis=1)


def _line(scene: str, what: str, numbers: dict[str, float], glass: str) -> str:
    names = ("coverage", "precision", "recall", "iou")
    cells = [f"{numbers[name]:.3f}" if name in numbers else "–" for name in names]
    psnr = f"{numbers['test_psnr']:.2f}" if "test_psnr" in numbers else "–"
    return f"| {scene} | {what} | {' | '.join(cells)} | {psnr} | {glass} |"


@sentences()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--params", type=Path, default=Path("params.yaml"))
    parser.add_argument(
        "--covered", type=float, default=COVERED, help="true coverage of a wet pixel"
    )
    parser.add_argument("--run", action="store_true", help="run stages.refine of each scene first")
    parser.add_argument("--picture", type=Path, help="of scenes of one size, one below the other")
    flags = parser.parse_args()
    print(
        "| scene | round | dropped | precision | recall | IoU | PSNR | glass |\n" + "|---" * 8 + "|"
    )
    for scene in flags.scenes:
        if flags.run:
            command = [sys.executable, "-m", "stages.refine", "--scene", scene]
            done = subprocess.run([*command, "--params", str(flags.params)])
            if done.returncode:
                sys.exit(done.returncode)  # the stage has said why
        print("\n".join(table(flags.params.resolve().parent, scene, flags.covered)), flush=True)
    if flags.picture:
        root = flags.params.resolve().parent
        rows = [as_bytes(picture(root, scene, flags.covered)) for scene in flags.scenes]
        write_image(flags.picture, np.concatenate(rows))


if __name__ == "__main__":
    main()

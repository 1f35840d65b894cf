"""The rows of the comparison, and the paper's own figures beside them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Row:
    """A method. `key` names its variant, with `-<seed>` where it is fitted (`seeded`); `paper` its row in
    the paper's Table I; `kind` and `split` what is compared with the clean references.
    """

    key: str
    label: str
    paper: str = ""
    seeded: bool = True
    competes: bool = True
    kind: Literal["test", "composite", "input"] = "test"
    split: Literal["test", "train"] = "test"
    name: str = ""

    @property
    def id(self) -> str:
        """The key of the line in a table."""
        return self.name or self.key


ROWS = (
    Row(
        "loop-0", "The wet photos themselves", seeded=False, competes=False, kind="input",
        name="photo",
    ),
    Row("nerf", "NeRF", "NeRF"),
    Row("attgan", "AttGAN", "AttGAN", seeded=False),
    Row("quan", "Quan et al.", "Quan et al.", seeded=False),
    Row("wen", "Wen et al.", "Wen et al.", seeded=False),
    Row("on-attgan", "NeRF+AttGAN", "NeRF+AttGAN"),
    Row("on-quan", "NeRF+Quan et al.", "NeRF+Quan et al."),
    Row("on-wen", "NeRF+Wen et al.", "NeRF+Wen et al."),
    Row("unaveraged", "DerainNeRF without the mean map"),
    Row("derain", "DerainNeRF, as in the paper", "DerainNeRF"),
    Row("loop", "DerainNeRF with the loop (ours)"),
    Row("true", "NeRF with the true masks", competes=False),
    Row("clean", "NeRF on clean photos (the limit)", competes=False),
    Row(
        "loop", "Composite of ours, held-out wet photos", competes=False, kind="composite",
        name="composite",
    ),
    Row(
        "loop", "Composite of ours, input views (others than the rest)", competes=False,
        kind="composite", split="train", name="composite-inputs",
    ),
)  # fmt: skip

PAPER_SCENES = ("Tanabata", "Tanabata-move", "Factory", "Church", "Church-move")
PAPER_METRICS = ("psnr", "ssim", "lpips")
# Table I of the paper: per scene PSNR, SSIM and LPIPS, in the order of PAPER_SCENES.
PAPER: dict[str, tuple[tuple[float, float, float], ...]] = {
    "NeRF": (
        (19.6145, 0.7700, 0.2057), (23.7986, 0.8604, 0.1097), (26.2478, 0.8715, 0.1093),
        (27.5391, 0.945, 0.0921), (27.3940, 0.9520, 0.0817),
    ),
    "AttGAN": (
        (19.7771, 0.8506, 0.1359), (23.7845, 0.9118, 0.0775), (27.7066, 0.9404, 0.0854),
        (25.9504, 0.9514, 0.0752), (26.6045, 0.9525, 0.0760),
    ),
    "Quan et al.": (
        (20.6615, 0.8465, 0.1359), (23.6408, 0.8816, 0.1413), (25.0735, 0.8899, 0.1369),
        (27.3451, 0.9500, 0.0752), (26.6356, 0.9512, 0.1007),
    ),
    "Wen et al.": (
        (20.9196, 0.8399, 0.1293), (23.2868, 0.8784, 0.0923), (27.5619, 0.9153, 0.0815),
        (27.7761, 0.9462, 0.0750), (27.6249, 0.9536, 0.0726),
    ),
    "NeRF+AttGAN": (
        (20.5404, 0.7938, 0.1923), (23.0334, 0.8566, 0.0975), (26.1938, 0.8804, 0.0864),
        (26.2998, 0.9432, 0.0764), (27.2996, 0.9523, 0.0596),
    ),
    "NeRF+Quan et al.": (
        (20.9633, 0.7916, 0.2456), (23.4550, 0.8394, 0.1823), (26.4362, 0.8646, 0.1569),
        (27.3061, 0.9369, 0.1231), (27.3506, 0.9471, 0.1048),
    ),
    "NeRF+Wen et al.": (
        (21.2252, 0.7912, 0.1796), (23.1937, 0.8371, 0.1193), (27.7594, 0.8739, 0.1548),
        (28.0618, 0.9445, 0.0771), (27.3503, 0.9518, 0.0776),
    ),
    "DerainNeRF": (
        (26.0367, 0.8866, 0.1081), (24.5683, 0.8882, 0.0613), (30.8504, 0.9229, 0.0564),
        (30.1028, 0.9676, 0.0426), (28.1776, 0.9570, 0.0562),
    ),
}  # fmt: skip
# Table II: the mean over Tanabata, Factory and Church, as printed. It does not follow from Table I, whose
# mean over them is 28.9966, 0.9257, 0.0690.
PAPER_ABLATION = {
    "unaveraged": (27.2611, 0.9131, 0.0922),
    "derain": (28.3549, 0.9299, 0.0687),
}

"""The numbers of the page: a headline, tiles, a table and what could not be had."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pipeline.io.accounts import judged, unlike
from pipeline.io.accounts import look_up as value

# Heading of the group, label, dotted name, format, whether more is better (None: neither).
ROWS: tuple[tuple[str, str, str, str, bool | None], ...] = (
    ("Held-out views", "PSNR, dB", "test.psnr", ".2f", True),
    ("Held-out views", "SSIM", "test.ssim", ".4f", True),
    ("Held-out views", "LPIPS", "test.lpips", ".4f", False),
    ("Held-out views", "FLIP", "test.flip", ".4f", False),
    ("Held-out views", "PSNR under the drops, dB", "covered.psnr", ".2f", True),
    ("Held-out views", "PSNR beside the drops, dB", "kept.psnr", ".2f", True),
    (
        "Held-out views",
        "PSNR to the photo, beside the drops, dB",
        "selfcheck.kept_psnr",
        ".2f",
        True,
    ),
    ("Cleaned photos", "PSNR, dB", "composite.psnr", ".2f", True),
    ("Cleaned photos", "SSIM", "composite.ssim", ".4f", True),
    ("Cleaned photos", "PSNR under the drops, dB", "composite.covered_psnr", ".2f", True),
    ("Photos as taken", "PSNR, dB", "input.psnr", ".2f", None),
    ("Photos as taken", "SSIM", "input.ssim", ".4f", None),
    ("Photos as taken", "PSNR under the drops, dB", "input.covered_psnr", ".2f", None),
    ("Masks", "IoU with the true drops", "masks.iou", ".3f", True),
    ("Masks", "Precision", "masks.precision", ".3f", True),
    ("Masks", "Recall", "masks.recall", ".3f", True),
    ("Masks", "Share of pixels dropped", "masks.coverage", ".3f", None),
    ("Poses", "Photos placed", "poses.registered", "d", None),
    ("Poses", "Turn off the true one, °", "poses.rotation_deg", ".3f", False),
    ("Poses", "Place off the true one", "poses.translation", ".4f", False),
)


@dataclass(frozen=True)
class Line:
    """A row of the table: this fit's number, the other's, how far ahead, and why one is missing."""

    group: str
    label: str
    own: str
    other: str
    gain: str
    ahead: bool | None
    reason: str


def table(metrics: Mapping[str, Any], other: Mapping[str, Any] | None) -> list[Line]:
    """The lines of the table, where there is a number; `other` are those of the fit to compare with.

    Numbers that were measured on other photos, views or pixels have no difference.
    """
    lines = []
    apart = {name for those in unlike([metrics, other or {}]) for name in those.names}
    for group, label, name, form, rising in ROWS:
        own = value(metrics, name)
        theirs = value(other, name) if other else None
        if own is None and theirs is None:
            continue
        gain, ahead = "", None
        known = own is not None and theirs is not None and own != theirs
        if known and rising is not None and name not in apart:
            gain = f"{own - theirs:+{form}}"
            ahead = (own > theirs) == rising
        reason = metrics.get(name.split(".")[0], {}).get(f"{name.split('.')[1]}_reason", "")
        lines.append(Line(group, label, _cell(own, form), _cell(theirs, form), gain, ahead, reason))
    return lines


def missing(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What of the table has no number, gathered by its reason: (reason, labels under their groups)."""
    by_reason: dict[str, dict[str, list[str]]] = {}
    for group, label, name, _, _ in ROWS:
        place, leaf = name.split(".")
        if reason := metrics.get(place, {}).get(f"{leaf}_reason", ""):
            plain = label.removesuffix(", dB").removesuffix(", °")
            by_reason.setdefault(reason, {}).setdefault(group, []).append(plain)
    return [
        (reason, "; ".join(f"{group}: {', '.join(labels)}" for group, labels in groups.items()))
        for reason, groups in by_reason.items()
    ]


def incomparable(metrics: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Which differences the table leaves out, and why: (reason, labels under their groups)."""
    found = []
    for names, why, what in unlike([metrics, other]):
        groups: dict[str, list[str]] = {}
        for group, label, name, _, _ in ROWS:
            if name in names and None not in (value(metrics, name), value(other, name)):
                groups.setdefault(group, []).append(label.removesuffix(", dB"))
        labels = "; ".join(f"{group}: {', '.join(those)}" for group, those in groups.items())
        if labels:
            reason = f"the two fits' {why} differ, and each is judged on {what} of its own"
            found.append((reason, f"The difference in {labels}"))
    return found


def unmet(scene: str, variant: str) -> list[tuple[str, str]]:
    """Why the fit to compare with is not shown, where it has no numbers: (reason, what)."""
    reason = (
        f"report.compare is {variant}, but artifacts/{scene}/{variant}/metrics.json does not exist: "
        f"name it under comparisons in params.yaml and run `dvc repro report@{scene}`, or correct it"
    )
    return [(reason, "the comparison")]


def called(variant: str) -> str:
    """What the page calls the fit to compare with: that of the shipped parameters by what it is."""
    return "the same field fitted without masks" if variant == "unmasked" else f"the fit {variant}"


def tiles(
    metrics: Mapping[str, Any],
    other: Mapping[str, Any] | None,
    variant: str = "unmasked",
    seen: Mapping[str, Mapping[str, float]] | None = None,
) -> list[tuple[str, str, str]]:
    """The few numbers that matter: (number, unit, what it is).

    `other` are those of the fit `variant`, `seen` what seen.json tells of each view.
    """
    found: list[tuple[str, str, str]] = []
    test, photo = value(metrics, "test.psnr"), value(metrics, "input.psnr")
    theirs = value(other, "test.psnr") if other else None
    same = _judged_alike(metrics, other)
    if test is not None:
        views = f"held-out views{judged(metrics)}"
        found.append((f"{test:.1f}", "dB", f"{views} against clean references"))
        if theirs is not None and same:
            found.append((f"{test - theirs:+.1f}", "dB", f"over {called(variant)}"))
    elif (kept := value(metrics, "selfcheck.kept_psnr")) is not None:
        views = f"held-out views{judged(metrics)}"
        found.append((f"{kept:.1f}", "dB", f"{views} against the photos, beside the drops"))
    mixed = value(metrics, "composite.psnr")
    if mixed is not None and photo is not None:
        found.append((f"{mixed:.1f}", "dB", f"cleaned photos; as taken {photo:.1f} dB"))
    for name, text in (("masks.iou", "IoU of the masks with the true drops"),):
        if (score := value(metrics, name)) is not None:
            found.append((f"{score:.2f}", "", text))
    if (share := value(metrics, "masks.coverage")) is not None:
        found.append((f"{100 * share:.0f}", "%", "of the pixels taken for drops"))
    never = [view["never"] for view in (seen or {}).values() if "never" in view]
    if never:
        guessed = 100 * sum(never) / len(never)
        found.append((f"{guessed:.1f}", "%", "of the views seen by no fitted photo: guessed"))
    placed, total = value(metrics, "poses.registered"), value(metrics, "poses.total")
    if placed is not None and total is not None:
        found.append((f"{placed}/{total}", "", "photos placed"))
    return found


def headline(
    metrics: Mapping[str, Any], other: Mapping[str, Any] | None, variant: str = "unmasked"
) -> str:
    """What came out, in one or two sentences. `other` are the numbers of the fit `variant`."""
    poses = (
        f"{value(metrics, 'poses.registered')} of {value(metrics, 'poses.total')} photos placed."
    )
    test, ssim = value(metrics, "test.psnr"), value(metrics, "test.ssim")
    if test is None or ssim is None:
        kept, fitted = value(metrics, "selfcheck.kept_psnr"), value(metrics, "fitted.psnr")
        if fitted is not None:
            reason = metrics["test"].get("psnr_reason", "not measured")
            text = f"Views at the photos' own poses reach {fitted:.1f} dB against the dry scene"
            return f"{text}; of views held out of the fit: {reason}. {poses}"
        text = "Without clean references the views cannot be judged under the drops"
        text += f"; beside them they match the photos to {kept:.1f} dB" if kept is not None else ""
        return f"{text}. {poses}"
    text = f"Views held out of the fit{judged(metrics)} reach {test:.1f} dB (SSIM {ssim:.3f})"
    text += " against the dry scene"
    theirs = value(other, "test.psnr") if other else None
    if theirs is not None and _judged_alike(metrics, other):
        word = "better" if test >= theirs else "worse"
        text += f", {abs(test - theirs):.1f} dB {word} than {called(variant)}"
    return f"{text}. {poses}"


def _judged_alike(metrics: Mapping[str, Any], other: Mapping[str, Any] | None) -> bool:
    return all("test.psnr" not in those.names for those in unlike([metrics, other or {}]))


def _cell(number: float | None, form: str) -> str:
    return "–" if number is None else format(int(number) if form == "d" else number, form)

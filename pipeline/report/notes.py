"""Short sentences of the page about masks, poses and single photos."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_MODES = {
    "lens-fixed": "The drops stay where they are on the lens",
    "per-image": "Each photo has drops of its own",
    "given": "The masks are not ours",
}
_PHOTO = (
    ("masks.coverage", "{:.1%} dropped"),
    ("input.psnr", "as taken {:.2f} dB"),
    ("composite.psnr", "cleaned {:.2f} dB"),
    ("fitted.psnr", "clean view {:.2f} dB"),
)


def photo_notes(row: Mapping[str, float], seen: Mapping[str, float]) -> list[str]:
    """What is known of one photo. row: its numbers of metrics.csv; seen: its entry of seen.json."""
    notes = [text.format(row[name]) for name, text in _PHOTO if name in row]
    if "never" in seen:
        notes.append(f"{seen['never']:.1%} seen by no fitted photo")
    return notes


def masks_note(about: Mapping[str, Any]) -> str:
    """How the masks were made, from masks.json."""
    if not about:
        return "Nothing is known of how the masks were made."
    mode = _MODES.get(str(about.get("mode")), "The masks were made as they are")
    cut = f" Threshold {about['threshold']}." if "threshold" in about else ""
    return f"{mode}: {about.get('why', 'for no given reason')}.{cut}"


def loop_note(about: Mapping[str, Any]) -> str:
    """Whether the loop repaired the masks and why it ended, from refine.json; "" without it."""
    if not about:
        return ""
    why = about.get("why", "for no given reason")
    if not about.get("rounds"):
        return f" They were not repaired from the scene: {why}."
    return f" Repaired from the scene: {why}."


def round_notes(about: Mapping[str, Any], scores: Mapping[str, Mapping[str, float]]) -> list[str]:
    """What each round made of the masks, from refine.json and the rounds of metrics.json."""
    rounds = []
    for number, told in sorted(about.get("rounds", {}).items(), key=lambda item: int(item[0])):
        text = f"Round {number}: {told['coverage']:.1%} dropped"
        score = scores.get(number, {})
        if "iou" in score:
            text += f", IoU {score['iou']:.3f}"
        if "test_psnr" in score:
            text += f", a brief fit on them {score['test_psnr']:.1f} dB"
        rounds.append(f"{text}.")
    return rounds


def poses_note(account: Mapping[str, Any], total: int) -> str:
    """How many photos were placed and how well, from poses.json."""
    if not account:
        return "Nothing is known of how the photos were placed."
    note = f"{len(account.get('registered', []))} of {total} photos were placed"
    if "points" in account and "reprojection_px" in account:
        error = account["reprojection_px"]
        note += f"; {account['points']} points, {error:.2f} px off on average"
    if account.get("aligned"):
        note += "; the cameras are aligned to the photos' dry pixels"
    return note + "."

from __future__ import annotations

from pipeline.report.notes import loop_note, masks_note, poses_note, round_notes


def test_the_rounds_are_told_in_their_order_with_what_is_known() -> None:
    about = {
        "why": "on the lens; the masks have settled",
        "rounds": {"10": {"coverage": 0.25}, "9": {"coverage": 0.5}},
    }
    assert "on the lens; the masks have settled." in loop_note(about)
    assert round_notes(about, {"9": {"iou": 0.5, "test_psnr": 20.04}}) == [
        "Round 9: 50.0% dropped, IoU 0.500, a brief fit on them 20.0 dB.",
        "Round 10: 25.0% dropped.",
    ]
    assert loop_note({}) == "" and round_notes({}, {}) == []


def test_masks_that_came_along_have_no_threshold_and_no_rounds() -> None:
    why = "they came with the photos (rainMask.npy)"
    assert masks_note({"mode": "given", "why": why}) == f"The masks are not ours: {why}."
    assert masks_note({"mode": "per-image", "why": "w", "threshold": 0.25}).endswith(
        ": w. Threshold 0.25."
    )
    untouched = loop_note({"mode": "none", "why": why, "rounds": {}})
    assert untouched == f" They were not repaired from the scene: {why}."


def test_it_is_said_whether_cameras_were_aligned() -> None:
    account = {"registered": ["a", "b"], "points": 10, "reprojection_px": 0.5}
    assert poses_note(account, 3) == "2 of 3 photos were placed; 10 points, 0.50 px off on average."
    aligned = poses_note({**account, "aligned": True}, 3)
    assert aligned.endswith("; the cameras are aligned to the photos' dry pixels.")

from __future__ import annotations

from pipeline.report.numbers import headline, incomparable, missing, table, tiles

OWN = {
    "test": {"psnr": 28.5, "ssim": 0.91, "lpips": None, "lpips_reason": "no weights"},
    "composite": {"psnr": 31.0},
    "input": {"psnr": 18.0},
    "masks": {"iou": 0.8, "coverage": 0.12},
    "poses": {"registered": 23, "total": 24},
    "conventions": {"data_range": 1.0},
}
OTHER = {"test": {"psnr": 22.0, "ssim": 0.95, "lpips": 0.2}}


def test_the_table_says_who_is_ahead():
    lines = {(line.group, line.label): line for line in table(OWN, OTHER)}
    psnr = lines["Held-out views", "PSNR, dB"]
    assert (psnr.own, psnr.other, psnr.gain, psnr.ahead) == ("28.50", "22.00", "+6.50", True)
    ssim = lines["Held-out views", "SSIM"]
    assert ssim.gain == "-0.0400" and ssim.ahead is False
    lpips = lines["Held-out views", "LPIPS"]
    assert (lpips.own, lpips.other, lpips.gain) == ("–", "0.2000", "")
    assert lpips.reason == "no weights"


def test_what_is_missing_is_listed_by_reason():
    assert missing(OWN) == [("no weights", "Held-out views: LPIPS")]


def test_without_references_the_table_has_no_empty_lines():
    reasons = {"psnr": None, "psnr_reason": "no truth"}
    blind = {"test": reasons, "input": reasons, "selfcheck": {"kept_psnr": 24.0}}
    assert [line.label for line in table(blind, None)] == [
        "PSNR to the photo, beside the drops, dB"
    ]
    assert missing(blind) == [("no truth", "Held-out views: PSNR; Photos as taken: PSNR")]


def test_headline_and_tiles_tell_gain_and_loss_alike():
    assert "28.5 dB (SSIM 0.910)" in headline(OWN, OTHER)
    assert "6.5 dB better" in headline(OWN, OTHER)
    assert "6.5 dB worse" in headline({**OTHER, "poses": OWN["poses"]}, OWN)
    assert ("+6.5", "dB", "over the same field fitted without masks") in tiles(OWN, OTHER)
    assert "over" not in str(tiles(OWN, None)) and "23/24" in str(tiles(OWN, None))


def test_what_was_measured_on_other_views_pixels_or_photos_has_no_difference():
    names = ["a.png", "b.png", "c.png"]
    own = {**OWN, "judged": {"held_out": names, "views": names[:2]}}
    other = {**OTHER, "input": {"psnr": 19.0}, "composite": {"psnr": 25.0}}
    other |= {"judged": {"held_out": names, "views": names}}
    lines = {(line.group, line.label): line for line in table(own, other)}
    for where in (("Held-out views", "PSNR, dB"), ("Cleaned photos", "PSNR, dB")):
        assert (lines[where].gain, lines[where].ahead) == ("", None)
    assert [reason for reason, _ in incomparable(own, other)] == [
        "the two fits' held-out views differ, and each is judged on views of its own",
        "the two fits' photos differ, and each is judged on photos of its own",
    ]
    assert "better" not in headline(own, other) and "(2 of 3) reach 28.5 dB" in headline(own, other)
    assert "over" not in str(tiles(own, other)) and "held-out views (2 of 3)" in str(
        tiles(own, other)
    )
    assert incomparable(OWN, OTHER) == []


def test_nobody_is_ahead_in_photos_that_nobody_made():
    lines = table(OWN, {**OTHER, "input": {"psnr": 18.0}})
    assert [(line.gain, line.ahead) for line in lines if line.group == "Photos as taken"] == [
        ("", None)
    ]


def test_what_no_photo_shows_is_told_as_guessed():
    seen = {"a.png": {"never": 0.01, "fewer_than_3": 0.5}, "b.png": {"never": 0.03}}
    assert ("2.0", "%", "of the views seen by no fitted photo: guessed") in tiles(
        OWN, None, seen=seen
    )
    assert "guessed" not in str(tiles(OWN, None)) + str(tiles(OWN, None, seen={}))


def test_without_references_nothing_is_claimed():
    blind = {
        "test": {"psnr": None, "psnr_reason": "none", "ssim": None, "ssim_reason": "none"},
        "selfcheck": {"kept_psnr": 27.3},
        "poses": {"registered": 3, "total": 3},
    }
    sentence = headline(blind, {})
    assert "cannot be judged under the drops" in sentence and "27.3 dB" in sentence
    assert all("clean references" not in text for _, _, text in tiles(blind, {}))


def test_only_the_fit_without_masks_is_called_so() -> None:
    assert ("+6.5", "dB", "over the fit paper") in tiles(OWN, OTHER, "paper")
    assert headline(OWN, OTHER).endswith(
        "than the same field fitted without masks. 23 of 24 photos placed."
    )
    told = headline(OWN, OTHER, "paper")
    assert "than the fit paper." in told and "without masks" not in told


def test_with_references_but_no_view_held_out_both_are_told() -> None:
    told = headline(
        {
            "test": {"psnr": None, "psnr_reason": "no held-out view was rendered", "ssim": None},
            "fitted": {"psnr": 31.24},
            "poses": OWN["poses"],
        },
        None,
    )
    assert "31.2 dB against the dry scene" in told and "no held-out view was rendered" in told
    assert "Without clean references" not in told

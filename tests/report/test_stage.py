from __future__ import annotations

import json
import re
import shutil
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from pipeline.errors import UserError
from pipeline.io.images import write_image
from pipeline.io.maps import write_map
from pipeline.stage import Job
from stages import evaluate, report
from tests.evaluation.fabricated import fabricate

PARAMS = report.Params(compare="unmasked", picture_size=64, quality=60)
VOID = {"meta", "link", "img", "input", "br", "hr", "source"}


class Tags(HTMLParser):
    """Addresses, ids and text of a page; fails when tags do not close in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.ids: list[str] = []
        self.headings: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in VOID:
            self.open.append(tag)
        for key, text in attrs:
            if key in ("src", "href", "poster", "data", "action"):
                self.addresses.append(text)
            if key == "id":
                self.ids.append(text)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "h3":
            self.headings.append(data)


def make(root, variants=(None, "unmasked")) -> str:
    params = evaluate.Params(lpips_backbone=None, coverage_threshold=0.05)
    for variant in variants:
        evaluate.main(Job(root, "made", variant, "cpu", None, False), params)
    job = Job(root, "made", None, "cpu", None, False)
    closing = report.main(job, PARAMS)
    assert closing.endswith("index.html")
    return (job.paths.report / "index.html").read_text(encoding="utf-8")


def parse(html: str) -> Tags:
    tags = Tags()
    tags.feed(html)
    assert tags.open == []
    return tags


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("scene")
    fabricate(root, prefix="<i>&view")
    make(root)
    return root


@pytest.fixture(scope="module")
def html(root):
    return (root / "artifacts/made/report/index.html").read_text(encoding="utf-8")


def test_the_page_is_whole_escaped_and_needs_nothing_else(root, html):
    tags = parse(html)
    for index in range(9):
        assert f"&lt;i&gt;&amp;view_{index:02d}.png" in html
        assert f"<i>&view_{index:02d}.png" in tags.headings
    assert "<i>" not in html
    assert "&lt;none&gt;" in html, "the reason why the last photo was lost"
    assert not re.search(r"""(https?:)?//[a-z0-9.-]+\.[a-z]{2,}|@import|url\(""", html)
    assert all(address.startswith(("data:", "#")) for address in tags.addresses)
    targets = {address[1:] for address in tags.addresses if address.startswith("#")}
    assert targets <= set(tags.ids) and len(set(tags.ids)) == len(tags.ids)
    assert str(root) not in html


def test_the_page_shows_numbers_of_both_fits_and_the_gap(root, html):
    metrics = json.loads((root / "artifacts/made/metrics.json").read_text())
    other = json.loads((root / "artifacts/made/unmasked/metrics.json").read_text())
    own, theirs = metrics["test"]["psnr"], other["test"]["psnr"]
    for text in (f"{own:.2f}", f"{theirs:.2f}", f"{own - theirs:+.2f}", "8/9"):
        assert f">{text}<" in html
    assert "names no AlexNet weights" in html
    assert html.count("<svg") == 6
    assert "data:video/mp4" in html


def test_every_photo_has_its_six_pictures(html):
    kinds = re.findall(r'<button type="button" data-kind="(\w+)"', html)
    # The lost photo has no clean view, no composite and no depth.
    assert len(kinds) == 8 * 6 + 3
    for kind in ("photo", "attention", "mask", "clean", "composite", "depth"):
        assert kinds.count(kind) == (9 if kind in ("photo", "attention", "mask") else 8)


def test_the_same_bytes_again(tmp_path):
    fabricate(tmp_path, count=3, lost=0)
    assert make(tmp_path, (None,)) == make(tmp_path, (None,))


def test_a_page_without_truth_variant_video_or_fit(tmp_path):
    paths = fabricate(tmp_path, truth=False, variant=None, video=False, lost=0)
    shutil.rmtree(paths.nerf)
    shutil.rmtree(paths.attention)
    (paths.poses / "poses.json").unlink()
    (paths.views / "seen.json").unlink()
    html = make(tmp_path, variants=(None,))
    parse(html)
    assert "cannot be judged under the drops" in html
    assert "does not exist" in html and "no video was made" in html
    assert ">unmasked<" not in html and "<video" not in html
    assert "every photo was placed" not in html and "poses.json, which tells, is not there" in html


@pytest.mark.parametrize("what", ["images", "attention", "views/composite", "views/depth"])
def test_pictures_of_another_size_are_told(tmp_path, what):
    """Left from a run with another size: stretched over the photo they would lie."""
    paths = fabricate(tmp_path, count=3, lost=0)
    for path in (tmp_path / "artifacts/made" / what).iterdir():
        if path.suffix == ".exr":
            write_map(path, np.zeros((7, 9), np.float32))
        elif path.suffix == ".png":
            write_image(path, np.zeros((7, 9, 3), np.float32))
    with pytest.raises(UserError, match=r"is 9x7, (not|its image)"):
        make(tmp_path, variants=(None,))
    assert not (paths.report / "index.html").exists()


def test_a_lost_photo_is_marked_as_lost_though_it_was_to_be_held_out(html):
    assert re.search(r'<a href="#photo-8" class="lost"', html)


def test_a_comparison_without_numbers_is_told_on_the_page_and_on_the_terminal(tmp_path, caplog):
    fabricate(tmp_path, count=3, lost=0)
    html = make(tmp_path, variants=(None,))
    told = "artifacts/made/unmasked/metrics.json does not exist"
    assert told in html and told in caplog.text
    caplog.clear()
    assert told not in make(tmp_path) and told not in caplog.text


def test_bad_calls_are_told(tmp_path):
    fabricate(tmp_path, count=3, lost=0)
    with pytest.raises(UserError, match=r"metrics\.json does not exist") as error:
        make(tmp_path, variants=())
    assert "stages.evaluate" in error.value.hint
    with pytest.raises(UserError, match="variant has no page"):
        report.main(Job(tmp_path, "made", "unmasked", "cpu", None, False), PARAMS)


def test_turned_photos_stand_upright(tmp_path):
    paths = fabricate(tmp_path, count=3, lost=0, truth=True)
    records = json.loads((paths.images / "images.json").read_text())
    records["images"][1]["turned"] = 270
    (paths.images / "images.json").write_text(json.dumps(records))
    for kind in ("clean", "coverage"):
        path = paths.truth / kind / "view_01.png"
        cv2.imwrite(str(path), np.rot90(cv2.imread(str(path)), -3))
    html = make(tmp_path, variants=(None,))
    assert html.count(f"--ratio: {48 / 64:.5f}") == 3  # its card, its slider, the filmstrip


def test_the_page_tells_what_was_tried_and_what_came_in(tmp_path):
    paths = fabricate(tmp_path, count=3, lost=0)
    account = json.loads((paths.poses / "poses.json").read_text())
    account["tried"] = [
        {"label": "first", "registered": 1, "chosen": False},
        {"label": "global mapper", "registered": 3, "chosen": True},
    ]
    (paths.poses / "poses.json").write_text(json.dumps(account))
    listed = json.loads((paths.images / "images.json").read_text())
    listed["origin"] = {"said": ["the photos have mixed sizes <...>"]}
    (paths.images / "images.json").write_text(json.dumps(listed))
    html = make(tmp_path, variants=(None,))
    parse(html)
    assert "<dt>global mapper</dt><dd>3 photos placed, used</dd>" in html
    assert "mixed sizes &lt;...&gt;" in html
    assert html.count('data-film="') == 3

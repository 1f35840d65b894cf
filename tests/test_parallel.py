from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from subprocess import check_output
from typing import Any

import numpy as np
import pytest
from distributed import LocalCluster

from pipeline import parallel
from pipeline.errors import UserError
from pipeline.io.images import image_size, write_image
from pipeline.io.photos import convert, examine
from pipeline.parallel import cut, map_named


def _square(number: int) -> int:
    return number * number


def _thread(_: int) -> int:
    return threading.get_ident()


def _fails(number: int) -> int:
    if number == 2:
        raise ValueError("two is not wanted")
    return number


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as running:
        yield running.scheduler_address


def test_results_come_in_the_order_of_the_names() -> None:
    items = {name: (number,) for number, name in enumerate("zyxab")}
    assert list(map_named(_square, items, job_label="test").items()) == [
        ("a", 9), ("b", 16), ("x", 4), ("y", 1), ("z", 0),
    ]  # fmt: skip


def test_runs_keep_all_workers_busy() -> None:
    assert cut(24, 8, 2) == [range(0, 6), range(6, 12), range(12, 18), range(18, 24)]
    assert cut(7, 8, 2) == [range(0, 3), range(3, 7)]
    assert cut(3, 8, 16) == [range(0, 1), range(1, 2), range(2, 3)]
    assert cut(0, 8, 2) == []
    assert cut(20, 8, 1) == [range(0, 6), range(6, 13), range(13, 20)]


def test_the_bar_counts_the_images_of_a_run(capsys: pytest.CaptureFixture[str]) -> None:
    items = {"a": (1,), "b": (2,)}
    map_named(_square, items, job_label="test", counts={"a": 3, "b": 4})
    assert "0/7" in capsys.readouterr().err


def test_work_leaves_the_calling_thread() -> None:
    threads = map_named(_thread, {str(n): (n,) for n in range(8)}, job_label="test", workers=2)
    assert threading.get_ident() not in threads.values()


def test_a_failure_names_its_item() -> None:
    items = {f"image_{number}.png": (number,) for number in range(4)}
    with pytest.raises(RuntimeError, match=r"image_2\.png.*two is not wanted"):
        map_named(_fails, items, job_label="test")


def test_a_users_fault_stays_one_and_names_its_item(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_text("no photo")
    with pytest.raises(UserError, match=r"a\.jpg"):
        map_named(examine, {"a.png": (tmp_path / "a.jpg",)}, job_label="test")


def test_an_image_is_not_named_twice_by_the_names_inside_and_outside(tmp_path: Path) -> None:
    (tmp_path / "IMG_2.jpg").write_text("no photo")
    with pytest.raises(UserError) as caught:
        map_named(examine, {"IMG_2.png": (tmp_path / "IMG_2.jpg",)}, job_label="test")
    assert caught.value.what.startswith(f"{tmp_path / 'IMG_2.jpg'} is not an image")


def test_a_cluster_of_two_processes_writes_the_same_bytes(tmp_path: Path, cluster: str) -> None:
    rng = np.random.default_rng(0)
    for number in range(5):
        write_image(tmp_path / f"{number}.png", rng.random((40, 50, 3)))
    for folder, scheduler in (("threads", None), ("cluster", cluster)):
        items = {
            f"{number}": (
                tmp_path / f"{number}.png",
                tmp_path / folder / f"{number}.png",
                90,
                (24, 30),
            )
            for number in range(5)
        }
        map_named(convert, items, job_label="test", scheduler=scheduler)
        assert image_size(tmp_path / folder / "0.png") == (24, 30)
    for number in range(5):
        here = (tmp_path / "threads" / f"{number}.png").read_bytes()
        assert here == (tmp_path / "cluster" / f"{number}.png").read_bytes()


def test_a_fault_on_the_cluster_names_its_item(tmp_path: Path, cluster: str) -> None:
    (tmp_path / "a.jpg").write_text("no photo")
    with pytest.raises(UserError, match=r"a\.jpg is not an image"):
        map_named(examine, {"a.png": (tmp_path / "a.jpg",)}, job_label="test", scheduler=cluster)


def test_scenes_that_share_a_cluster_do_not_get_each_others_images(
    tmp_path: Path, cluster: str
) -> None:
    """Frames of two videos have the same names; what one scene has computed is not the other's."""
    found: dict[str, dict[str, bytes]] = {}

    def run(scene: str) -> None:
        (tmp_path / scene).mkdir()
        slow = f"sleep 0.5; echo {scene} | tee {tmp_path / scene}"
        items = {name: (["sh", "-c", f"{slow}/{name}"],) for name in ("a.png", "b.png", "c.png")}
        found[scene] = map_named(check_output, items, job_label="attention", scheduler=cluster)

    threads = [threading.Thread(target=run, args=(scene,)) for scene in ("garden", "street")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for scene in ("garden", "street"):
        assert set(found[scene].values()) == {f"{scene}\n".encode()}
        assert len(list((tmp_path / scene).iterdir())) == 3


def test_a_stream_holds_no_more_than_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "STREAM_BYTES", 100)
    runs: list[int] = []

    def counted(function: Callable[..., Any], items: Mapping[str, Any], **how: Any) -> Any:
        runs.append(len(items))
        return map_named(function, items, **how)

    monkeypatch.setattr(parallel, "map_named", counted)
    items = {f"{number}": (number,) for number in range(7)}
    assert list(parallel.stream_named(_square, items, 30, job_label="test")) == [
        number * number for number in range(7)
    ]
    assert max(runs) <= 3 and sum(runs) == 7

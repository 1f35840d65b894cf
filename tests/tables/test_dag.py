"""The comparison's DAG: valid in every profile, and true to what its stages import and read."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Client
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest
import yaml

from experiments.tables import run, steps, warm
from experiments.tables.run import PROFILES, Share, shares
from pipeline.params import read_folders, read_params, read_section, stage_names
from pipeline.tables.rows import ROWS
from tests.test_architecture import true_code_dependencies

ROOT = Path(__file__).resolve().parents[2]
SCENES, TABLES = ROOT / "experiments/scenes", ROOT / "experiments/tables"
DAG: dict[str, dict[str, Any]] = {
    name: entry
    for file in ("stages.yaml", "table.yaml")
    for name, entry in yaml.safe_load((TABLES / file).read_text())["stages"].items()
}
UP = "../../../"
CODE = ".code/"


def stages_of(entry: dict[str, Any]) -> set[str]:
    words = [
        word
        for command in entry["cmd"]
        if (asked := re.search(r"(?:\$\{steps\}|experiments\.tables\.steps) ([a-z ]+) --", command))
        for word in asked[1].split()
    ]
    return set(words)


@pytest.mark.parametrize("name", DAG)
def test_code_dependencies_are_what_the_stages_import(name: str) -> None:
    stages = stages_of(DAG[name])
    assert stages <= set(stage_names())
    code = {f"stages/{stage}.py" for stage in stages}
    code |= {path for stage in stages for path in true_code_dependencies(stage)}
    code = {"pipeline/io" if path.startswith("pipeline/io/") else path for path in code}
    listed = {dep.removeprefix(CODE) for dep in DAG[name]["deps"] if dep.startswith(CODE)}
    assert listed == code


@pytest.mark.parametrize("folder", [SCENES, *(TABLES / profile for profile in PROFILES)])
def test_folders_are_followed_from_within_the_repository(folder: Path) -> None:
    """Of a folder outside DVC would follow caches too: a repository's .dvcignore ends with it."""
    scenes = yaml.safe_load((SCENES / "dvc.yaml").read_text())["stages"]["scene"]["do"]
    for dep in {dep for entry in (scenes, *DAG.values()) for dep in entry["deps"]}:
        assert not dep.startswith("../") or Path(dep).suffix, f"{dep}: a folder"
    for name in ("pipeline", "stages"):
        assert (folder / CODE / name).readlink().parts[0] == ".."
        assert (folder / CODE / name).resolve() == ROOT / name
    assert "__pycache__" in (folder / ".dvcignore").read_text().split("\n")


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("name", DAG)
def test_every_section_that_the_stages_read_is_followed(name: str, profile: str) -> None:
    keys = {file: set(some) for entry in DAG[name]["params"] for file, some in entry.items()}
    assert keys[f"{UP}params.yaml"] == stages_of(DAG[name])
    for file, place in (("../params.yaml", TABLES), ("params.yaml", TABLES / profile)):
        own = yaml.safe_load((place / "params.yaml").read_text())
        assert keys.get(file, set()) >= stages_of(DAG[name]) & set(own)
    assert f"scenes.{'all' if name == 'table' else '${scene}'}" in keys["../params.yaml"]
    assert not {"scenes", "variants"} & set(own), "a profile's own are not followed"


@pytest.mark.parametrize("profile", PROFILES)
def test_a_profile_is_complete(profile: str) -> None:
    """Every section of every scene and variant validates, and the paths of variants are told."""
    file = TABLES / profile / "params.yaml"
    assert (TABLES / profile / "dvc.yaml").resolve() == TABLES / "table.yaml"
    content = read_params(file)
    comparison = content["comparison"]
    folders = {path.parent for path in (TABLES / profile).glob("*/scene.yaml")}
    assert {folder.name for folder in folders} == set(comparison["scenes"])
    for folder in folders:
        assert (folder / "dvc.yaml").resolve() == TABLES / "stages.yaml"
        scene = yaml.safe_load((folder / "scene.yaml").read_text())
        assert scene["scene"] == folder.name
        rows = ["nerf", "derain", "unaveraged", "true", "clean"]
        assert scene["rows"] == [
            row for row in rows if row != "unaveraged" or folder.name in comparison["lens"]
        ]
    table = importlib.import_module("stages.table").Params
    params = read_section(file, "table", table, "all")
    assert (params.scenes, params.lens, params.seeds) == tuple(
        comparison[key] for key in ("scenes", "lens", "seeds")
    )
    variants = {f"{row.key}-{s}" if row.seeded else row.key for row in ROWS for s in params.seeds}
    for scene in params.scenes:
        for variant in variants | {"unaveraged"}:
            assert variant == "unaveraged" or read_folders(file, variant)
            for stage in ("masks", "restore", "refine", "nerf", "render", "evaluate", "shrink"):
                section = importlib.import_module(f"stages.{stage}").Params
                read_section(file, stage, section, scene, variant)


def test_variants_of_a_row_differ_in_their_seed_alone() -> None:
    variants = read_params(TABLES / "quick/params.yaml")["variants"]
    for row in ROWS:
        if row.seeded:
            texts = set()
            for seed in range(3):
                assert variants[f"{row.key}-{seed}"]["nerf"]["seed"] == seed
                text = str(variants[f"{row.key}-{seed}"])
                texts.add(re.sub(rf"('seed': |loop-){seed}", r"\1N", text))
            assert len(texts) == 1
    assert variants["clean-0"]["folders"]["images"] == "small/clean"
    assert variants["on-wen-1"]["nerf"]["use_masks"] is False


def test_one_seed_of_everything_comes_before_the_next() -> None:
    names = [
        "prepare", "restore@wen", "restore@quan", "fit@nerf-0", "fit@nerf-1",
        "loop@0", "loop@1", "cleaned@wen-0", "cleaned@wen-1",
    ]  # fmt: skip
    targets = [f"a/dvc.yaml:{name}" for name in names]
    assert [
        [target.removeprefix("a/dvc.yaml:") for target in share.targets]
        for share in shares([*targets, "table"])
    ] == [
        ["prepare"],
        ["fit@nerf-0", "loop@0"],
        ["restore@wen", "restore@quan"],
        ["cleaned@wen-0"],
        ["fit@nerf-1", "loop@1"],
        ["cleaned@wen-1"],
    ]


def test_every_target_is_made_once_and_within_its_own_scene() -> None:
    """Those that DVC names in the quick profile; names of scenes begin with one another there."""
    command = [sys.executable, "-m", "dvc", "stage", "list", "--all", "--name-only"]
    listed = subprocess.run(
        command, cwd=TABLES / "quick", capture_output=True, text=True, check=True
    )
    targets = listed.stdout.split()
    made = shares(targets)
    assert sorted([*(t for share in made for t in share.targets), "table"]) == sorted(targets)
    for share in made:
        assert all(target.startswith(f"{share.scene}/dvc.yaml:") for target in share.targets)
    rows = [row for row in ROWS if row.seeded and row.name == ""]
    seeded = {share.what for share in made if "seed" in share.what}
    assert len(seeded) == 6 and len(rows) * 3 * 5 - 2 * 3 == sum(
        len(share.targets) for share in made if share.what in seeded
    )


def test_no_share_is_taken_before_what_it_needs_is_made() -> None:
    scenes = ("a", "b")
    targets = [
        f"{scene}/dvc.yaml:{name}"
        for scene in scenes
        for name in ("prepare", "fit@nerf-0", "restore@wen", "cleaned@wen-0")
    ]
    waiting = shares(targets)

    def taken(*running: Share) -> Share:
        share = run._next(waiting, running, 1)
        assert share is not None
        return share

    def of(scene: str, name: str) -> list[str]:
        return [f"{scene}/dvc.yaml:{name}"]

    first, second = taken(), taken()
    assert [first.targets, second.targets] == [of("a", "prepare"), of("b", "prepare")]
    assert run._next(waiting, [first, second], 1) is None
    third = taken(first)
    assert third.targets == of("b", "fit@nerf-0")
    assert taken(first, third).targets == of("b", "restore@wen")
    fourth = taken()
    assert fourth.targets == of("a", "fit@nerf-0")
    fifth = taken()
    assert fifth.targets == of("a", "restore@wen")
    assert taken(fifth).targets == of("b", "cleaned@wen-0")
    assert run._next(waiting, [fifth], 1) is None
    assert taken().targets == of("a", "cleaned@wen-0")


def test_the_last_shares_are_handed_out_in_halves() -> None:
    """Each smaller than the one before, and every target once."""
    names = [f"{scene}/dvc.yaml:fit@{row}-0" for scene in "abcdef" for row in range(8)]
    waiting, taken = shares(names), []
    while share := run._next(waiting, [], 2):
        taken.append(share.targets)
    assert [target for targets in taken for target in targets] == names
    assert [len(targets) for targets in taken[:2]] == [8, 8], "there are enough shares yet"
    assert [len(targets) for targets in taken[-4:]] == [4, 2, 1, 1]


def test_stages_run_in_a_copy_end_as_they_would_here(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The exit code is theirs; where nobody answers it is that of a failure."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(warm, "LOADED", ["pipeline.stage"])
    (tmp_path / "params.yaml").write_text("scenes: {a: {}}\nrefine: {rounds: many}\n")
    with warm.serving() as environment:
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        assert steps.main([]) == 0
        assert steps.main(["refine", "--scene", "a"]) == 2
        with Client(environment[steps.ADDRESS]):
            pass  # one that asks for nothing keeps nobody out
        with ThreadPoolExecutor(4) as several:
            assert set(several.map(steps.main, [[]] * 40)) == {0}
    assert (tmp_path / "artifacts").exists() is False
    assert steps.main([]) == 1


def test_after_a_change_of_the_code_stages_run_where_it_is_loaded_anew(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The copies are of what was loaded before: DVC would take their rows for the new code's."""
    monkeypatch.setattr(warm, "LOADED", ["pipeline.stage"])
    monkeypatch.setattr(steps, "run_stages", lambda words: 7)  # here; not in the copies
    for folder in ("pipeline", "stages"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a.py").write_text("before = 1\n")
    monkeypatch.setattr("pipeline.io.code.PIPELINE", tmp_path / "pipeline")
    with warm.serving() as environment:
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        assert steps.main([]) == 0
        for folder in ("pipeline", "stages"):
            file = tmp_path / folder / "a.py"
            file.write_text("after = 1\n")
            assert steps.main([]) == 7
            file.write_text("before = 1\n")
            assert steps.main([]) == 0


def test_a_mistake_in_the_parameters_is_told_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny/params.yaml").write_text("nerff: {steps: 60}\n")
    monkeypatch.setattr(run, "HERE", tmp_path)
    monkeypatch.setattr(run.signal, "signal", lambda number, how: None)
    monkeypatch.setattr(run.subprocess, "run", lambda *words, **how: pytest.fail("went on"))
    monkeypatch.setattr(sys, "argv", ["run", "tiny"])
    with pytest.raises(SystemExit) as end:
        run.main()
    assert end.value.code == 2
    told = "params.yaml: unknown section: nerff. Did you mean nerf?\n  Correct it and run again.\n"
    assert capsys.readouterr() == ("", told)


def test_copies_have_the_rows_stages_and_a_fits_machine_code() -> None:
    """Of a process of its own, as theirs is: what one step has not compiled, the next would."""
    code = (
        "import sys; from experiments.tables import loaded; "
        "from pipeline.field import adam, kernels, table_kernels as rows; "
        "from pipeline.geometry import rays; "
        "assert all(f'stages.{name}' in sys.modules for name in loaded.STAGES); "
        "fetched = (adam._stepped, kernels.walk, kernels.uniform, rows.read_rows, rows.add_rows, "
        "rays._fill_rays); "
        "assert all(one.signatures for one in fetched); "
        "before = [list(one.signatures) for one in fetched]; loaded._tiny(); "
        "assert before == [list(one.signatures) for one in fetched]"
    )
    subprocess.run([sys.executable, "-c", code], cwd=TABLES.parents[1], check=True)


def test_a_row_that_failed_is_told_by_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """DVC makes the tables of what there is: that they were made says nothing of the rows."""
    code = "import sys; sys.exit('a/dvc.yaml:fit@nerf-1' in sys.argv)"
    monkeypatch.setattr(run, "_dvc", lambda *words: [sys.executable, "-c", code, *words])
    monkeypatch.setattr(run, "cores", lambda: 2)
    monkeypatch.setattr(run.signal, "signal", lambda number, how: None)
    monkeypatch.setattr(run, "_environment", dict)
    monkeypatch.setattr(sys, "argv", ["run", "tiny"])

    def runs(targets: str) -> int:
        done = CompletedProcess([], 0, stdout=targets)
        monkeypatch.setattr(run.subprocess, "run", lambda *words, **how: done)
        return run.main()

    a = "a/dvc.yaml:"
    assert runs(f"{a}prepare {a}fit@nerf-0 {a}fit@true-0 table") == 0
    assert runs(f"{a}prepare {a}fit@nerf-0 {a}fit@nerf-1 table") == 1

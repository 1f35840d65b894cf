from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field
from ruamel.yaml import YAML

from pipeline.errors import UserError
from pipeline.io.paths import ScenePaths
from pipeline.params import (
    Section,
    read_folders,
    read_params,
    read_section,
    stage_names,
    with_scene,
)


class Masks(Section):
    threshold: Annotated[float, Field(ge=0, le=1)]
    temporal_mean: Literal["auto", "on", "off"]
    dilation: Annotated[int, Field(ge=0)]


GOOD = """
scenes:
  demo: {masks: {}}
  tree: {masks: {threshold: 0.2}}
variants:
  wide: {masks: {dilation: 9}}
masks: {threshold: 3e-1, temporal_mean: on, dilation: 2}
"""


COMPARED = (
    GOOD.replace("variants:", "variants:\n  far: {folders: {images: a/b, refine: c}}")
    + "comparisons:\n  demo-far: {scene: demo, variant: far}\n"
)


def _file(tmp_path: Path, text: str = GOOD) -> Path:
    path = tmp_path / "params.yaml"
    path.write_text(text)
    return path


def test_values_are_read_as_dvc_reads_them(tmp_path: Path) -> None:
    """YAML 1.2: `3e-1` is a number and `on` is a word."""
    params = read_section(_file(tmp_path), "masks", Masks, "demo")
    assert (params.threshold, params.temporal_mean) == (0.3, "on")


def test_a_scene_and_a_variant_have_values_of_their_own(tmp_path: Path) -> None:
    file = _file(tmp_path)
    assert read_section(file, "masks", Masks, "tree").threshold == 0.2
    both = read_section(file, "masks", Masks, "tree", "wide")
    assert (both.threshold, both.dilation) == (0.2, 9)


def test_every_problem_is_told_at_once_with_the_nearest_name(tmp_path: Path) -> None:
    text = GOOD.replace("3e-1", "1.5").replace("dilation: 2", "dilatoin: 2")
    with pytest.raises(UserError) as caught:
        read_section(_file(tmp_path, text), "masks", Masks, "demo")
    sentence = str(caught.value)
    assert "masks.threshold" in sentence
    assert "1.5" in sentence
    assert "masks.dilatoin is unknown (did you mean dilation?)" in sentence
    assert "masks.dilation is missing" in sentence


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("a: 1\nmasks: [", "not valid YAML, line"),
        ("- a\n- b", "the file should hold key: value"),
        ("", "the file should hold key: value"),
        ("scenes: [demo]\nmasks: {}", "scenes should hold key: value"),
        ("scenes: {demo: 3}\nmasks: {}", "scenes.demo should hold key: value"),
        (GOOD.replace("\nmasks:", "\nmaskz:"), "unknown section: maskz. Did you mean masks?"),
        (GOOD.replace("tree: {masks", "tree: {mask"), "unknown section in scenes.tree: mask"),
        (GOOD.replace("threshold: 3e-1", "threshold: .nan"), "masks.threshold"),
        ("scenes: {demo: {}}", "the section masks is missing"),
        ("scenes: {demo: {}}\nmasks: 3", "key: value"),
        ("masks: {threshold: 2026-99-99}", "not valid YAML: month must be"),
        (
            COMPARED,
            "demo-far: far finds its images, refine in folders that dvc.yaml does not follow",
        ),
        (
            COMPARED.replace("{images: a/b, refine: c}", "3"),
            "variants.far.folders should hold key: value",
        ),
        (
            COMPARED.replace("{scene: demo, variant: far}", "far"),
            "comparisons.demo-far should hold key",
        ),
        ("[" * 20_000, "not valid YAML"),
    ],
)
def test_faults_of_the_file_are_sentences(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(UserError, match=sentence.replace("?", r"\?")):
        read_section(_file(tmp_path, text), "masks", Masks, "demo")


def test_a_variant_with_folders_is_fine_where_nothing_compares_it(tmp_path: Path) -> None:
    text = COMPARED.replace("variant: far", "variant: wide")
    assert read_section(_file(tmp_path, text), "masks", Masks, "demo", "far").dilation == 2


def test_an_unknown_scene_names_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"scenes\.dem does not exist\. Did you mean demo\?"):
        read_section(_file(tmp_path), "masks", Masks, "dem")


def test_the_shipped_file_is_valid_and_complete() -> None:
    """Each stage's model accepts its section as shipped: every key there, none unknown."""
    import importlib

    file = Path(__file__).resolve().parents[1] / "params.yaml"
    scenes = read_params(file)["scenes"]
    for stage in stage_names():
        params_type = importlib.import_module(f"stages.{stage}").Params
        for scene in scenes:
            read_section(file, stage, params_type, scene)
        optional = [
            key for key, field in params_type.model_fields.items() if not field.is_required()
        ]
        assert not optional, (
            f"{stage}: params.yaml must hold {optional}, so the model gives no defaults"
        )


class Either(Section):
    threshold: Annotated[float, Field(ge=0, le=1)] | Literal["auto"]
    phases: list[Masks]


@pytest.mark.parametrize(
    ("section", "told"),
    [
        ("threshold: 1.5, phases: []", "less than or equal to 1 or 'auto' (got 1.5)."),
        ("threshold: high, phases: []", "as a number or 'auto' (got 'high')."),
        (
            "threshold: auto, phases: [{threshold: 0, temporal_mean: on, dilation: -1}]",
            "params.yaml: masks.phases.0.dilation: input should be greater than or equal to 0 (got -1).",
        ),
    ],
)
def test_a_value_of_several_kinds_is_told_as_one_problem_in_the_files_terms(
    tmp_path: Path, section: str, told: str
) -> None:
    text = f"scenes: {{demo: {{}}}}\nmasks: {{{section}}}\n"
    with pytest.raises(UserError) as caught:
        read_section(_file(tmp_path, text), "masks", Either, "demo")
    assert caught.value.what.endswith(told)
    assert caught.value.what.count("masks.") == 1


def test_a_scene_is_added_and_nothing_else_changes(tmp_path: Path) -> None:
    text = (
        "scene_defaults: &scene {masks: {}}  # all\nscenes:  # yours\n  demo: {<<: *scene}\n"
        "  # a remark\nmasks: {threshold: 0.3}\n"
    )
    file = _file(tmp_path, text)
    added = with_scene(file, "garden")
    assert added == text.replace("  # a remark", "  garden: {<<: *scene}\n  # a remark")
    assert with_scene(file, "demo") is None
    file.write_text("scene_defaults: &scene {masks: {}}\nscenes:\n  demo: {}")
    assert with_scene(file, "b") == file.read_text() + "\n  b: {<<: *scene}\n"


@pytest.mark.parametrize("name", ["garden.2", "v1.5"])
def test_names_that_dvc_would_take_apart_are_refused(tmp_path: Path, name: str) -> None:
    """`scenes.v1.5.ingest` is the parameter `ingest` of 5 of v1 to it, which params.yaml does not have."""
    for scene, variant in ((name, None), ("demo", name)):
        with pytest.raises(UserError, match=f"'{name}' cannot name a scene or a variant"):
            ScenePaths(tmp_path, scene, variant)


@pytest.mark.parametrize("name", ["2024", "2024-05-01", "2024-13-01", "007", "1e3", "null"])
def test_a_scene_may_have_a_number_or_a_date_for_a_name(tmp_path: Path, name: str) -> None:
    """YAML would make 7 of 007; DVC and `--scene 007` look for text."""
    file = _file(tmp_path, "scene_defaults: &scene {masks: {}}\nscenes:\n  demo: {<<: *scene}\n")
    file.write_text(with_scene(file, name) or "")
    assert list(YAML(typ="safe").load(file.read_text())["scenes"]) == ["demo", name]
    assert with_scene(file, name) is None
    file.write_text(file.read_text() + "  2025: {<<: *scene}\n")  # as written by hand
    assert (with_scene(file, "garden") or "").endswith("\n  garden: {<<: *scene}\n")


@pytest.mark.parametrize(
    "text",
    ["scenes: {demo: {}}\nmasks: {}\n", "scenes:\n  demo: {}\nmasks: {}\n", "masks: {}\n"],
)
def test_a_scene_that_cannot_be_added_is_told_with_the_line_to_write(
    tmp_path: Path, text: str
) -> None:
    """A flow mapping, no anchor, no scenes."""
    with pytest.raises(UserError, match=r"garden: \{<<: \*scene\}"):
        with_scene(_file(tmp_path, text), "garden")


def test_a_file_may_build_on_another(tmp_path: Path) -> None:
    """Key by key within a section; scenes and variants are added to those of the base."""
    _file(tmp_path)
    above = tmp_path / "sub" / "params.yaml"
    above.parent.mkdir()
    above.write_text("base: ../params.yaml\nscenes: {pier: {}}\nmasks: {dilation: 7}\n")
    for scene in ("pier", "demo"):
        params = read_section(above, "masks", Masks, scene)
        assert (params.threshold, params.dilation) == (0.3, 7)
    above.write_text("base: nowhere.yaml\n")
    with pytest.raises(UserError, match=r"nowhere\.yaml cannot be read"):
        read_params(above)
    above.write_text("base: params.yaml\n")
    with pytest.raises(UserError, match="builds on itself"):
        read_params(above)


def test_a_base_with_a_list_for_a_section_is_told(tmp_path: Path) -> None:
    (tmp_path / "base.yaml").write_text("masks: [1, 2]\n")
    above = _file(tmp_path, "base: base.yaml\nmasks: {dilation: 1}\n")
    with pytest.raises(UserError, match="masks should hold key: value pairs"):
        read_params(above)


def test_a_variant_may_find_folders_elsewhere(tmp_path: Path) -> None:
    text = GOOD.replace("wide: {", "wide: {folders: {images: other/photos}, ")
    file = _file(tmp_path, text)
    assert read_folders(file, "wide") == {"images": "other/photos"}
    assert read_folders(file, None) == {}
    paths = ScenePaths(tmp_path, "demo", "wide", read_folders(file, "wide"))
    assert paths.images == tmp_path / "artifacts/demo/other/photos"
    assert paths.masks == tmp_path / "artifacts/demo/masks"
    for folders in ({"images": "../../elsewhere"}, {"nerf": "a"}, {"masks": "/etc"}):
        with pytest.raises(UserError, match="cannot find its"):
            ScenePaths(tmp_path, "demo", "wide", folders)


def test_scratch_of_scenes_and_variants_never_meets(tmp_path: Path) -> None:
    """A scene `a-b` and the variant `b` of `a` worked in one folder."""
    both = ScenePaths(tmp_path, "a-b").work("nerf"), ScenePaths(tmp_path, "a", "b").work("nerf")
    assert both[0] != both[1]
    assert ScenePaths(tmp_path, "a", "nerf-2").work("nerf") != ScenePaths(tmp_path, "a").work(
        "nerf"
    )


@pytest.mark.parametrize("name", ["masks", "images", "views", "report"])
def test_a_variant_does_not_take_the_name_of_its_scenes_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(UserError, match=f"artifacts/demo/{name} is the scene's own"):
        ScenePaths(tmp_path, "demo", name)

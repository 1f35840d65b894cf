"""One stage's parameters out of params.yaml, checked, with every problem told at once."""

from __future__ import annotations

import copy
import difflib
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import pydantic
from ruamel.yaml import YAML, YAMLError

from pipeline.errors import UserError

STAGES = Path(__file__).resolve().parents[1] / "stages"
CORRECT = "Correct it and run again."
OTHER_SECTIONS = ("scene_defaults", "scenes", "variants", "comparisons", "comparison")
NAMED = ("scenes", "variants")
BASE = "base"  # another file of parameters, which this one changes
FOLDERS = "folders"  # of a variant: where it finds its photos, masks, ...


class Section(pydantic.BaseModel):
    """The parameters of one stage. Fields carry their ranges and no defaults: params.yaml holds all."""

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


S = TypeVar("S", bound=Section)


def read_section(
    file: Path, name: str, section_type: type[S], scene: str | None, variant: str | None = None
) -> S:
    """The validated section `name` of params.yaml for `scene` (and `variant`).

    The scene's own values under `scenes.<scene>.<name>` replace the section's, and the variant's under
    `variants.<variant>.<name>` replace both. `scene` None: as for one without values of its own.
    UserError lists every unknown, missing or out-of-range key.
    """
    content = read_params(file)
    merged: dict[str, Any] = {}
    for where, values in _layers(file, content, name, scene, variant):
        merged |= _mapping(file, where, values)
    try:
        return section_type.model_validate(merged)
    except pydantic.ValidationError as error:
        problems = _sentences(name, error.errors(), merged, section_type)
        raise UserError(f"{file.name}: " + "; ".join(problems) + ".", CORRECT) from None


def read_params(file: Path, above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """params.yaml as DVC reads it (YAML 1.2); UserError when missing, malformed or with unknown sections.

    `above` are the files that build on this one.
    """
    if file.resolve() in above:
        raise UserError(f"{file} builds on itself ({BASE}: {above[-1]} names it).", CORRECT)
    try:
        content = copy.deepcopy(_parsed(file.read_text(encoding="utf-8")))
    except OSError as error:
        raise UserError(f"{file} cannot be read ({error.strerror}).", "Check the file.") from None
    except (YAMLError, ValueError, RecursionError) as error:  # no text, no such date, too deep
        raise UserError(f"{file} is not valid YAML{_place(error)}.", CORRECT) from None
    content = _mapping(file, "the file", content)
    stages = stage_names()
    known = (*stages, *OTHER_SECTIONS, BASE)
    _refuse_unknown(file, "section", content, known)
    if BASE in content:
        below = read_params(file.parent / str(content[BASE]), (*above, file.resolve()))
        content = _upon(file, below, content)
    for kind in NAMED:
        _mapping(file, kind, content.get(kind) or {})
    content = _by_names(content)
    for kind in NAMED:
        for name, values in (content.get(kind) or {}).items():
            overrides = _mapping(file, f"{kind}.{name}", values or {})
            allowed = [*stages, *([FOLDERS] if kind == "variants" else [])]
            _refuse_unknown(file, f"section in {kind}.{name}", overrides, allowed)
    _refuse_unfollowed(file, content)
    return content


@lru_cache(maxsize=8)
def _parsed(text: str) -> Any:
    """What a file says. Stages that run in one process ask for the same few files again and again."""
    return YAML(typ="safe").load(text)


def _refuse_unfollowed(file: Path, content: Mapping[str, Any]) -> None:
    """UserError for a comparison of a variant with `folders`: dvc.yaml follows its scene's, not these."""
    pairs = _mapping(file, "comparisons", content.get("comparisons") or {})
    for name, pair in pairs.items():
        variant = str(_mapping(file, f"comparisons.{name}", pair).get("variant"))
        elsewhere = ((content.get("variants") or {}).get(variant) or {}).get(FOLDERS)
        if elsewhere:
            which = ", ".join(_mapping(file, f"variants.{variant}.{FOLDERS}", elsewhere))
            raise UserError(
                f"{file.name}: comparisons.{name}: {variant} finds its {which} in folders that dvc.yaml "
                "does not follow.",
                "Leave it out of comparisons: and run its stages with --variant.",
            )


def _upon(file: Path, below: dict[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters of one file upon those of its base: key by key within a section."""
    merged = dict(below)
    for section, values in above.items():
        if section != BASE:
            own = _mapping(file, section, values or {})
            merged[section] = {**_mapping(file, section, below.get(section) or {}), **own}
    return merged


def read_folders(file: Path, variant: str | None) -> dict[str, str]:
    """The folders that a variant finds elsewhere, by the name that they have without it.

    Given under `variants.<variant>.folders`, relative to the scene's artifacts. Empty without a variant.
    """
    if variant is None:
        return {}
    chosen = _chosen(file, read_params(file), "variants", variant).get(FOLDERS) or {}
    where = f"variants.{variant}.{FOLDERS}"
    return {str(name): str(place) for name, place in _mapping(file, where, chosen).items()}


def _place(error: Exception) -> str:
    """Where in the file, and what is wrong there, as far as the parser knows."""
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    if mark is not None and problem:
        return f", line {mark.line + 1}: {problem}"
    return f": {str(error).splitlines()[0]}"


def _mapping(file: Path, where: str, values: Any) -> dict[str, Any]:
    if not isinstance(values, Mapping):
        raise UserError(f"{file.name}: {where} should hold key: value pairs.", CORRECT)
    return dict(values)


def with_scene(file: Path, scene: str) -> str | None:
    """The text of params.yaml with `scene` added under `scenes`, all else as it is; None if it is there.

    UserError when the file cannot be edited line by line, with the line to add by hand.
    """
    content = read_params(file)
    if scene in (content.get("scenes") or {}):
        return None
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    entry = f"  {_as_key(scene)}: {{<<: *scene}}\n"
    start = next((i for i, line in enumerate(lines) if line.split("#")[0].strip() == "scenes:"), -1)
    if start >= 0:
        end = start + 1
        for index in range(start + 1, len(lines)):
            if lines[index].strip() and not lines[index].startswith((" ", "#")):
                break
            if lines[index].startswith(" ") and not lines[index].lstrip().startswith("#"):
                end = index + 1
        before = "".join(lines[:end])
        text = before + ("" if before.endswith("\n") else "\n") + entry + "".join(lines[end:])
        try:
            edited = _by_names(YAML(typ="safe").load(text))
            anchored = edited["scenes"].pop(scene)
        except (YAMLError, ValueError, AttributeError, TypeError, KeyError):
            edited, anchored = {}, None
        if edited == {**content, "scenes": content.get("scenes") or {}} and anchored is not None:
            return text
    raise UserError(
        f"{file}: the scene {scene} could not be added.",
        f"Write it under scenes: by hand, as `{entry.strip()}`.",
    )


def _as_key(name: str) -> str:
    """`name` as a key of YAML: quoted where it would be a number, a date (2024-05-01) or nothing."""
    try:
        plain = YAML(typ="safe").load(name) == name
    except ValueError:  # the thirteenth month
        plain = False
    return name if plain else f'"{name}"'


def _by_names(content: Mapping[str, Any]) -> dict[str, Any]:
    """The content of a file with the names of its scenes and variants as text: YAML makes 7 of 007."""
    named = {kind: content[kind] for kind in NAMED if content.get(kind)}
    return {
        **content,
        **{kind: {str(name): v for name, v in choices.items()} for kind, choices in named.items()},
    }


def stage_names() -> list[str]:
    """The names of all stages, which are the names of their sections."""
    return sorted(path.stem for path in STAGES.glob("*.py") if path.stem != "__init__")


def _layers(
    file: Path, content: Mapping[str, Any], name: str, scene: str | None, variant: str | None
) -> Iterable[tuple[str, Any]]:
    if name not in content:
        raise UserError(f"{file.name}: the section {name} is missing.", CORRECT)
    yield name, content[name] or {}
    if scene is not None:
        yield f"scenes.{scene}.{name}", _chosen(file, content, "scenes", scene).get(name) or {}
    if variant is not None:
        yield (
            f"variants.{variant}.{name}",
            _chosen(file, content, "variants", variant).get(name) or {},
        )


def _chosen(file: Path, content: Mapping[str, Any], kind: str, name: str) -> Mapping[str, Any]:
    choices = content.get(kind) or {}
    if name not in choices:
        raise UserError(
            f"{file.name}: {kind}.{name} does not exist.{_nearest(name, choices)}",
            f"Add it under {kind}: in {file}.",
        )
    return choices[name] or {}


def _refuse_unknown(file: Path, what: str, given: Mapping[str, Any], known: Iterable[str]) -> None:
    known = list(known)
    for name in given:
        if name not in known:
            raise UserError(
                f"{file.name}: unknown {what}: {name}.{_nearest(str(name), known)}", CORRECT
            )


def _nearest(name: str, choices: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, [str(choice) for choice in choices], n=1, cutoff=0.5)
    return f" Did you mean {close[0]}?" if close else ""


def _sentences(
    section: str, problems: Iterable[Any], values: Mapping[str, Any], section_type: type[Section]
) -> list[str]:
    """One sentence for every key that has problems, without its full stop."""
    by_key: dict[str, list[Any]] = {}
    for problem in problems:
        by_key.setdefault(_key(problem["loc"], values), []).append(problem)
    return [
        _sentence(f"{section}.{key}" if key else section, key, of_key, section_type)
        for key, of_key in by_key.items()
    ]


def _key(place: Iterable[int | str], values: Any) -> str:
    """The key as it stands in the file: a value of several allowed kinds is told once per kind."""
    parts = []
    for part in place:
        if not isinstance(values, Mapping | list):
            break
        parts.append(str(part))
        try:
            values = values[part]  # type: ignore[index]
        except (KeyError, IndexError, TypeError):
            break
    return ".".join(parts)


def _sentence(where: str, key: str, problems: list[Any], section_type: type[Section]) -> str:
    kinds = {problem["type"] for problem in problems}
    if "extra_forbidden" in kinds:
        near = _nearest(key, section_type.model_fields).strip().rstrip("?")
        return f"{where} is unknown" + (f" ({near[0].lower()}{near[1:]}?)" if near else "")
    if "missing" in kinds:
        return f"{where} is missing"
    wishes = [problem["msg"].removeprefix("Value error, ") for problem in problems]
    first, *others = [f"{wish[0].lower()}{wish[1:]}" for wish in wishes]
    either = "".join(f" or {wish.removeprefix('input should be ')}" for wish in others)
    return f"{where}: {first}{either} (got {problems[0]['input']!r})"

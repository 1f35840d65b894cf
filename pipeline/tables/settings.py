"""Whether the runs of a comparison were made alike, by what DVC wrote down of each."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML, YAMLError

from pipeline.errors import UserError
from pipeline.tables.layout import Table
from pipeline.tables.rows import ROWS, Row

Run = tuple[str, str, int]  # scene, row's key, seed
LOCK, CODE = "dvc.lock", ".code/"
PAUSE, PATIENCE = 0.5, 60  # seconds between two looks at the lock file, and how many looks


def noted(tables: Iterable[Table], root: Path, runs: Mapping[Run, Path]) -> list[Table]:
    """The tables, those of `runs` in `root` with a sentence under them where not all were made alike.

    So it is while a comparison is made anew after a change: in the end DVC has made all alike, and
    nothing is said. Lock files are those of the folders in `root`, one per scene.
    """
    recorded = read_recorded(sorted(root.glob(f"*/{LOCK}")))
    rows = {row.key: row for row in ROWS if not row.name}
    known = {
        key: _without_seed(recorded[place], rows[key[1]], key[2])
        for key, path in runs.items()
        if key[1] in rows and (place := path.relative_to(root).as_posix()) in recorded
    }
    told = tuple(unlike(known))
    return [t if t.name in ("paper", "poses") else replace(t, notes=t.notes + told) for t in tables]


def read_recorded(locks: Sequence[Path]) -> dict[str, dict[str, Any]]:
    """By the path of each output what DVC's lock files say that it was made from: parameters by
    "section of file", checksums of code and data by path. UserError for a damaged file."""
    recorded: dict[str, dict[str, Any]] = {}
    for lock, text in zip(locks, _settled(locks), strict=True):
        try:
            for entry in YAML(typ="safe").load(text)["stages"].values():
                recorded |= {out["path"]: _made_from(entry) for out in entry.get("outs", ())}
        except (ValueError, KeyError, TypeError, AttributeError, YAMLError) as error:
            raise _damaged(lock, error) from None
    return recorded


def _damaged(lock: Path, error: Exception) -> UserError:
    return UserError(
        f"{lock} is not a lock file of DVC ({type(error).__name__}).",
        "Restore it, or remove it: DVC then makes its scene anew.",
    )


def _read(lock: Path) -> bytes:
    try:
        return lock.read_bytes()
    except OSError as error:
        raise _damaged(lock, error) from None


def _settled(locks: Sequence[Path]) -> list[bytes]:
    """The contents of the lock files once nobody writes them: DVC does so in place, for part of a second, and
    other rows may be made while the tables are. After PATIENCE looks as they are."""
    now = [_read(lock) for lock in locks]
    for _ in range(PATIENCE if locks else 0):
        time.sleep(PAUSE)
        before, now = now, [_read(lock) for lock in locks]
        if all(now) and now == before:
            break
    return now


def _made_from(entry: Mapping[str, Any]) -> dict[str, Any]:
    made = {dep["path"].removeprefix(CODE): dep.get("md5") for dep in entry.get("deps", ())}
    for file, sections in entry.get("params", {}).items():
        made |= {f"{name} of {file}": value for name, value in sections.items()}
    return made


def _without_seed(made: Mapping[str, Any], row: Row, seed: int) -> dict[str, str]:
    """The record as texts by what they are of; of the row's variant all but its seed."""
    variant = f"{row.key}-{seed}" if row.seeded else row.key

    def bare(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: bare(some) for key, some in value.items() if key != "seed"}
        return value.replace(variant, row.key) if isinstance(value, str) else value

    texts = {}
    for what, value in made.items():
        if what.startswith(f"variants.{variant} of "):
            what, value = what.replace(variant, row.key, 1), bare(value)
        texts[what] = json.dumps(value, sort_keys=True, default=str)
    return texts


def unlike(known: Mapping[Run, Mapping[str, str]]) -> list[str]:
    """What runs were made from that others were not, as sentences; none when all were made alike.

    known: by scene, row's key and seed, texts by what they are of. The larger part is "the rest".
    """
    differing: dict[tuple[Run, ...], list[str]] = {}
    for what in sorted({what for made in known.values() for what in made}):
        groups: dict[str, list[Run]] = {}
        for run, made in known.items():
            if what in made:
                groups.setdefault(made[what], []).append(run)
        usual = max(groups.values(), key=len)
        odd = tuple(run for run in known if what in known[run] and run not in usual)
        if odd:
            differing.setdefault(odd, []).append(what)
    return [
        f"Not made alike: {_named(odd, known)} had another {', '.join(what)} than the rest."
        for odd, what in differing.items()
    ]


def _named(odd: Collection[Run], known: Collection[Run]) -> str:
    """The runs by row, "NeRF (seed 0)", with their scenes where others have runs of that row and seed."""
    said = []
    for row in ROWS:
        seeds: dict[str, list[str]] = {}  # by the scenes that share them
        for seed in sorted({run[2] for run in odd if run[1] == row.key and not row.name}):
            scenes, others = (
                [scene for scene, *rest in runs if rest == [row.key, seed]] for runs in (odd, known)
            )
            seeds.setdefault("" if scenes == others else ", ".join(scenes), []).append(str(seed))
        for where, some in seeds.items():
            words = [where, f"seed {', '.join(some)}" if row.seeded else ""]
            told = "; ".join(filter(None, words))
            said.append(f"{row.label} ({told})" if told else row.label)
    return "; ".join(said)

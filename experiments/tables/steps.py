"""Several stages of one scene in one process, so that their libraries are loaded once.

    python -m experiments.tables.steps nerf render evaluate --scene street --variant nerf-0

runs them one after the other, each as `python -m stages.NAME` would, and stops at the first that fails.
"""

from __future__ import annotations

import importlib
import sys

from pipeline.stage import run


def main(words: list[str]) -> int:
    """Runs the stages named before the first flag; the exit code of the last one that ran."""
    first = next((i for i, word in enumerate(words) if word.startswith("-")), len(words))
    for name in words[:first]:
        stage = importlib.import_module(f"stages.{name}")
        sys.argv = [f"stages.{name}", *words[first:]]
        try:
            run(name, stage.Params, stage.main)
        except SystemExit as end:
            if end.code:
                return int(end.code)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

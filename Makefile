# Two commands: `make demo` and `make test`. The rest is for those who work on the project.
VENV ?= .venv
SCENE ?= demo
BIN := $(VENV)/bin
export PATH := $(abspath $(BIN)):$(PATH)

.PHONY: demo test check format setup scene tables clean

demo: setup
	dvc repro report@demo
	@python -m pipeline.evaluation.table artifacts/demo/metrics.json artifacts/demo/unmasked/metrics.json
	@echo "Open $(abspath artifacts/demo/report/index.html)"

test: setup
	python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile

check: setup
	ruff check .
	ruff format --check .
	mypy
	lint-imports

format: setup
	ruff check --fix .
	ruff format .

# make scene SCENE=garden FROM=~/photos: a folder of photos, or a video, brought in and everything made of it;
# without FROM: everything for one scene of params.yaml
scene: setup
	$(if $(FROM),python -m stages.ingest --scene $(SCENE) --from "$(FROM)")
	dvc repro report@$(SCENE)
	@python -m pipeline.evaluation.table artifacts/$(SCENE)/metrics.json
	@echo "Cleaned photos: $(abspath artifacts/$(SCENE)/views/composite)"
	@echo "The page, with what they are worth: open $(abspath artifacts/$(SCENE)/report/index.html)"

# make tables PROFILE=quick: every method on every scene, see experiments/tables/README.md
tables: setup
	python -m experiments.tables.run $(or $(PROFILE),quick)

setup: $(VENV)/.ready
	@if [ ! -e .git ]; then for of in . experiments/scenes experiments/tables/*/; do \
	    (cd $$of && dvc config --local core.no_scm true); done; fi

$(VENV)/.ready: pyproject.toml constraints.txt
	python3 -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed")'
	@echo "Installing the packages into $(VENV), once: some minutes, most of them for torch."
	python3 -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]' -c constraints.txt
	@touch $@

# make clean SCENE=garden: what was made of one scene; DVC's cache and the scene's photos stay
clean:
	rm -rf artifacts/$(SCENE) artifacts/.work/$(SCENE)

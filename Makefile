# `make bench` and `make test` work on a fresh machine with git, make and Python 3.11 to 3.14: nothing else is needed.
PYTHON ?= python3
# Another Python has its own environment: `make test PYTHON=python3.13` installs into .venv-3.13.
ifndef VENV
VENV := .venv$(if $(filter-out python3,$(PYTHON)),-$(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'))
endif
BIN := $(VENV)/bin
# Wheels only: nothing is compiled, and a package without a wheel is an error at once.
INSTALL := $(BIN)/pip install --quiet --only-binary :all: --constraint constraints.txt

.DEFAULT_GOAL := help
.PHONY: help bench test faults kills setup weights lint types docs pre-commit clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-12s%s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "Another Python: make test PYTHON=python3.13"

bench: setup  ## make the built-in animals, fit and score them: under 10 minutes on two cores
	$(BIN)/rewild4d-bench run --method ours --dataset artemis

test: setup  ## run the tests, one process a core
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist loadfile --no-loadscope-reorder

faults: setup  ## try every reader on 2,000 damaged files
	REWILD4D_MUTATIONS=2000 $(BIN)/python -m pytest -s tests/faults

MOMENTS ?= 20
kills: setup  ## kill a run at 20 random moments of every stage, start it again, compare with an undisturbed one
	$(BIN)/python tests/helpers/kill_drill.py --moments $(MOMENTS)

setup: $(VENV)/.ready  ## install into .venv

$(VENV)/.ready: constraints.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "rewild4d needs Python 3.11 or newer")'
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --editable '.[dev]'
	touch $@

# What is there already is not fetched again.
weights: setup  ## fetch the networks behind LPIPS, KID and FVD
	$(BIN)/rewild4d-bench weights fetch

lint: setup  ## check style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# The top folders install as subpackages, so the type checker reads a built copy.
types: setup  ## check types
	rm -rf build
	$(BIN)/pip install --quiet --no-deps --target build/types .
	$(BIN)/mypy

docs: $(VENV)/.docs  ## build the documentation site into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

$(VENV)/.docs: $(VENV)/.ready
	$(INSTALL) --editable '.[docs]'
	touch $@

pre-commit: setup  ## run what a commit is checked with, on all files
	PATH="$(abspath $(BIN)):$$PATH" pre-commit run --all-files

clean:  ## remove environments and everything built
	rm -rf .venv .venv-* $(VENV) build dist site *.egg-info

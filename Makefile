# `make bench` and `make test` work on a fresh machine with git, make and Python 3.11: nothing else is needed.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: bench test setup weights lint types clean

bench: setup
	$(BIN)/rewild4d-bench run --method ours --dataset artemis

test: setup
	$(BIN)/python -m pytest

setup: $(VENV)/.ready

$(VENV)/.ready: constraints.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

# The networks behind LPIPS, KID and FVD. What is there already is not fetched again.
weights: setup
	$(BIN)/rewild4d-bench weights fetch

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# The top folders install as subpackages, so the type checker reads a built copy.
types: setup
	rm -rf build
	$(BIN)/pip install --quiet --no-deps --target build/types .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) build dist *.egg-info

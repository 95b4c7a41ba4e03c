# Every target sets up what it needs: a virtual environment in .venv, from Python 3.11 or newer and the package index.

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
WORKERS ?= 2

# The first interpreter that runs and is new enough; `make PYTHON=/path/to/python` overrides.
PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3 python; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo "$$p"; break; }; done)

.PHONY: help install demo test lint docs format clean
.DEFAULT_GOAL := help

help:
	@echo "make install   virtual environment in $(VENV) with all extras and the tools for development"
	@echo "make demo      simulate, calibrate, reconstruct and compare with the truth; needs no camera and no file"
	@echo "make test      lint, types, import contracts and all tests"
	@echo "make lint      lint, types and import contracts alone"
	@echo "make docs      the documentation as a web site in site/"
	@echo "make format    format the code"
	@echo "make clean     remove what the other targets made"

install: $(INSTALLED)

$(INSTALLED): pyproject.toml
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11 or newer found; install one or run make PYTHON=/path/to/python"; exit 1; }
	@$(BIN)/python -c '' 2>/dev/null || $(PYTHON) -m venv --clear $(VENV) \
		|| { echo "error: $(PYTHON) cannot make a virtual environment; install its venv module (python3-venv)"; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable ".[all]" --group dev
	$(BIN)/tubesight warmup
	@touch $@

demo: $(INSTALLED)
	$(BIN)/tubesight demo -o demo-out

lint: $(INSTALLED)
	$(BIN)/ruff check src tests examples
	$(BIN)/ruff format --check src tests examples
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint
	$(BIN)/pytest -n $(WORKERS)

docs: $(INSTALLED)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

format: $(INSTALLED)
	$(BIN)/ruff check --fix src tests examples
	$(BIN)/ruff format src tests examples

clean:
	rm -rf $(VENV) site demo-out .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

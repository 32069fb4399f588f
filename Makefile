# Everything runs in .venv, which is made on the first call and updated when pyproject.toml changes.
#
#   PYTHON=python3.12   the Python that .venv is made with, 3.11 to 3.13
#   EXTRAS=test,cuda    what is installed into it, for a machine with an NVIDIA GPU

PYTHON ?= python3
EXTRAS ?= test
BIN := .venv/bin
INSTALLED := .venv/.installed-$(EXTRAS)

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow lint bench clean .venv

help:  ## this list
	@awk -F ':.*## ' '/^[a-z.-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(INSTALLED)  ## train a small policy, show its figures, draw its pictures
	$(BIN)/python -m train reach --preset quick

test: $(INSTALLED)  ## the tests
	$(BIN)/python -m pytest

test-slow: $(INSTALLED)  ## the tests that take minutes
	$(BIN)/python -m pytest -m slow

lint: $(INSTALLED) .venv/.installed-dev  ## ruff and pyright on the whole tree
	$(BIN)/pre-commit run --all-files --show-diff-on-failure

bench: $(INSTALLED)  ## the benchmarks
	$(BIN)/python -m benchmarks

clean:  ## remove .venv, build outputs and caches; runs/ stays
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +

.venv: $(INSTALLED)  ## the environment alone

.venv/.installed-%: pyproject.toml | $(BIN)/python
	@echo "installing mjx-softarm[$*] into .venv; the first time this takes some minutes ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@touch '$@'

$(BIN)/python:
	@command -v '$(PYTHON)' > /dev/null || { \
	  echo "error: $(PYTHON): not found; name a Python from 3.11 to 3.13, e.g. make PYTHON=python3.12 ..." >&2; \
	  exit 1; }
	@'$(PYTHON)' -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || { \
	  echo "error: $(PYTHON) is $$('$(PYTHON)' --version 2>&1), expected Python 3.11 to 3.13;" \
	    "name another, e.g. make PYTHON=python3.12 ..." >&2; \
	  exit 1; }
	@'$(PYTHON)' -m venv --clear .venv || { rm -rf .venv; exit 1; }

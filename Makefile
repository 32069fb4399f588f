# Everything runs in .venv, which is made on the first call and updated when pyproject.toml changes.
#
#   PYTHON=python3.12   the Python that .venv is made with, 3.11 to 3.13
#   EXTRAS=test,cuda    what is installed into it, for a machine with an NVIDIA GPU

PYTHON ?= python3
EXTRAS ?= test
BIN := .venv/bin
INSTALLED := .venv/.installed-$(EXTRAS)

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow lint docs clean .venv

help:  ## this list
	@awk -F ':.*## ' '/^[a-z.-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(INSTALLED)  ## train a small policy, show its figures, draw its pictures, play it on a simulated arm
	$(BIN)/python -m train reach --preset quick
	@run=$$(ls -dt runs/reach-quick-seed0* | head -1); $(BIN)/python -m train export "$$run" && \
	{ $(BIN)/python -m mjx_softarm.deploy measure "$$run/policy.npz" --arm twin:0:exact --points 40 --seconds 20 \
	  --out "$$run/twin" || [ $$? -eq 1 ]; } && \
	$(BIN)/python -m mjx_softarm.view "$$run/twin/log.npz" --html "$$run/twin.html" && \
	echo "next: open $$run/twin.html in a browser; put your own arm to work by docs/your-arm.md"

# A file's tests share compiled functions, so they stay in one process.
test: $(INSTALLED)  ## the tests, on up to four cores
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

test-slow: $(INSTALLED)  ## the tests that take minutes
	$(BIN)/python -m pytest -m slow

lint: $(INSTALLED) .venv/.installed-dev  ## ruff, which corrects what it can, and pyright, on all files that git knows
	$(BIN)/pre-commit run --all-files

docs: .venv/.installed-docs  ## the site, links checked, into build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

clean:  ## remove virtual environments, build outputs and caches; runs/ stays
	rm -rf .venv .venv-* build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './.git/*' -prune -exec rm -rf {} +

.venv: $(INSTALLED)  ## the environment alone

.venv/.installed-%: pyproject.toml | $(BIN)/python
	@echo "installing mjx-softarm[$*] into .venv; the first time this takes some minutes ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[$*]'
	@touch '$@'

$(BIN)/python:
	@found=$$('$(PYTHON)' -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2> /dev/null); \
	case "$$found" in \
	  3.11 | 3.12 | 3.13) ;; \
	  '') echo "error: no Python runs as '$(PYTHON)'; name one, e.g. make PYTHON=python3.12 ..." >&2; exit 1;; \
	  *) echo "error: '$(PYTHON)' is Python $$found, expected 3.11 to 3.13; name another," \
	       "e.g. make PYTHON=python3.12 ..." >&2; exit 1;; \
	esac
	@'$(PYTHON)' -m venv --clear .venv || { rm -rf .venv; exit 1; }

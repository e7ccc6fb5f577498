# Everything works from a fresh clone: Python 3.11 to 3.14, git and make are all that is needed.
.PHONY: help run test bench campaign studies receivers lint format clean
.DEFAULT_GOAL := help

VENV := .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed

help:
	@echo "make run       fly the velocity jump with three filters; figure and results in results/"
	@echo "make test      lint, types, layers and all tests"
	@echo "make bench     speed beside targets, limits, plain code and peers (a few minutes)"
	@echo "make campaign  the tests with many seeds (some twenty minutes)"
	@echo "make studies   every study; ledger, page and figures in studies/ (some three hours)"
	@echo "make receivers gnss-sdr and RTKLIB, where installed, navigate with our files (minutes)"
	@echo "make lint      lint, types and layers only"
	@echo "make format    format the sources"
	@echo "make clean     remove the virtual environment, caches and builds"

# A Python asked for by name that is not the one in $(VENV): set up again.
ifdef PYTHON
ifneq ($(shell "$(PYTHON)" --version 2>&1),$(shell $(PY) --version 2>&1))
.PHONY: $(STAMP)
endif
endif

# The stamp is older than pyproject.toml when the dependencies may have changed.
$(STAMP): pyproject.toml
	@python=; \
	for name in $(or $(PYTHON),python3.13 python3.12 python3.11 python3.14 python3 python); do \
	  if "$$name" -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))' \
	    >/dev/null 2>&1; then python=$$name; break; fi; \
	done; \
	if [ -z "$$python" ]; then \
	  found=$$($(or $(PYTHON),python3) --version 2>/dev/null || echo "no $(or $(PYTHON),python3)"); \
	  echo "error: $$found found, expected Python 3.11 to 3.14 with venv (numba supports no other); name one with: make PYTHON=/path/to/python" >&2; \
	  exit 2; \
	fi; \
	echo "setting up $(VENV) with $$("$$python" --version), once"; \
	if [ -n "$(PYTHON)" ] && [ "$$("$$python" --version)" != "$$($(PY) --version 2>&1)" ] \
	  || ! $(PY) -m pip --version >/dev/null 2>&1; then "$$python" -m venv --clear $(VENV); fi
	@echo "installing (a minute or two)"
	@$(PY) -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@

run: $(STAMP)
	@$(PY) -m ultratight showcase --out results

lint: $(STAMP)
	@$(PY) -m ruff check .
	@$(PY) -m ruff format --check .
	@$(PY) -m mypy
	@$(VENV)/bin/lint-imports

# pytest's closing line is the last one.
test: lint
	@NUMBA_DISABLE_JIT=1 $(PY) -m pytest -m nojit
	@$(PY) -m pytest -m "not campaign and not receiver"

bench: $(STAMP)
	@$(PY) -m benchmarks --json results/bench.json

campaign: $(STAMP)
	@$(PY) -m pytest -m campaign

studies: $(STAMP)
	@$(PY) -m ultratight study --all --record

receivers: $(STAMP)
	@$(PY) -m pytest -m receiver -rs

format: $(STAMP)
	@$(PY) -m ruff format .
	@$(PY) -m ruff check --fix .

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis build dist

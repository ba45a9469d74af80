# Every target works from a bare clone: it makes .venv, installs the pinned versions, then runs.
#   make sim ARGS="--law paper --seed 3"

SHELL := /bin/sh
.DEFAULT_GOAL := help
.PHONY: help sim test check bench clean
.DELETE_ON_ERROR:

# The first interpreter that really runs and is new enough; override with make PYTHON=/path/to/python.
PYTHON ?= $(shell for p in python3.11 python3 python3.12 python3.13; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && { echo "$$p"; break; }; done)

VENV := .venv
PY := $(VENV)/bin/python
RUN := $(VENV)/.installed-run
DEV := $(VENV)/.installed-dev
BENCH := $(VENV)/.installed-bench
INSTALL := $(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt
ARGS ?=

help:
	@echo "make sim     fly the whole repair on the desk   (ARGS=\"--scenario NAME --law paper|tuned ...\")"
	@echo "make test    all tests                          (ARGS=\"-k limits\" to choose)"
	@echo "make check   format, lint, types, import rules"
	@echo "make bench   measure the core, the laws and the world"
	@echo "make clean   remove .venv and all caches"

sim: $(RUN)
	@$(VENV)/bin/pipewright sim $(ARGS)

# The last gate before the actuators is covered to the last branch, or the tests fail.
GATE_TEST := tests/core/test_limits.py

# What flies in real time has the machine to itself, and a second try (docs/decisions/0027).
test: $(DEV)
ifneq ($(strip $(ARGS)),)
	$(PY) -m pytest -n 2 --dist loadscope $(ARGS)
else
	$(PY) -m pytest -n 2 --dist loadscope -m "not realtime"
	$(PY) -m pytest -m realtime --reruns 1 --rerun-show-tracebacks -raR
	$(PY) -m pytest -q $(GATE_TEST) --cov=onboard.core.limits --cov-branch --cov-report=term-missing --cov-fail-under=100
endif

check: $(DEV)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(VENV)/bin/lint-imports

bench: $(BENCH)
	@$(PY) -m tests.bench $(ARGS)

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache .coverage
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(PY):
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed and was not found. Install it (Debian, Ubuntu: \
	apt install python3.11 python3.11-venv), or name it: make PYTHON=/path/to/python" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "$(PYTHON) is no Python 3.11 or newer." >&2; exit 1; }
	@"$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || { echo "$(PYTHON) cannot make virtual environments. Install its \
	venv package (Debian, Ubuntu: apt install python3-venv)." >&2; exit 1; }
	"$(PYTHON)" -m venv $(VENV)

$(RUN): pyproject.toml constraints.txt | $(PY)
	$(INSTALL) -e '.[sim,ground,campaign,vision]'
	@touch $@

$(DEV): $(RUN)
	$(INSTALL) -e '.[sim,ground,campaign,vision,dev]'
	@touch $@

$(BENCH): $(DEV)
	$(INSTALL) -e '.[sim,ground,campaign,vision,dev,bench]'
	@touch $@

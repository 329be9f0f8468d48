# make demo: demonstrations, training, evaluation, report.   make test: the tests.
# Both need git, make, a C++ compiler, Python 3.12 and pip; the environment is built once, in .venv.

PYTHON ?= $(shell command -v python3.12 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/uv
READY := $(VENV)/.ready
DEMO := outputs/demo
export HF_HUB_OFFLINE ?= 1

.PHONY: help setup demo test test-long test-portable portability mutants bench docs wheels lint types lock clean

help: ## What there is to make
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 14

setup: $(READY) ## The environment, in .venv

# Only what pins the environment rebuilds it; the packages of this repository are installed in place.
$(READY): requirements.txt requirements-uv.txt pyproject.toml policies/lerobot_policy_hdril/pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 12))' 2>/dev/null || \
	  { echo "hdril needs Python 3.12 ($(PYTHON) is not): install it, or say where it is: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	@command -v $${CXX:-c++} >/dev/null 2>&1 || command -v g++ >/dev/null 2>&1 || \
	  { echo "hdril needs a C++ compiler, because PyBullet has no wheel for Python 3.12: install g++ (Debian, Ubuntu) or Xcode's tools (macOS)" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@test -x $(UV) || $(BIN)/python -m pip install --quiet --require-hashes -r requirements-uv.txt
	$(UV) pip install --python $(BIN)/python --require-hashes -r requirements.txt
	$(UV) pip install --python $(BIN)/python --quiet --no-deps -e . -e policies/lerobot_policy_hdril
	@touch $@

demo: $(READY) ## Table lift from nothing to an evaluated policy
	$(BIN)/python scripts/demo.py --output=$(DEMO)

test: $(READY) ## The tests
	$(BIN)/python -m pytest -n 2 --dist=loadfile

test-long: $(READY) ## The tests that take longer
	$(BIN)/python -m pytest -n 2 --dist=loadfile -m long

test-portable: $(READY) ## The tests that involve a policy, with other instruction sets and numbers of threads
	$(BIN)/python scripts/portability.py -- $(BIN)/python -m pytest -n 2 --dist=loadfile -m "portable and not long"

portability: $(READY) ## What is the same, bit for bit, with other instruction sets and numbers of threads
	$(BIN)/python scripts/portability.py

mutants: $(READY) ## The share of small changes of the code that tests notice, in a fixed sample of 200
	$(BIN)/python scripts/mutants.py

bench: $(READY) ## Speeds, as ratios within one run
	$(BIN)/hdril-bench

docs: $(READY) ## The documentation, in outputs/docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs outputs/docs
	@echo "Open outputs/docs/index.html"

wheels: $(READY) ## Both distributions, in outputs/wheels
	$(BIN)/python -m build --no-isolation --wheel --outdir outputs/wheels .
	$(BIN)/python -m build --no-isolation --wheel --outdir outputs/wheels policies/lerobot_policy_hdril

lint: $(READY) ## Formatting and lint
	$(BIN)/ruff format --check . && $(BIN)/ruff check .

types: $(READY) ## Types
	$(BIN)/pyright

lock: $(READY) ## Pin the environment anew
	$(UV) pip compile --quiet pyproject.toml --group dev --universal --generate-hashes --no-emit-index-url \
	  --no-emit-package lerobot-policy-hdril --no-header --python-version 3.12 -o requirements.txt
	grep '^uv==' requirements.txt | cut -d' ' -f1 | $(UV) pip compile --quiet - --universal --generate-hashes \
	  --no-emit-index-url --no-header --python-version 3.12 -o requirements-uv.txt

clean: ## Remove the environment and all outputs
	rm -rf $(VENV) outputs

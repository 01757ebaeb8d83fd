# Two commands on a fresh machine: `make demo` and `make test`. Both make .venv from the lock.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.stamp
# Tests of flights wait more than they compute: one worker more than cores.
JOBS ?= $(shell expr $$(nproc) + 1)

.PHONY: demo test lint bench campaign paper lock clean

$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --only-binary :all: -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $@

demo: $(STAMP)
	$(BIN)/python -m sim.demo

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy calib mission daemon sim benchmarks
	$(BIN)/lint-imports

test: lint
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

bench: $(STAMP)
	$(BIN)/python -m benchmarks
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.planning

campaign: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.campaign
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.verdict

paper: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m sim.papers

# For maintainers: renew the lock (uv from the package registry); no index or host is written into it.
lock:
	uv pip compile pyproject.toml --all-extras --universal --generate-hashes --python-version 3.11 --no-emit-index-url --no-header --no-annotate --upgrade -o requirements.lock

clean:
	rm -rf $(VENV) build demo-out .pytest_cache .mypy_cache .ruff_cache

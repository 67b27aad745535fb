# Two commands do everything on a fresh machine: make demo, make test.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: demo test lint types contracts nightly bench clean

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: $(STAMP)
	$(BIN)/cluster-slam smooth data/sample -o out/demo

test: $(STAMP) lint types contracts
	$(BIN)/python -m pytest -m "not nightly" -n 2

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

contracts: $(STAMP)
	$(BIN)/lint-imports

# Many seeds, real recordings (CLUSTER_SLAM_DATA names their folder): takes hours.
nightly: $(STAMP)
	$(BIN)/python -m pytest -m nightly -s

bench: $(STAMP)
	$(BIN)/python benchmarks/run.py

clean:
	rm -rf out build *.egg-info .pytest_cache .mypy_cache .ruff_cache

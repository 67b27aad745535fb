# Two commands do everything on a fresh machine: make demo, make test.
# Any Python from 3.11 serves; the exact versions of constraints.txt are tested with 3.11.
SUITABLE = import sys; sys.exit(sys.version_info < (3, 11))
PYTHON ?= $(shell for p in python3.11 python3 python; do $$p -c '$(SUITABLE)' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# One thread in linear algebra: the arrays are small, and the cores are for the tests.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: demo test lint types contracts notebooks nightly bench clean

$(STAMP): pyproject.toml constraints.txt
	@test -x $(BIN)/python || test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed (make PYTHON=...)"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

demo: $(STAMP)
	$(BIN)/cluster-slam smooth data/sample -o out/demo

test: $(STAMP) lint types contracts
	$(BIN)/python -m pytest -m "not nightly" -n 2 --dist worksteal --nbmake tests notebooks

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

contracts: $(STAMP)
	$(BIN)/lint-imports

notebooks: $(STAMP)
	$(BIN)/python -m pytest --nbmake notebooks

# Many seeds, and real recordings where CLUSTER_SLAM_DATA names their folder: takes hours.
nightly: $(STAMP)
	$(BIN)/python -m pytest -m nightly -s

bench: $(STAMP)
	$(BIN)/python benchmarks/run.py

clean:
	rm -rf out build *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache

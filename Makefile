# Each of these works as the first command on a fresh machine with Python 3.11 or newer.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
READY := .venv/.ready

.PHONY: setup mission test lint docs bench bench-filter calibration clean

setup: $(READY)

# Made anew when what it is made from changes.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Plumeward needs Python 3.11 or newer; name one with: make PYTHON=...")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@

mission: setup
	$(BIN)/python -m sitl

test: setup
	$(BIN)/pytest -n 2

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: setup
	$(BIN)/python -m link > docs/bus.md
	$(BIN)/python docs/picture.py

bench: setup
	$(BIN)/python benchmarks/loop.py

# The peers: particles says that it wants an older numpy, and works with ours.
bench-filter: setup
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps particles==0.4
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m benchmarks.filter

calibration: setup
	$(BIN)/python benchmarks/calibration.py

clean:
	rm -rf .venv build *.egg-info runs
	find . -name __pycache__ -prune -exec rm -rf {} +
